"""Intrinsics that are possible but unlikely for images of a size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from data_catalog.content import FramedPicture
from data_catalog.sampling import OFF_CENTRE_SHARE

__all__ = ["another_size", "unlikely"]

_ALIKE = 0.1
"""Both coordinates of a principal point are as far off, to this share of the image's half."""
_LARGER, _SMALLER = 1.4, 0.7
_ON_ITS_SIDE = 0.02
"""A principal point is so near, in shares of the image's sides, to the centre of the image on its side."""
_SQUEEZED = 1.15
_WIDEST_DEG, _NARROWEST_DEG = 150, 15


def another_size(K: Float[np.ndarray, "3 3"], width: int, height: int) -> str | None:
    """What is wrong with K, where its principal point is the centre of an image of another size."""
    cx, cy = K[0, 2], K[1, 2]
    across, down = 2 * cx / width, 2 * cy / height
    if abs(across - down) >= _ALIKE or _SMALLER <= across <= _LARGER:
        return None
    return (
        f"the principal point ({cx:.1f}, {cy:.1f}) is the centre of an image {across:.2g} times as large as "
        f"this one of {width} x {height} pixels: K belongs to another size. Divide its first two rows by "
        f"{across:.2g}"
    )


def unlikely(
    K: Float[np.ndarray, "3 3"], width: int, height: int, picture: FramedPicture | None = None
) -> str | None:
    """The first thing about K that images of this size hardly ever have; None where it looks right.

    Args:
        K: of the images.
        width: of the images, in pixels.
        height: of the images, in pixels.
        picture: the part of the images that shows something, where it has a clear dark surround: lenses are
            centred in it, wherever in the images it lies.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    shown = FramedPicture(0, 0, width, height) if picture is None else picture
    across, down = abs(cx - shown.center[0]) / shown.width, abs(cy - shown.center[1]) / shown.height
    is_central = max(across, down) <= OFF_CENTRE_SHARE
    if (picture is None or not is_central) and (problem := another_size(K, width, height)) is not None:
        return problem
    if (picture is None or not is_central) and _is_of_turned(cx, cy, width, height):
        return (
            f"the principal point ({cx:.1f}, {cy:.1f}) is the centre of an image of {height} x {width} "
            f"pixels, and this one has {width} x {height}: K belongs to the image before or after a quarter "
            "turn. Exchange fx and fy, and give the principal point of the image that is read"
        )
    if not is_central:
        where = (
            ""
            if picture is None
            else f" that the picture fills in the image, whose columns begin at {picture.left} and rows at "
            f"{picture.top}"
        )
        return (
            f"the principal point ({cx:.1f}, {cy:.1f}) lies far from the centre of {shown.width} x "
            f"{shown.height} pixels{where}. Was the image cropped, or are cx and cy swapped?"
        )
    if not 1 / _SQUEEZED < fx / fy < _SQUEEZED:
        return (
            f"fx = {fx:.1f} and fy = {fy:.1f} px differ by {abs(fx / fy - 1):.0%}; pixels are nearly "
            "square in all endoscopes. Was the image squeezed?"
        )
    angle = 2 * np.degrees(np.arctan(shown.width / 2 / fx))
    if angle > _WIDEST_DEG or angle < _NARROWEST_DEG:
        return (
            f"fx = {fx:.1f} px means a field of view of {angle:.0f} degrees for {shown.width} pixels; "
            "endoscopes have 40 to 140 as a pinhole. Does fx belong to another image size?"
        )
    return None


def _is_of_turned(cx: float, cy: float, width: int, height: int) -> bool:
    """Whether a principal point is the centre of the image after a quarter turn, and not of the image."""
    near = abs(2 * cx - height) < _ON_ITS_SIDE * height and abs(2 * cy - width) < _ON_ITS_SIDE * width
    return near and abs(width - height) > 4 * _ON_ITS_SIDE * max(width, height)
