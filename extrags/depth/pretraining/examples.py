"""Training examples of the completion: stereo on procedural clips, exactly as it runs on a user's frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.depth.completion import completion_inputs
from extrags.depth.frames import PosedFrames, select_sources
from extrags.depth.pretraining.cavities import Cavities, Kind
from extrags.depth.pretraining.photographs import Clips, photograph
from extrags.depth.stereo import StereoSettings, multi_view_stereo

__all__ = ["SIZES", "Examples", "make_examples"]

SIZES: tuple[tuple[int, int], ...] = ((128, 160), (144, 144), (112, 176))
"""Heights and widths in pixels."""
VIEWS = 7
SOURCES = 6


@dataclass(frozen=True)
class Examples:
    """Inputs and truth of frames of one size.

    Args:
        channels: from `completion_inputs`, half precision, [F, 19, H, W].
        truth: true log-depth relative to the inputs' scale, half precision, [F, H, W].
        known: where the truth is known, [F, H, W].
    """

    channels: Float[Tensor, "f 19 h w"]
    truth: Float[Tensor, "f h w"]
    known: Float[Tensor, "f h w"]


def make_examples(
    kind: Kind,
    scenes: int,
    generator: torch.Generator,
    size: tuple[int, int],
    settings: StereoSettings | None = None,
) -> Examples | None:
    """Clips of one kind of scene with their stereo; None if no clip is usable.

    In half of the clips poses are slightly wrong, in a quarter the focal length is; frames have two to six
    sources; the searched range of depths is wider than the true one by random factors.

    Args:
        kind: of scene.
        scenes: number of clips to try.
        generator: source of randomness; its device is used.
        size: height and width in pixels.
        settings: of stereo.
    """
    scene = Cavities(kind, scenes, generator)
    clips = photograph(scene, generator, size, VIEWS)
    n = len(clips.depth)
    if n == 0:
        return None
    sources, near, far = _searched(clips, scene)
    frames = _miscalibrated(clips, scene)
    stereo = multi_view_stereo(frames, sources, near, far, settings, recording=clips.clip, chunk=n)
    points = _sparse_points(clips, scene)
    inputs = completion_inputs(frames, stereo, points)
    truth = torch.log(clips.depth.clamp_min(1e-6)) - inputs.log_scale[:, None, None]
    known = frames.mask & (clips.depth > 0)
    return Examples(inputs.channels.half(), torch.where(known, truth, 0.0).clamp(-4, 4).half(), known.half())


def _searched(clips: Clips, scene: Cavities) -> tuple[Tensor, Tensor, Tensor]:
    """Sources of each frame, and the range of depths that is searched."""
    device = clips.depth.device
    n, v = len(clips.depth), clips.views
    ordered = torch.where(clips.depth > 0, clips.depth, float("nan")).flatten(1)
    low, middle, high = (ordered.nanquantile(q, dim=1) for q in (0.01, 0.5, 0.99))
    poses, K = clips.frames.world_from_camera.cpu().numpy(), clips.frames.K.cpu().numpy()
    typical = middle.cpu().numpy().astype(np.float64)
    chosen = np.full((n, SOURCES), -1, dtype=np.int64)
    for first in range(0, n, v):
        part = slice(first, first + v)
        found = select_sources(
            poses[part].astype(np.float64),
            K[part].astype(np.float64),
            clips.frames.size,
            typical[part],
            SOURCES,
        )
        chosen[part] = np.where(found >= 0, found + first, -1)
    sources = torch.from_numpy(chosen).to(device)
    allowed = 2 + (scene.uniform(0.0, 1.0, n // v).repeat_interleave(v) * 5).long()
    ranks = torch.arange(SOURCES, device=device)[None]
    sources = torch.where(ranks < allowed[:, None].clamp_max(SOURCES), sources, -1)
    near = low / scene.uniform(1.1, 2.0, n)
    far = high * scene.uniform(1.1, 2.0, n)
    return sources, near, far


def _miscalibrated(clips: Clips, scene: Cavities) -> PosedFrames:
    """The frames with slightly wrong poses and focal lengths, as an estimate of them would be."""
    frames, v = clips.frames, clips.views
    n = len(clips.depth)
    device = clips.depth.device
    per_clip = n // v
    amount = (scene.uniform(0.0, 1.0, per_clip) < 0.5).float() * scene.uniform(0.0, 1.0, per_clip)
    amount = amount.repeat_interleave(v)[:, None]
    turn = amount * math.radians(0.2) * scene.uniform(-1.0, 1.0, n, 3)
    centers = frames.world_from_camera[:, :3, 3]
    pace = (centers.roll(-1, 0) - centers).norm(dim=1)
    pace = pace.unflatten(0, (per_clip, v))[:, :-1].mean(1).repeat_interleave(v)[:, None]
    shift = amount * 0.04 * pace * scene.uniform(-1.0, 1.0, n, 3)
    wrong = torch.eye(4, device=device).repeat(n, 1, 1)
    a, b, c = turn.unbind(1)
    zero = torch.zeros_like(a)
    wrong[:, :3, :3] = torch.linalg.matrix_exp(
        torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], dim=1).unflatten(1, (3, 3))
    )
    poses = frames.world_from_camera @ wrong
    poses[:, :3, 3] += shift
    focal = 1 + (scene.uniform(0.0, 1.0, per_clip) < 0.25).float() * scene.uniform(-0.03, 0.03, per_clip)
    K = frames.K.clone()
    K[:, [0, 1], [0, 1]] *= focal.repeat_interleave(v)[:, None]
    return replace(frames, world_from_camera=poses, K=K)


def _sparse_points(clips: Clips, scene: Cavities) -> Tensor:
    """Depth at random pixels, a little wrong, one in thirty far off; none in a third of the clips."""
    n, height, width = clips.depth.shape
    v = clips.views
    share = 0.03 * scene.uniform(0.0, 1.0, n // v).square() * (scene.uniform(0.0, 1.0, n // v) > 1 / 3)
    chosen = scene.uniform(0.0, 1.0, n, height, width) < share.repeat_interleave(v)[:, None, None]
    noise = torch.exp(0.02 * scene.uniform(-1.0, 1.0, n, height, width))
    stray = scene.uniform(0.0, 1.0, n, height, width) < 1 / 30
    noise = torch.where(stray, torch.exp(scene.uniform(-0.7, 0.7, n, height, width)), noise)
    return torch.where(chosen & clips.frames.mask, clips.depth * noise, 0.0)
