"""The free space of a run in few bytes, as the viewer of the page reads it.

One byte per voxel of the box round all free voxels: 0 unknown, 1 occupied, and from 2 on free, the clearance
in even steps up to the largest. Compressed with gzip; a grid of 64 voxels a side takes some ten kB.
"""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from extrags.errors import SourceError
from extrags.report.inputs import GridLike

__all__ = ["FREE_LEVELS", "decoded_free_space", "encoded_free_space"]

FREE_LEVELS = 254
"""Levels of clearance of a free voxel."""
FIRST_FREE = 2
BORDER = 1
"""Voxels kept round the free ones: they tell what free space ends at."""


def encoded_free_space(grid: GridLike, unit: str) -> dict[str, Any] | None:
    """States and clearance of the voxels round all free ones; None when no voxel is free.

    Args:
        grid: occupancy, clearance and where the grid lies.
        unit: of its lengths, for the words round the canvas.

    Returns:
        `body` (base64), `size` of the box in voxels, `origin` of its corner and `axes` in the world,
        `voxel` (the edge of one), `largest` clearance and `unit`.
    """
    free = grid.occupancy == 0
    if not free.any():
        return None
    size = np.array(free.shape)
    held = np.argwhere(free)
    low = np.maximum(held.min(0) - BORDER, 0)
    high = np.minimum(held.max(0) + 1 + BORDER, size)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    occupancy = grid.occupancy[box]
    clearance = np.maximum(grid.clearance[box], 0.0)
    largest = max(float(clearance[free[box]].max()), 1e-9)
    level = FIRST_FREE + np.rint(clearance / largest * (FREE_LEVELS - 1))
    levels = np.where(free[box], level, np.where(occupancy == 1, 1, 0)).astype(np.uint8)
    origin = grid.origin_mm + (low * grid.voxel_mm) @ grid.axes
    body = gzip.compress(levels.tobytes(), 9, mtime=0)
    return {
        "body": base64.b64encode(body).decode("ascii"),
        "size": [int(side) for side in levels.shape],
        "origin": [float(value) for value in origin],
        "axes": [[float(value) for value in row] for row in grid.axes],
        "voxel": float(grid.voxel_mm),
        "largest": largest,
        "unit": unit,
    }


def decoded_free_space(
    encoded: dict[str, Any],
) -> tuple[UInt8[np.ndarray, "x y z"], Float[np.ndarray, "x y z"]]:
    """What the viewer makes of it: occupancy, and clearance, 0 where a voxel is not free.

    Raises:
        SourceError: when the body does not have the size its header says.
    """
    levels = np.frombuffer(gzip.decompress(base64.b64decode(encoded["body"])), dtype=np.uint8)
    if len(levels) != np.prod(encoded["size"]):
        raise SourceError(f"free space of {encoded['size']} voxels holds {len(levels)} of them")
    levels = levels.reshape(encoded["size"])
    occupancy = np.select([levels >= FIRST_FREE, levels == 1], [np.uint8(0), np.uint8(1)], np.uint8(2))
    steps = np.maximum(levels.astype(np.float64) - FIRST_FREE, 0) / (FREE_LEVELS - 1)
    return occupancy, steps * encoded["largest"]
