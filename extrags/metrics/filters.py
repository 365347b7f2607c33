"""Separable image filters as two small matrix products.

At the sizes metrics are taken (a few hundred pixels) multiplying by a banded [W, W] matrix is several
times faster on a CPU than a convolution of eleven taps; the matrix also implements the border rule.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["BorderRule", "filter_separable", "gaussian_weights"]

BorderRule = Literal["reflect", "replicate"]


def filter_separable(
    maps: Float[Tensor, "*b h w"],
    weights_x: tuple[float, ...],
    weights_y: tuple[float, ...],
    border: BorderRule = "reflect",
) -> Float[Tensor, "*b h w"]:
    """Correlate each map with the outer product of two odd-length rows of weights.

    Args:
        maps: any number of maps.
        weights_x: weights along the width, centre in the middle.
        weights_y: weights along the height.
        border: `reflect` mirrors about the border pixel (which is not repeated), `replicate`
            repeats the border pixel.

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


# A cached tensor may be created in inference mode and used with autograd later.
@lru_cache(maxsize=128)
@torch.inference_mode(False)
def _filter_matrix(size: int, weights: tuple[float, ...], border: BorderRule) -> Float[Tensor, "s s"]:
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
