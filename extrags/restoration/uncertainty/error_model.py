r"""Log-linear model of the error of a restored pixel.

The network's own expectation :math:`b` misses fine texture and the scene's uncertainty, so it is combined
with them by a linear model of logarithms:

.. math:: \log \hat e = w_0 + w_1 \log b + w_2 \log(c + c_0) + w_3 u + w_4 u \log b + w_5 s
          + w_6 \log(d + d_0)

with the local contrast c of the restored image, the uncertainty u of the rendering, the share s that real
views confirm, and the difference d between the restored and the rendered colour.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.view_synthesis.conditioning import Layers

__all__ = ["ErrorModel", "error_features"]

CONTRAST_SIGMA_PX = 2.0
CONTRAST_RADIUS_PX = 6
MIN_CONTRAST = 3e-3
MIN_DIFFERENCE = 5e-3
MIN_ERROR = 2e-3
SOLID = 0.05
"""Rendered colours are compared as if at least this opaque."""
LARGEST_LOG_ERROR = 0.0
"""Colours lie between 0 and 1, and so do their errors."""
FEATURES = 6


@dataclass(frozen=True)
class ErrorModel:
    """Weights of the model; by default the network's own expectation.

    Args:
        weights: w_1 to w_6.
        offset: w_0.
    """

    weights: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    offset: float = 0.0

    @classmethod
    def fitted(cls, features: Float[np.ndarray, "n 6"], error: Float[np.ndarray, "n"]) -> ErrorModel:
        """Least squares on the logarithms of cells.

        Args:
            features: means of `error_features` over cells.
            error: mean absolute errors of these cells.
        """
        table = np.column_stack([features, np.ones(len(features))])
        found = np.linalg.lstsq(table, np.log(error + MIN_ERROR), rcond=None)[0]
        return cls(tuple(found[:-1].tolist()), float(found[-1]))

    def applied(self, features: Float[Tensor, "n 6 h w"]) -> Float[Tensor, "n 1 h w"]:
        """Expected absolute error of each pixel."""
        weights = torch.tensor(self.weights, dtype=features.dtype)
        logarithm = torch.einsum("nfhw,f->nhw", features, weights) + self.offset
        return logarithm.clamp(np.log(MIN_ERROR), LARGEST_LOG_ERROR).exp()[:, None]

    def as_dict(self) -> dict[str, tuple[float, ...] | float]:
        """For JSON."""
        return asdict(self)


def error_features(
    layers: Layers, rgb: Float[Tensor, "n 3 h w"], error: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, "n 6 h w"]:
    """Features of each pixel, in the order of the weights.

    Args:
        layers: input of the restorer.
        rgb: restored image in [0, 1].
        error: the network's own expected error.
    """
    window = gaussian_weights(CONTRAST_SIGMA_PX, CONTRAST_RADIUS_PX)
    gray = rgb.mean(dim=1, keepdim=True)
    mean = filter_separable(gray, window, window)
    variance = filter_separable((gray - mean).square(), window, window)
    predicted_error = error.clamp_min(MIN_ERROR).log()
    uncertainty = layers.get("uncertainty")
    rendered = layers.get("rendered") / layers.get("alpha").clamp_min(SOLID)
    difference = (rendered.clamp(0, 1) - rgb).abs().mean(dim=1, keepdim=True)
    return torch.cat(
        [
            predicted_error,
            (variance.clamp_min(0).sqrt() + MIN_CONTRAST).log(),
            uncertainty,
            uncertainty * predicted_error,
            layers.get("blend_weight"),
            (difference + MIN_DIFFERENCE).log(),
        ],
        dim=1,
    )
