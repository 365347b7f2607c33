"""Bounds on the hue of restored images, taken from the real frames of a scene.

Far from its training data a network may produce hues that no tissue has. Brightness is left to the network;
ratios between channels are held within the range of the real frames.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Gamut"]

DARK = 0.1
"""Darker pixels have no reliable hue."""
TAIL = 0.002
"""Share of the pixels cut off at either end."""
MAX_SAMPLES = 1_000_000
"""`torch.quantile` takes no more than 16 million values; a regular subset is as good."""


@dataclass(frozen=True)
class Gamut:
    """Bounds of green / red and blue / red.

    Args:
        green_low: smallest green / red.
        green_high: largest green / red.
        blue_low: smallest blue / red.
        blue_high: largest blue / red.
    """

    green_low: float
    green_high: float
    blue_low: float
    blue_high: float

    @classmethod
    def of_images(cls, images: Float[Tensor, "n 3 h w"], weight: Float[Tensor, "n 1 h w"]) -> Gamut:
        """Bounds of the well-lit, valid pixels; no bounds where there is none.

        Args:
            images: real frames in [0, 1].
            weight: positive where a pixel is valid.
        """
        lit = (weight[:, 0] > 0) & (images.amax(dim=1) > DARK)
        pixels = images.permute(0, 2, 3, 1)[lit]
        pixels = pixels[:: max(1, len(pixels) // MAX_SAMPLES)][:MAX_SAMPLES]
        if len(pixels) == 0:
            return cls(0.0, 1e6, 0.0, 1e6)
        ends = torch.tensor([TAIL, 1 - TAIL])
        red = pixels[:, 0].clamp_min(1e-3)
        green = torch.quantile(pixels[:, 1] / red, ends)
        blue = torch.quantile(pixels[:, 2] / red, ends)
        return cls(float(green[0]), float(green[1]), float(blue[0]), float(blue[1]))

    def bounded(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
        """Images whose luminance stays and whose hue is brought to the nearest bound; in [0, 1]."""
        red = images[:, 0].clamp_min(1e-3)
        green = (images[:, 1] / red).clamp(self.green_low, self.green_high) * red
        blue = (images[:, 2] / red).clamp(self.blue_low, self.blue_high) * red
        moved = torch.stack([red, green, blue], dim=1)
        brightness = images.mean(dim=1, keepdim=True) / moved.mean(dim=1, keepdim=True)
        inside = (moved - images).abs().amax(dim=1, keepdim=True) < 1e-3
        return torch.where(inside, images, moved * brightness).clamp(0, 1)

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)
