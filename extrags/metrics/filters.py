"""Separable image filters: of small images as two matrix products, of large ones by OpenCV.

Up to a few hundred pixels multiplying by a banded [W, W] matrix is several times faster on a CPU than torch's
convolution of eleven taps, and has gradients; the matrix also implements the border rule. Its work grows with
the cube of the width, that of OpenCV's filters with the pixels.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["BorderRule", "filter_figures", "filter_separable", "gaussian_weights"]

BorderRule = Literal["reflect", "replicate"]
FitRule = Literal["linear"]

CV_DTYPES = (torch.float32, torch.float64)
LARGEST_MATRIX_PX = 384
"""Larger maps are filtered by OpenCV: two products with matrices of their size take 7 to 12 times as long."""


def filter_separable(
    maps: Float[Tensor, "*b h w"],
    weights_x: tuple[float, ...],
    weights_y: tuple[float, ...],
    border: BorderRule | FitRule = "reflect",
) -> Float[Tensor, "*b h w"]:
    """Correlate each map with the outer product of two odd-length rows of weights.

    Args:
        maps: any number of maps.
        weights_x: weights along the width, centre in the middle.
        weights_y: weights along the height.
        border: `reflect` mirrors about the border pixel (which is not repeated), `replicate`
            repeats the border pixel, `linear` takes the weights that are left inside and fits a line by
            them, for symmetric weights above zero: what is linear along the axes stays as it is up to the
            border, where it may leave the range of the values.

    Returns:
        Filtered maps of the same size.
    """
    height, width = maps.shape[-2:]
    across = _filter_matrix(width, weights_x, border).to(maps)
    down = _filter_matrix(height, weights_y, border).to(maps)
    return down @ (maps @ across.T)


@lru_cache(maxsize=128)
def gaussian_weights(sigma_px: float, radius_px: int) -> tuple[float, ...]:
    """Gaussian of `2 * radius_px + 1` weights that sum to one."""
    from kornia.filters import get_gaussian_kernel1d

    return tuple(get_gaussian_kernel1d(2 * radius_px + 1, sigma_px, dtype=torch.float64)[0].tolist())


def filter_figures(
    maps: Float[Tensor, "*b h w"],
    weights_x: tuple[float, ...],
    weights_y: tuple[float, ...],
    border: BorderRule = "reflect",
) -> Float[Tensor, "*b h w"]:
    """`filter_separable` for figures: large maps go through OpenCV, where that can be.

    Its work grows with the pixels alone, and its last bits are others; it knows no gradients and no half
    precision. What stages compute keeps to one way, whatever the size.

    Args:
        maps: images, filtered along their last two axes.
        weights_x: odd number of weights along rows.
        weights_y: odd number of weights along columns.
        border: as there.
    """
    import cv2

    large = max(maps.shape[-2:]) > LARGEST_MATRIX_PX
    if not large or maps.requires_grad or maps.device.type != "cpu" or maps.dtype not in CV_DTYPES:
        return filter_separable(maps, weights_x, weights_y, border)

    rule = cv2.BORDER_REPLICATE if border == "replicate" else cv2.BORDER_REFLECT_101
    along_x, along_y = (np.asarray(weights) for weights in (weights_x, weights_y))
    found = torch.empty(maps.shape, dtype=maps.dtype)
    planes = zip(maps.reshape(-1, *maps.shape[-2:]), found.view(-1, *maps.shape[-2:]), strict=True)
    for one, filtered in planes:
        cv2.sepFilter2D(one.numpy(), -1, along_x, along_y, filtered.numpy(), borderType=rule)
    return found


# A cached tensor may be created in inference mode and used with autograd later.
@lru_cache(maxsize=128)
@torch.inference_mode(False)
def _filter_matrix(
    size: int, weights: tuple[float, ...], border: BorderRule | FitRule
) -> Float[Tensor, "s s"]:
    if border == "linear":
        return _fit_matrix(size, weights)
    radius = len(weights) // 2
    positions = torch.arange(size)[:, None] + torch.arange(-radius, radius + 1)[None]
    if border == "replicate":
        sources = positions.clamp(0, size - 1)
    else:
        # Folding with the period of a mirrored row also serves images smaller than the radius.
        period = max(2 * (size - 1), 1)
        folded = positions % period
        sources = torch.where(folded >= size, period - folded, folded)
    matrix = torch.zeros(size, size, dtype=torch.float64)
    taps = torch.tensor(weights, dtype=torch.float64).expand(size, -1)
    return matrix.scatter_add_(1, sources, taps)


def _fit_matrix(size: int, weights: tuple[float, ...]) -> Float[Tensor, "s s"]:
    """The value at each pixel of the line that fits its neighbours best, by weights of their distance."""
    radius = len(weights) // 2
    offsets = torch.arange(size)[None] - torch.arange(size)[:, None]
    taps = torch.tensor(weights, dtype=torch.float64)[(offsets + radius).clamp(0, 2 * radius)]
    taps = torch.where(offsets.abs() <= radius, taps, 0.0)
    zeroth, first, second = ((taps * offsets**power).sum(dim=1, keepdim=True) for power in range(3))
    spread = zeroth * second - first**2
    # Without neighbours there is no slope, and the pixel stays as it is.
    fitted = taps * torch.where(spread > 0, (second - first * offsets) / spread, 1 / zeroth)
    return torch.where(first == 0, taps / zeroth, fitted)
