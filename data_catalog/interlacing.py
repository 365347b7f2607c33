"""Interlaced pictures: two half pictures of different moments, woven line by line.

Whether a recording is interlaced is read off its pictures, since flags in headers are wrong as often as not.
Where something moved between the two moments, neighbouring lines differ more than lines two apart; in a
picture of one moment they never do, over more than a few pixels.

A woven picture shows two camera poses at once. It is replaced by the half picture of one moment, its missing
lines interpolated: half the vertical detail, but one pose.

Source: De Haan and Bellers, "Deinterlacing - an overview", Proceedings of the IEEE 1998, on what
interpolation inside one half picture keeps and loses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

__all__ = ["deinterlaced", "is_combed", "is_interlaced"]

_BLOCK_PX = 16
_COMB_RATIO = 1.3
"""Neighbouring lines differ so many times as much as lines two apart; under noise alone it is one."""
_VISIBLE_STEP = 3.0
"""Grey values between neighbouring lines below which a block tells nothing."""
_COMBED_BLOCKS = 0.05
_COMBED_FRAMES = 0.1
_MIN_HEIGHT = 200
"""No interlaced standard has fewer lines; what was shrunk to less is no longer woven."""


def is_combed(rgb: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Whether a picture shows two moments: at least 5 % of its textured blocks of 16 pixels are combed."""
    height, width = rgb.shape[:2]
    rows, columns = (height - 2) // _BLOCK_PX, width // _BLOCK_PX
    if height < _MIN_HEIGHT or columns == 0:
        return False
    # Of every second column: neighbours hold nearly the same.
    green = rgb[: rows * _BLOCK_PX + 2, : columns * _BLOCK_PX : 2, 1].astype(np.int16)

    def in_blocks(distance: int) -> np.ndarray:
        steps = np.abs(green[distance : distance + rows * _BLOCK_PX] - green[: rows * _BLOCK_PX])
        return np.asarray(steps.reshape(rows, _BLOCK_PX, columns, -1).mean(axis=(1, 3)))

    one, two = in_blocks(1), in_blocks(2)
    textured = one > _VISIBLE_STEP
    combed = textured & (one > _COMB_RATIO * two)
    return bool(combed.sum() > max(1.0, _COMBED_BLOCKS * textured.sum()))


def is_interlaced(combed: Sequence[bool]) -> bool:
    """Whether a recording is: at least a tenth of its looked-at frames are combed.

    Frames of a scope that stands still are not, interlaced or not.
    """
    return len(combed) > 0 and float(np.mean(combed)) >= _COMBED_FRAMES


def deinterlaced(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The lines 0, 2, 4, ... as they are, the lines between them interpolated (four taps, cubic).

    No line moves: pixel centres stay where they are.
    """
    kept = rgb[::2].astype(np.int16)
    count = rgb.shape[0] // 2
    above, below = kept[:count], np.concatenate([kept[1:], kept[-1:]])[:count]
    higher = np.concatenate([kept[:1], kept])[:count]
    lower = np.concatenate([kept[2:], kept[-1:], kept[-1:]])[:count]
    whole = rgb.copy()
    between = (9 * (above + below) - higher - lower + 8) // 16
    whole[1::2] = np.clip(between, 0, 255).astype(np.uint8)
    return whole
