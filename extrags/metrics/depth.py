"""Errors of rendered depth against true depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from extrags.errors import ShapeError

__all__ = ["DepthErrors", "depth_errors"]


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Errors over the pixels where both depths are known; None where none of them is.

    Args:
        absrel: mean of |rendered - true| / true.
        rmse: root of the mean squared error, in the unit of the depths.
        delta125: share of pixels with max(rendered / true, true / rendered) < 1.25.
        coverage: share of the pixels with true depth for which there is a rendered one.
        n_pixels: number of pixels with both depths.
    """

    absrel: float | None
    rmse: float | None
    delta125: float | None
    coverage: float
    n_pixels: int


def depth_errors(
    rendered: Float[np.ndarray, "*b h w"],
    truth: Float[np.ndarray, "*b h w"],
    mask: Bool[np.ndarray, "*b h w"] | None = None,
) -> DepthErrors | None:
    """AbsRel, RMSE and delta < 1.25 of z-depth.

    A pixel is evaluated when it is in the mask and both depths are finite and above zero: 0 and NaN mean
    unknown on either side. Pixels without rendered depth lower `coverage`, not the errors.

    Args:
        rendered: rendered z-depth, 0 or NaN where there is no surface.
        truth: true z-depth in the same unit, 0 or NaN where unknown.
        mask: pixels that may count; None is all.

    Returns:
        The errors, or None when no pixel has a true depth. Where no pixel has a rendered one, the coverage is
        zero and the others are None.

    Raises:
        ShapeError: when the arrays do not fit each other.

    Source: Eigen, Puhrsch, Fergus: Depth Map Prediction from a Single Image using a Multi-Scale Deep
    Network, NIPS 2014, section 4.3.
    """
    if rendered.shape != truth.shape or (mask is not None and mask.shape != truth.shape):
        raise ShapeError(
            f"depth maps differ in shape: rendered {rendered.shape}, true {truth.shape}, "
            f"mask {None if mask is None else mask.shape}"
        )
    known = np.isfinite(truth) & (truth > 0)
    if mask is not None:
        known = known & mask
    both = known & np.isfinite(rendered) & (rendered > 0)
    n_known, n_pixels = int(known.sum()), int(both.sum())
    if n_known == 0:
        return None
    if n_pixels == 0:
        return DepthErrors(None, None, None, 0.0, 0)
    found = rendered[both].astype(np.float64)
    true = truth[both].astype(np.float64)
    return DepthErrors(
        absrel=float(np.mean(np.abs(found - true) / true)),
        rmse=float(np.sqrt(np.mean((found - true) ** 2))),
        delta125=float(np.mean(np.maximum(found / true, true / found) < 1.25)),
        coverage=n_pixels / n_known,
        n_pixels=n_pixels,
    )
