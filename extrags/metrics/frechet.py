"""Fréchet distance of deep features: whether restored views have the texture of real ones.

Unlike a distance of image pairs it does not ask for the same texture at the same place, but for the same
kinds of it equally often. Features are those of LPIPS's backbone, one vector per cell of the layer, so that a
few images and parts of images suffice; figures are comparable for the same backbone, layer and number of
vectors only, and not with the literature's FID, whose Inception network sees whole images.

Source: [Heusel2017, eq. 6].
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.errors import ShapeError
from extrags.metrics.lpips import Lpips

__all__ = ["cell_features", "frechet_distance"]

LAYER = 2
"""The third of LPIPS's layers: texture, not yet objects."""
MIN_SHARE = 0.5
"""Cells count that lie in the region with at least so much of their area."""
MIN_VECTORS = 32
RIDGE = 1e-6


def cell_features(
    lpips: Lpips, images: Float[Tensor, "n h w 3"], region: Bool[Tensor, "n h w"]
) -> Float[np.ndarray, "m c"]:
    """Features of the cells inside a region.

    Args:
        lpips: whose backbone is used.
        images: in [0, 1].
        region: pixels that count.
    """
    found = []
    with torch.inference_mode():
        for image, inside in zip(images.split(4), region.split(4), strict=True):
            for index, activation in enumerate(lpips.activations(image)):
                if index == LAYER:
                    share = functional.adaptive_avg_pool2d(
                        inside[:, None].to(activation), (activation.shape[-2], activation.shape[-1])
                    )[:, 0]
                    found.append(activation.permute(0, 2, 3, 1)[share >= MIN_SHARE])
                    break
    return np.asarray(torch.cat(found).double().numpy())


def frechet_distance(first: Float[np.ndarray, "m c"], second: Float[np.ndarray, "n d"]) -> float | None:
    """Distance of two sets of vectors, each taken for a normal distribution.

    Args:
        first: vectors.
        second: other vectors of the same length.

    Returns:
        Squared distance of the means plus that of the covariances; None with fewer than 32 vectors in
        either set.

    Raises:
        ShapeError: when the vectors have different lengths.
    """
    if first.shape[1] != second.shape[1]:
        raise ShapeError(f"features of {first.shape[1]} and of {second.shape[1]} channels are not comparable")
    if min(len(first), len(second)) < MIN_VECTORS:
        return None
    shift = first.mean(axis=0) - second.mean(axis=0)
    one, other = (np.cov(part, rowvar=False) + RIDGE * np.eye(part.shape[1]) for part in (first, second))
    # tr (A B)^(1/2) from the symmetric A^(1/2) B A^(1/2), whose eigenvalues are real and not negative.
    values, vectors = np.linalg.eigh(one)
    root = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    mixed = np.linalg.eigvalsh(root @ other @ root).clip(min=0)
    return float(shift @ shift + np.trace(one) + np.trace(other) - 2 * np.sqrt(mixed).sum())
