"""Whether depths of different frames describe the same surface."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.depth.frames import PosedFrames, source_from_reference

__all__ = ["Agreement", "agreement"]


@dataclass(frozen=True)
class Agreement:
    """How a frame's depth compares with its sources' depths; shares of the sources that see the point.

    Args:
        seen: share of all sources in whose image the point falls, [B, H, W].
        agrees: share of those whose depth is the same within the tolerance, [B, H, W].
        violates: share of those that look through the point at something farther, [B, H, W].
        difference: mean over those of the absolute log-ratio of depths, bounded, [B, H, W].
        fused: mean log-depth over the frame itself and the sources that agree, [B, H, W].
    """

    seen: Float[Tensor, "b h w"]
    agrees: Float[Tensor, "b h w"]
    violates: Float[Tensor, "b h w"]
    difference: Float[Tensor, "b h w"]
    fused: Float[Tensor, "b h w"]


MOST_DIFFERENCE = 0.5
"""Bound of a log-ratio: beyond it depths have nothing to do with each other."""


def agreement(
    frames: PosedFrames,
    depth: Float[Tensor, "f h w"],
    references: Int[Tensor, "b"],
    sources: Int[Tensor, "b s"],
    *,
    tolerance: float = 0.05,
) -> Agreement:
    """Compare the depth of frames with that of their sources.

    Args:
        frames: all frames.
        depth: z-depth of all frames, 0 where unknown.
        references: frames to judge.
        sources: frames each is compared with; -1 for none.
        tolerance: log-ratio of depths up to which they agree.
    """
    height, width = frames.size
    rays = frames.rays[references]
    own = depth[references]
    valid = (own > 0) & frames.mask[references]
    # Between two surfaces an interpolated depth belongs to neither: the nearest pixel's is taken.
    zero = torch.zeros_like(own)
    seen, agrees, violates, difference, log_sum = (zero.clone() for _ in range(5))
    present = (sources >= 0).sum(1).clamp_min(1).float()[:, None, None]
    for s in range(sources.shape[1]):
        source = sources[:, s].clamp_min(0)
        motion = source_from_reference(frames, references, source)
        points = torch.einsum("bij,bjhw->bihw", motion[:, :, :3], rays * own[:, None])
        points = points + motion[:, :, 3, None, None]
        z = points[:, 2]
        K = frames.K[source]
        u = K[:, 0, 0, None, None] * points[:, 0] / z.clamp_min(1e-6) + K[:, 0, 2, None, None]
        v = K[:, 1, 1, None, None] * points[:, 1] / z.clamp_min(1e-6) + K[:, 1, 2, None, None]
        grid = torch.stack([u / width * 2 - 1, v / height * 2 - 1], dim=-1)
        theirs = functional.grid_sample(
            (depth[source] * frames.mask[source])[:, None], grid, mode="nearest", align_corners=False
        )[:, 0]
        inside = (u > 0) & (u < width) & (v > 0) & (v < height) & (z > 1e-6)
        both = valid & inside & (theirs > 0) & (sources[:, s] >= 0)[:, None, None]
        ratio = torch.where(both, torch.log(theirs.clamp_min(1e-9) / z.clamp_min(1e-9)), 0.0)
        same = both & (ratio.abs() <= tolerance)
        seen += both
        agrees += same
        violates += both & (ratio > tolerance)
        # A source that sees something nearer has the point hidden, and says nothing about it.
        difference += torch.where(both, ratio.abs().clamp_max(MOST_DIFFERENCE), 0.0)
        log_sum += torch.where(same, ratio, 0.0)
    n = seen.clamp_min(1)
    fused = torch.log(own.clamp_min(1e-9)) + log_sum / (1 + agrees)
    return Agreement(seen / present, agrees / n, violates / n, difference / n, fused)
