"""Free space that a ball can reach: what lies behind a hole in a torn wall does not count."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.freespace.distances import box_around, distance_to_cubes

__all__ = ["ball_mask", "mark", "reachable"]

NARROW_SHARE = 0.25
"""Where so many of the cameras themselves have less room than the ball asked for, it is made smaller."""


def reachable(
    free: Bool[np.ndarray, "x y z"],
    clearance: Float[np.ndarray, "x y z"],
    cameras: Int[np.ndarray, "c 3"],
    radius: float,
) -> Bool[np.ndarray, "x y z"]:
    """Free voxels that a ball covers on its way from the cameras without meeting an occupied voxel.

    The ball's centre passes through free voxels, from face to face. In an organ that is narrower than the
    ball, its radius is the lower quartile of the cameras' own clearance.

    Args:
        free: the voxels it may pass.
        clearance: distance of each centre from the nearest occupied cube, in voxels.
        cameras: voxels that it starts from; those with less room than the ball are left out.
        radius: of the ball, in voxels.
    """
    from scipy.ndimage import label

    at = tuple(cameras.T)
    radius = max(0.0, min(radius, float(np.quantile(clearance[at], NARROW_SHARE))))
    # The wall lies somewhere in its cubes: on average half a voxel behind the face that clearance ends at.
    wide = free & (clearance >= max(radius - 0.5, min(radius, 0.5)))
    starts = wide[at]
    box = box_around(wide, 0.0)
    parts, n = label(wide[box])
    low = [edge.start for edge in box]
    joined = np.zeros(n + 1, dtype=bool)
    joined[parts[tuple((cameras[starts] - low).T)]] = True
    joined[0] = False
    passed = np.zeros_like(free)
    passed[box] = joined[parts]
    return free & (distance_to_cubes(passed, radius + 1.0) <= radius)


def ball_mask(centers: Float[np.ndarray, "n 3"], size: int, radius: float) -> Bool[np.ndarray, "s s s"]:
    """Voxels whose centre lies within `radius` voxels of one of the points (grid coordinates)."""
    marked = np.zeros((size, size, size), dtype=bool)
    reach = int(np.ceil(radius)) + 1
    offset = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.floor(centers).astype(np.int64)[:, None] + offset
    near = ((index + 0.5 - centers[:, None]) ** 2).sum(-1) <= radius**2
    mark(marked, index[near])
    return marked


def mark(marked: Bool[np.ndarray, "s s s"], index: Int[np.ndarray, "n 3"]) -> None:
    """Set voxels; those outside the grid are left out."""
    inside = ((index >= 0) & (index < marked.shape[0])).all(axis=1)
    index = index[inside]
    marked[index[:, 0], index[:, 1], index[:, 2]] = True
