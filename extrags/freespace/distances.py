"""Exact distances between voxels: from centres to the nearest cube."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["box_around", "distance_to_cubes", "signed_distance"]


def distance_to_cubes(marked: Bool[np.ndarray, "x y z"], limit: float = np.inf) -> Float[np.ndarray, "x y z"]:
    """Euclidean distance from each voxel's centre to the nearest cube of a marked voxel, in voxels.

    Exact: a cube's distance along an axis is the number of voxels less one half, and squares of the three
    add up, so that one pass along each axis takes the minimum.

    Args:
        marked: the voxels whose cubes count.
        limit: distances from here on need not be told apart; they come out as `limit`.

    Returns:
        Zero inside marked voxels; `limit` where none is nearer.
    """
    distance = np.full(marked.shape, np.float32(limit))
    box = box_around(marked, limit)
    squared = np.where(marked[box], np.float32(0), np.float32(np.inf))
    for axis in (2, 1, 0):
        squared = _along(squared, axis, limit)
    distance[box] = np.minimum(np.sqrt(squared), np.float32(limit))
    return distance


def box_around(marked: Bool[np.ndarray, "x y z"], margin: float) -> tuple[slice, slice, slice]:
    """The smallest box that holds all marked voxels and those `margin` voxels beside them."""
    slices = []
    for axes in ((1, 2), (0, 2), (0, 1)):
        line = np.asarray(marked.any(axis=axes))
        held = np.flatnonzero(line)
        if not len(held):
            return slice(0), slice(0), slice(0)
        wide = len(line) if np.isinf(margin) else int(np.ceil(margin))
        slices.append(slice(max(0, int(held[0]) - wide), int(held[-1]) + 1 + wide))
    return slices[0], slices[1], slices[2]


def signed_distance(
    marked: Bool[np.ndarray, "x y z"], limit: float, depth_limit: float
) -> Float[np.ndarray, "x y z"]:
    """Distance to the boundary of the marked voxels' cubes, negative inside them, in voxels.

    Args:
        marked: the voxels inside.
        limit: the largest distance told apart outside.
        depth_limit: the same inside.
    """
    distance = distance_to_cubes(marked, limit)
    box = box_around(marked, depth_limit)
    distance[box] -= np.where(marked[box], distance_to_cubes(~marked[box], depth_limit), 0)
    return distance


def _along(squared: Float[np.ndarray, "x y z"], axis: int, limit: float) -> Float[np.ndarray, "x y z"]:
    """Lower envelope along one axis of what each voxel's cube is away, squared."""
    before = np.moveaxis(squared, axis, 0)
    after = before.copy()
    for steps in range(1, len(before)):
        gap = np.float32(steps - 0.5) ** 2
        if gap >= min(float(after.max()), limit**2):
            break
        np.minimum(after[steps:], before[:-steps] + gap, out=after[steps:])
        np.minimum(after[:-steps], before[steps:] + gap, out=after[:-steps])
    return np.moveaxis(after, 0, axis)
