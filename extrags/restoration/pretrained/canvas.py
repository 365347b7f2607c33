"""Resizing and padding from a clip's image size to a model's, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

__all__ = ["Canvas"]

TOUCHED = 0.01
"""A resized mask holds every pixel whose share of the original is at least this; too large is harmless."""


@dataclass(frozen=True)
class Canvas:
    """Images are resized to the inner size and their border is repeated up to the outer one.

    Args:
        width: of the clip's images, in pixels.
        height: of the clip's images.
        inner_width: after resizing.
        inner_height: after resizing.
        outer_width: with the repeated border.
        outer_height: with the repeated border.
    """

    width: int
    height: int
    inner_width: int
    inner_height: int
    outer_width: int
    outer_height: int

    @classmethod
    def fitted(cls, width: int, height: int, *, short_side_px: int, multiple: int) -> Canvas:
        """A size that keeps the aspect, with sides that are multiples of `multiple` after padding."""
        scale = short_side_px / min(width, height)
        inner = max(1, round(width * scale)), max(1, round(height * scale))
        outer = -(-inner[0] // multiple) * multiple, -(-inner[1] // multiple) * multiple
        return cls(width, height, *inner, *outer)

    @classmethod
    def stretched(cls, width: int, height: int, to_width: int, to_height: int) -> Canvas:
        """A fixed size; the aspect changes."""
        return cls(width, height, to_width, to_height, to_width, to_height)

    def placed(self, images: Float[np.ndarray, "t h w c"]) -> Float[np.ndarray, "t hh ww c"]:
        """Images at the model's size, in [0, 1]."""
        resized = _resized(images, (self.inner_height, self.inner_width))
        return np.pad(resized, ((0, 0), *self._margins(), (0, 0)), mode="edge")

    def placed_mask(self, mask: Bool[np.ndarray, "t h w"]) -> Bool[np.ndarray, "t hh ww"]:
        """A mask at the model's size; never smaller than the original."""
        return self.placed(mask[..., None].astype(np.float32))[..., 0] > TOUCHED

    def cut(self, images: Float[np.ndarray, "t hh ww c"]) -> Float[np.ndarray, "t h w c"]:
        """Images back at the clip's size, in [0, 1]."""
        (top, _), (left, _) = self._margins()
        inner = images[:, top : top + self.inner_height, left : left + self.inner_width]
        return _resized(inner, (self.height, self.width))

    def _margins(self) -> tuple[tuple[int, int], tuple[int, int]]:
        rows, columns = self.outer_height - self.inner_height, self.outer_width - self.inner_width
        return (rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2)


def _resized(images: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if images.shape[1:3] == size:
        return np.asarray(images, dtype=np.float32)
    stack: Tensor = torch.from_numpy(np.ascontiguousarray(images, dtype=np.float32)).permute(0, 3, 1, 2)
    # Antialiased, because a model's result usually comes back smaller.
    resized = functional.interpolate(stack, size=size, mode="bicubic", antialias=True, align_corners=False)
    return resized.clamp(0, 1).permute(0, 2, 3, 1).contiguous().numpy()
