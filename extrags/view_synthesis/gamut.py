"""Bounds on the hue of restored images, taken from the real frames of a scene.

Far from its training data a network may produce hues that no tissue has. Brightness is left to the network;
ratios between channels are held within the range of the real frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Frame", "Gamut"]

DARK = 0.1
"""Darker pixels have no reliable hue."""
TAIL = 0.002
"""Share of the pixels cut off at either end."""
MAX_SAMPLES = 1_000_000
"""`torch.quantile` takes no more than 16 million values; a regular subset of all pixels is as good."""

Frame = tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]
"""An image in [0, 1], and where it is valid."""


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
        return cls.of_frames(lambda index: (images[index], weight[index]), len(images))

    @classmethod
    def of_frames(cls, frame: Callable[[int], Frame], count: int) -> Gamut:
        """As `of_images`, of frames that are made one at a time: no more than one of them is in memory.

        Args:
            frame: real frame and its weight, by index; called twice for each.
            count: how many frames there are.
        """
        lit = sum(len(_lit_pixels(*frame(index))) for index in range(count))
        step = max(1, math.ceil(lit / MAX_SAMPLES))
        parts: list[Float[Tensor, "p 3"]] = []
        passed = 0
        for index in range(count):
            found = _lit_pixels(*frame(index))
            # The pixels of all frames are counted through, so that each frame has its share.
            parts.append(found[-passed % step :: step])
            passed += len(found)
        if lit == 0:
            return cls(0.0, 1e6, 0.0, 1e6)
        pixels = torch.cat(parts)
        ends = pixels.new_tensor([TAIL, 1 - TAIL])
        red = pixels[:, 0].clamp_min(1e-3)
        green = torch.quantile(pixels[:, 1] / red, ends)
        blue = torch.quantile(pixels[:, 2] / red, ends)
        return cls(float(green[0]), float(green[1]), float(blue[0]), float(blue[1]))

    def bounded(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
        """Images whose hue is brought to the nearest bound; in [0, 1].

        Brightness, the mean over the channels, stays, except where the nearest hue is not to be had that
        bright: there the pixel is as bright as it can be. Pixels within the bounds stay as they are.

        Args:
            images: in [0, 1].
        """
        red = images[:, 0].clamp_min(1e-3)
        green = (images[:, 1] / red).clamp(self.green_low, self.green_high) * red
        blue = (images[:, 2] / red).clamp(self.blue_low, self.blue_high) * red
        moved = torch.stack([red, green, blue], dim=1)
        inside = (moved - images).abs().amax(dim=1, keepdim=True) < 1e-3
        moved = moved * (images.mean(dim=1, keepdim=True) / moved.mean(dim=1, keepdim=True))
        # All channels alike: to cut off the one that is too bright would change the hue again.
        moved = moved / moved.amax(dim=1, keepdim=True).clamp_min(1)
        return torch.where(inside, images, moved).clamp(0, 1)

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


def _lit_pixels(image: Float[Tensor, "3 h w"], weight: Float[Tensor, "1 h w"]) -> Float[Tensor, "p 3"]:
    """Colours of the pixels that are valid and bright enough to have a hue."""
    return image.permute(1, 2, 0)[(weight[0] > 0) & (image.amax(dim=0) > DARK)]
