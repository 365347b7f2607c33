"""How much fine detail images have: the energy of frequency bands inside a region, against real images."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import ShapeError
from extrags.metrics.filters import filter_separable, gaussian_weights

__all__ = ["BANDS_PX", "band_energies", "detail_ratios"]

BANDS_PX = (1.0, 2.0, 4.0)
"""Standard deviations of the Gaussians whose differences are the bands; the first differs from the image."""
TRUNCATE = 3
MIN_ENERGY = 1e-10
MIN_WEIGHT = 1e-6
"""Of a filter, inside: where there is less, no pixel of a region lies."""


def band_energies(
    images: Float[Tensor, "n h w 3"],
    region: Bool[Tensor, "_ _ _"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> list[float] | None:
    """Mean square of the luminance in each band, finest first.

    Args:
        images: in [0, 1].
        region: pixels that count.
        valid: pixels that filters may look at, as the image goes on beyond its border: all where None. They
            are weighted means of these (normalised convolution, [Knutsson1993]), so that neither what lies
            outside nor the edge counts.

    Returns:
        One energy per band; None where no pixel counts.

    Raises:
        ShapeError: when the sizes differ.
    """
    if images.shape[:-1] != region.shape:
        raise ShapeError(f"images {tuple(images.shape)} and region {tuple(region.shape)} do not fit")
    if not bool(region.any()):
        return None
    level = images.double().mean(dim=-1)[:, None]
    inside = torch.ones_like(level) if valid is None else valid[:, None].to(level)
    energies = []
    for sigma in BANDS_PX:
        window = gaussian_weights(sigma, int(TRUNCATE * sigma))
        smooth = filter_separable(level * inside, window, window)
        if valid is not None:
            smooth = smooth / filter_separable(inside, window, window).clamp_min(MIN_WEIGHT)
        energies.append(float((level - smooth)[:, 0][region].square().mean()))
        level = smooth
    return energies


def detail_ratios(
    images: Float[Tensor, "n h w 3"],
    real: Float[Tensor, "n h w 3"],
    region: Bool[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> list[float] | None:
    """Energy of each band relative to that of real images: 1 as sharp as these, 0 smooth, above 1 rougher.

    Args:
        images: in [0, 1].
        real: images of the same views.
        region: pixels that count.
        valid: as in `band_energies`.
    """
    own, true = band_energies(images, region, valid), band_energies(real, region, valid)
    if own is None or true is None:
        return None
    return [one / max(other, MIN_ENERGY) for one, other in zip(own, true, strict=True)]
