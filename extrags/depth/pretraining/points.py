"""Sparse points as triangulation finds them: on texture, seen in several frames, wrong along the ray."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from extrags.depth.frames import source_from_reference
from extrags.depth.pretraining.cavities import Cavities
from extrags.depth.pretraining.photographs import Clips

__all__ = ["triangulated_points"]

MOST_PER_FRAME = 60
WITHOUT = 0.4
"""Share of the clips without points."""
OUTLIERS = 0.03
FEATURE_ERROR_PX = 0.6
UNCERTAIN = 0.1
DETECTED = 0.7
"""Probability that a frame which sees a point has a feature there."""
SAME_DEPTH = 0.03


def triangulated_points(clips: Clips, scene: Cavities) -> Float[Tensor, "f h w"]:
    """Depth of points at their pixels in every frame, 0 elsewhere.

    Each frame contributes points where its image changes most. Their depth is wrong by what a feature's
    error is worth at the angle under which a clip sees them; all frames see the same, wrong, point.

    Args:
        clips: frames with their truth.
        scene: whose generator draws.
    """
    n, height, width = clips.depth.shape
    v, device = clips.views, clips.depth.device
    frames = clips.frames
    weight = _change(frames.grey).square() * frames.mask + 1e-9
    drawn = torch.multinomial(weight.flatten(1), MOST_PER_FRAME, generator=scene.generator)
    z = clips.depth.flatten(1).gather(1, drawn)
    rays = frames.rays.flatten(2).gather(2, drawn[:, None].expand(-1, 3, -1))
    centers = frames.world_from_camera[:, :3, 3].unflatten(0, (-1, v))
    spread = (centers[:, :, None] - centers[:, None]).norm(dim=3).flatten(1).max(dim=1).values
    baseline = spread.repeat_interleave(v)[:, None] * scene.uniform(0.2, 1.0, n, MOST_PER_FRAME)
    sigma = FEATURE_ERROR_PX * z / (frames.K[:, 0, 0, None] * baseline).clamp_min(1e-9)
    wrong = (sigma * (scene.uniform(-1.0, 1.0, n, MOST_PER_FRAME) * 2)).clamp(-0.4, 0.4)
    stray = scene.uniform(0.0, 1.0, n, MOST_PER_FRAME) < OUTLIERS
    wrong = torch.where(stray, scene.uniform(-0.7, 0.7, n, MOST_PER_FRAME), wrong)
    true_point, point = rays * z[:, None], rays * (z * torch.exp(wrong))[:, None]
    # Clips have few points or many; some have none.
    share = scene.uniform(0.0, 1.0, n // v) * (scene.uniform(0.0, 1.0, n // v) > WITHOUT)
    kept = scene.uniform(0.0, 1.0, n, MOST_PER_FRAME) < share.repeat_interleave(v)[:, None]
    # Structure from motion drops points that it sees under too small an angle.
    kept &= (z > 0) & ((sigma < UNCERTAIN) | stray)
    result = torch.zeros(n, height * width, device=device)
    own = torch.arange(n, device=device)
    first = own - own % v
    for step in range(v):
        seeing = first + (own % v + step) % v
        motion = source_from_reference(frames, own, seeing)
        local_true = motion[:, :, :3] @ true_point + motion[:, :, 3:]
        local = motion[:, :, :3] @ point + motion[:, :, 3:]
        K = frames.K[seeing]
        pixel = torch.floor(
            K[:, :2, :2] @ (local[:, :2] / local[:, 2:].clamp_min(1e-6)) + K[:, :2, 2:]
        ).long()
        inside = (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
        index = (pixel[:, 1] * width + pixel[:, 0]).clamp(0, height * width - 1)
        truth = clips.depth[seeing].flatten(1).gather(1, index)
        seen = (truth - local_true[:, 2]).abs() < SAME_DEPTH * truth
        # Outliers and points that are far off project beside what they lie on; they are kept nevertheless.
        seen |= wrong.abs() > SAME_DEPTH
        found = kept & inside & seen & (local[:, 2] > 1e-3) & frames.mask[seeing].flatten(1).gather(1, index)
        found &= (scene.uniform(0.0, 1.0, n, MOST_PER_FRAME) < DETECTED) | (step == 0)
        rows = seeing[:, None].expand_as(index)
        result[rows[found], index[found]] = local[:, 2][found]
    images: Tensor = result.unflatten(1, (height, width))
    return images


def _change(grey: Tensor) -> Tensor:
    """Size of the brightness gradient."""
    change = torch.zeros_like(grey)
    across = (grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]).abs()
    along = (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]).abs()
    change[:, 1:-1, 1:-1] = torch.minimum(across + along, torch.full_like(across, 1.0))
    return change
