"""Other colours for a crop and everything that it shows: a restorer has to keep those of its input."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Recoloring", "hue_rotation"]

EXPOSURE_DEVIATION = 0.3
BALANCE_DEVIATION = 0.1
"""Of the logarithm of a common gain and of one for each channel. They are large because virtual views are
nearer to the wall than real ones: the restorer has to keep the colour of its input, not the mean of the
scene."""
HUE_DEVIATION_RAD = math.radians(40)
SATURATION_DEVIATION = 0.4
CONTRAST_DEVIATION = 0.15
"""Of the angle about the grey axis, and of the logarithms of the factor of saturation and of the exponent, at
a variety of one."""
MOST_SATURATION = 1.5


@dataclass(frozen=True)
class Recoloring:
    """A gain, then a mixture of the channels, then an exponent.

    Args:
        gain: of each channel, [1, 3, 1, 1].
        mixing: of the channels, [3, 3]; None leaves them.
        exponent: of colours in [0, 1].
    """

    gain: Float[Tensor, "1 3 1 1"]
    mixing: Float[Tensor, "3 3"] | None = None
    exponent: float = 1.0

    @classmethod
    def drawn(cls, generator: np.random.Generator, variety: float = 0.0) -> Recoloring:
        """Another exposure and another white balance, and more.

        Args:
            generator: of the draws; without variety there are as many as there always were.
            variety: how far hue, saturation and contrast differ; 0 leaves them, 1 shows tissue in any colour.
        """
        exposure = generator.normal(0, EXPOSURE_DEVIATION)
        gains = np.exp(exposure + generator.normal(0, BALANCE_DEVIATION, 3)).astype(np.float32)
        gain = torch.from_numpy(gains)[None, :, None, None]
        if variety == 0:
            return cls(gain)
        angle, saturation, contrast = generator.normal(0, variety, 3)
        factor = min(math.exp(SATURATION_DEVIATION * saturation), MOST_SATURATION)
        mixing = _saturation(factor) @ hue_rotation(HUE_DEVIATION_RAD * angle)
        return cls(gain, torch.from_numpy(mixing.astype(np.float32)), math.exp(CONTRAST_DEVIATION * contrast))

    def applied(self, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
        """The colours of an image, in [0, 1]."""
        gained = (image * self.gain).clamp(0, 1)
        if self.mixing is not None:
            gained = torch.einsum("ij,njhw->nihw", self.mixing, gained).clamp(0, 1)
        return gained if self.exponent == 1 else gained**self.exponent


def hue_rotation(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about the grey axis (Rodrigues)."""
    axis = np.full(3, 1 / math.sqrt(3))
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned: Float[np.ndarray, "3 3"] = (
        np.eye(3) + math.sin(angle_rad) * cross + (1 - math.cos(angle_rad)) * cross @ cross
    )
    return turned


def _saturation(factor: float) -> Float[np.ndarray, "3 3"]:
    """Distance from grey, of the same mean, times a factor."""
    return factor * np.eye(3) + (1 - factor) * np.full((3, 3), 1 / 3)
