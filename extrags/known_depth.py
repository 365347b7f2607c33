"""Which values of a depth map are depth of the scene, and which stand for none."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Real

__all__ = ["FARTHEST", "is_background"]

FARTHEST = 1000.0
"""Depth beyond so many times that of the near part of an image stands for a background: renderers write 1e10
or the largest float there. A scope that sees a wall at 20 mm sees none at 20 m."""
_NEAR_QUANTILE = 0.1
"""Of the known depths; a background may fill nine tenths of an image."""


def is_background(depth: Real[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
    """Values too far away to be surface; 0, which is unknown, is none of them.

    Args:
        depth: finite z-depth of any shape and unit, 0 where unknown.

    Returns:
        True where it is one, of the same shape.
    """
    positive = depth > 0
    if not positive.any():
        return positive
    known = depth[positive]
    rank = int(_NEAR_QUANTILE * (known.size - 1))
    near = np.partition(known, rank)[rank]
    return np.asarray(depth > FARTHEST * np.float64(near))
