"""PSNR and SSIM of colour images, whole or inside a mask.

Images are float tensors [..., H, W, 3] with values in [0, 1]. A mean over a batch is the mean of the
values per image. The value of an image whose mask is empty is None.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import ShapeError
from extrags.metrics.filters import filter_figures, filter_separable, gaussian_weights

__all__ = [
    "MAX_PSNR_DB",
    "SSIM_SIGMA_PX",
    "SSIM_WINDOW_PX",
    "channels_first",
    "mean_of_known",
    "means_in_regions",
    "means_per_image",
    "psnr",
    "psnr_in_regions",
    "psnr_per_image",
    "ssim",
    "ssim_in_regions",
    "ssim_map",
]

MAX_PSNR_DB = 100.0
"""PSNR of equal images in dB, instead of infinity, which JSON cannot represent."""
SSIM_WINDOW_PX = 11
SSIM_SIGMA_PX = 1.5
_SSIM_C1 = 0.01**2
_SSIM_C2 = 0.03**2


def psnr(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    mask: Bool[Tensor, "*b h w"] | None = None,
) -> float | None:
    """Peak signal-to-noise ratio in dB, mean over the images of the value per image.

    `10 log10(1 / MSE)` with the mean squared error over the pixels of the mask and the three
    channels, capped at `MAX_PSNR_DB`.

    Args:
        render: images in [0, 1].
        target: images in [0, 1].
        mask: pixels that count; None counts all.

    Returns:
        The mean, or None when no image has a pixel that counts.

    Raises:
        ShapeError: when the arrays do not fit each other.
    """
    return mean_of_known(psnr_per_image(render, target, mask))


def psnr_per_image(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    mask: Bool[Tensor, "*b h w"] | None = None,
) -> list[float | None]:
    """PSNR in dB of each image, in the order of the flattened batch; see `psnr`."""
    _check_pair(render, target, mask)
    squared = (render.double() - target.double()).square().mean(-1)
    smallest = 10 ** (-MAX_PSNR_DB / 10)
    return [
        None if error is None else -10 * math.log10(max(error, smallest))
        for error in means_per_image(squared, mask)
    ]


def psnr_in_regions(
    render: Float[Tensor, "n h w 3"],
    target: Float[Tensor, "n h w 3"],
    regions: dict[str, Bool[Tensor, "n h w"]],
) -> dict[str, list[float | None]]:
    """PSNR in dB of each image inside each region; see `psnr`."""
    return {name: psnr_per_image(render, target, region) for name, region in regions.items()}


def ssim(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    mask: Bool[Tensor, "*b h w"] | None = None,
) -> float | None:
    """Structural similarity, mean over the images of the mean of the map inside the mask.

    The window of a pixel near the mask's edge reaches beyond it; callers who do not want outside
    pixels to count blank them in both images first, as `extrags.metrics.protocol` does.

    Args:
        render: images in [0, 1].
        target: images in [0, 1].
        mask: pixels of the map that count; None counts all.

    Returns:
        The mean in [-1, 1], or None when no image has a pixel that counts.

    Raises:
        ShapeError: when the arrays do not fit each other, or the images are smaller than the window.
    """
    _check_pair(render, target, mask)
    return mean_of_known(means_per_image(ssim_map(render, target), mask))


def ssim_map(
    render: Float[Tensor, "*b h w 3"], target: Float[Tensor, "*b h w 3"], *, figures: bool = True
) -> Float[Tensor, "*b h w"]:
    """SSIM of each pixel, mean of the three channels; borders are mirrored.

    Gaussian window 11 x 11 with sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1, biased variances.

    Args:
        render: images in [0, 1].
        target: images in [0, 1].
        figures: for figures alone, so that large images may be filtered faster, with other last bits.

    Source: Wang et al., Image quality assessment: from error visibility to structural similarity,
    IEEE TIP 2004, equation 13.

    Raises:
        ShapeError: when the images are smaller than the window.
    """
    _check_pair(render, target, None)
    height, width = render.shape[-3:-1]
    if min(height, width) <= SSIM_WINDOW_PX // 2:
        raise ShapeError(f"SSIM needs images larger than {SSIM_WINDOW_PX // 2} px, found {width}x{height}")
    x = channels_first(render)
    y = channels_first(target)
    filtered = filter_figures if figures else filter_separable
    moments = torch.cat([x, y, x * x, y * y, x * y])
    window = gaussian_weights(SSIM_SIGMA_PX, SSIM_WINDOW_PX // 2)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = filtered(moments, window, window).chunk(5)
    square_x, square_y, product = mean_x.square(), mean_y.square(), mean_x * mean_y
    # Rounding can push a variance below zero on flat patches.
    variance_x = (mean_xx - square_x).clamp_min(0)
    variance_y = (mean_yy - square_y).clamp_min(0)
    covariance = mean_xy - product
    similarity = ((2 * product + _SSIM_C1) * (2 * covariance + _SSIM_C2)) / (
        (square_x + square_y + _SSIM_C1) * (variance_x + variance_y + _SSIM_C2)
    )
    return similarity.mean(1).clamp_max(1).reshape(render.shape[:-1])


def means_per_image(
    values: Float[Tensor, "*b h w"], mask: Bool[Tensor, "*b h w"] | None = None
) -> list[float | None]:
    """Mean of a map over the mask, image by image; None where the mask is empty."""
    flat = values.double().reshape(-1, values.shape[-2] * values.shape[-1])
    if mask is None:
        return [float(mean) for mean in flat.mean(1)]
    inside = mask.reshape(flat.shape)
    # `where` instead of a product, so that values outside the mask have no effect even if they are NaN.
    sums = torch.where(inside, flat, torch.zeros_like(flat)).sum(1)
    counts = inside.sum(1)
    return [float(total / count) if count > 0 else None for total, count in zip(sums, counts, strict=True)]


def means_in_regions(
    map_of: Callable[[Tensor, Tensor], Float[Tensor, "n h w"]],
) -> Callable[[Tensor, Tensor, dict[str, Tensor]], dict[str, list[float | None]]]:
    """Make a metric for `Metric.measure` from a function that returns a value per pixel.

    Args:
        map_of: from render and target, [n, h, w, 3] in [0, 1], to a map [n, h, w].

    Returns:
        A function of render, target and regions by name, [n, h, w], that returns the mean of the map per
        image and region, None where the region is empty. The map is computed once for all regions.
    """

    def measure(render: Tensor, target: Tensor, regions: dict[str, Tensor]) -> dict[str, list[float | None]]:
        values = map_of(render, target)
        return {name: means_per_image(values, region) for name, region in regions.items()}

    return measure


def mean_of_known(values: list[float | None]) -> float | None:
    """Mean of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def channels_first(images: Float[Tensor, "*b h w 3"]) -> Float[Tensor, "n 3 h w"]:
    """Images of any leading dimensions as one batch, the way filters take them."""
    return images.reshape(-1, *images.shape[-3:]).movedim(-1, 1)


def _check_pair(render: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if render.ndim < 3 or render.shape[-1] != 3:
        raise ShapeError(f"expected images [..., H, W, 3], found {tuple(render.shape)}")
    if render.shape != target.shape:
        raise ShapeError(f"render {tuple(render.shape)} and target {tuple(target.shape)} differ in shape")
    if mask is not None and mask.shape != render.shape[:-1]:
        raise ShapeError(f"mask {tuple(mask.shape)} does not fit images {tuple(render.shape)}")


ssim_in_regions = means_in_regions(ssim_map)
"""SSIM of each image inside each region; see `ssim`."""
