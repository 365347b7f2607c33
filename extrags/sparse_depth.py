"""Depth between pixels whose depth is known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["MIN_POINTS_PER_VIEW", "interpolated_depth", "pixel_lattice"]

MIN_POINTS_PER_VIEW = 20
"""A view with fewer visible sparse points gives no interpolated depth."""

LATTICE = 32
"""Pixels along the longer side that stand for a whole image where only a statistic of it counts."""


def interpolated_depth(
    pixels: Float[np.ndarray, "n 2"], z: Float[np.ndarray, "n"], at: Float[np.ndarray, "*m 2"]
) -> Float[np.ndarray, "*m"]:
    """Depth at any pixels: linear in its inverse inside the convex hull of the known ones, nearest outside.

    Args:
        pixels: where depth is known, (u, v).
        z: z-depth there, above 0.
        at: where it is wanted.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    # Inverse depth is linear across a plane in the image; depth is not.
    linear = LinearNDInterpolator(pixels, 1 / z)(at)
    nearest = NearestNDInterpolator(pixels, 1 / z)(at)
    return np.asarray(1 / np.where(np.isfinite(linear), linear, nearest))


def pixel_lattice(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """Pixel centres inside a mask, thinned evenly to at most 32 along the longer side."""
    step = max(1, -(-max(mask.shape) // LATTICE))
    rows, columns = np.nonzero(mask[step // 2 :: step, step // 2 :: step])
    return np.asarray(np.stack([columns, rows], axis=1) * float(step) + step // 2 + 0.5)
