"""Which voxels a triangle mesh passes through."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["voxels_of_triangles"]

LONGEST_EDGE = 8.0
"""Triangles with longer edges, in voxels, are cut first: a long one's bounding box holds many voxels."""
CANDIDATES_PER_BATCH = 1_000_000
TOUCHING = 1e-9
"""A triangle this near to a cube, in voxels, touches it."""


def voxels_of_triangles(corners: Float[np.ndarray, "t 3 3"], size: int) -> Bool[np.ndarray, "s s s"]:
    """Voxels whose cube a triangle meets, exactly: no path through the others crosses the mesh.

    Args:
        corners: of the triangles in voxel coordinates, where voxel i covers [i, i + 1).
        size: voxels per axis.

    Source: separating axes [AkenineMoller2001], see docs/references.md.
    """
    marked = np.zeros((size, size, size), dtype=bool)
    corners = _cut(corners)
    low = np.clip(np.floor(corners.min(axis=1) - TOUCHING), 0, None).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) + TOUCHING).astype(np.int64), size - 1)
    extent = np.maximum(high - low + 1, 0)
    count = extent.prod(axis=1)
    corners, low, extent, count = (part[count > 0] for part in (corners, low, extent, count))
    batch = np.cumsum(count) // CANDIDATES_PER_BATCH
    for start, end in _runs(batch):
        part = slice(start, end)
        triangle = np.repeat(np.arange(end - start), count[part])
        within = np.arange(len(triangle)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
        shape = extent[part][triangle]
        offset = np.stack(
            [
                within // (shape[:, 1] * shape[:, 2]),
                within // shape[:, 2] % shape[:, 1],
                within % shape[:, 2],
            ],
            axis=1,
        )
        voxel = low[part][triangle] + offset
        met = _meets(corners[part][triangle] - (voxel + 0.5)[:, None])
        marked[tuple(voxel[met].T)] = True
    return marked


def _runs(batch: Int[np.ndarray, "t"]) -> list[tuple[int, int]]:
    """Begin and end of each run of equal values."""
    if not len(batch):
        return []
    edges = [0, *(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(batch)]
    return list(pairwise(edges))


def _cut(corners: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "u 3 3"]:
    """Triangles in four, as often as edges are too long."""
    while len(corners):
        longest = np.sqrt(((corners - np.roll(corners, 1, axis=1)) ** 2).sum(-1)).max(axis=1)
        long = longest > LONGEST_EDGE
        if not long.any():
            break
        a, b, c = np.moveaxis(corners[long], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [
            np.stack(parts, axis=1) for parts in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]
        corners = np.concatenate([corners[~long], *quarters])
    return corners


def _meets(corners: Float[np.ndarray, "n 3 3"]) -> Bool[np.ndarray, "n"]:
    """Whether triangles meet the unit cube about the origin, given that their bounding boxes do."""
    a, b, c = np.moveaxis(corners, 1, 0)
    edges = (b - a, c - b, a - c)
    normal = np.cross(edges[0], edges[1])
    met = np.abs((normal * a).sum(-1)) <= 0.5 * np.abs(normal).sum(-1) + TOUCHING
    for edge in edges:
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            # The cross product of the cube's axis and the edge: (0, -edge_v, edge_u) along (axis, u, v).
            along = corners[..., v] * edge[:, None, u] - corners[..., u] * edge[:, None, v]
            reach = 0.5 * (np.abs(edge[:, u]) + np.abs(edge[:, v])) + TOUCHING
            met &= (along.min(axis=1) <= reach) & (along.max(axis=1) >= -reach)
    return np.asarray(met)
