"""Intrinsics of images that nothing states: a usual field of view, through the centre of the picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.content import Circle, FramedPicture, content_circle, framed_picture

__all__ = ["ASSUMED_FIELD_OF_VIEW_DEG", "fitted_to_picture", "intrinsics_of_field_of_view"]

ASSUMED_FIELD_OF_VIEW_DEG = 90.0
"""Near the middle of what endoscopes have: 70 (laparoscopes) to 170 degrees (capsules, duodenoscopes)."""

_MAX_OFFSET_SHARE = 0.2
"""A round picture whose centre is farther from the image's middle, in widths, is no lens's rim, unless a
clear dark surround says so."""
_SAME_RIM_SHARE = 0.03
"""Of the width: so near to a circle's ends a picture ends whose rim it is."""


def intrinsics_of_field_of_view(
    angle_deg: float, width: int, height: int, *, pixel_aspect: float = 1.0
) -> Float[np.ndarray, "3 3"]:
    """K of a centred pinhole.

    Args:
        angle_deg: horizontal field of view.
        width: of the images, in pixels.
        height: of the images, in pixels.
        pixel_aspect: width of a pixel over its height.
    """
    focal = width / 2 / np.tan(np.radians(angle_deg) / 2)
    return np.array([[focal, 0, width / 2], [0, focal * pixel_aspect, height / 2], [0, 0, 1.0]])


def fitted_to_picture(
    K: Float[np.ndarray, "f 3 3"], mask: Bool[np.ndarray, "f h w"], rgb: UInt8[np.ndarray, "f h w 3"]
) -> Float[np.ndarray, "f 3 3"]:
    """A guess of intrinsics that respects the picture inside the frame, where it does not fill it.

    The stop that cuts a round picture out sits on the optical axis: the circle's centre is the better guess
    of the principal point. Where the circle is narrower than the image, the assumed field of view is the
    circle's. Of a picture of another outline, or far from the image's middle as beside a recorder's panel,
    centre and width are those of its box, where its dark surround is clear.

    Args:
        K: of a field of view over the image's width, in pixels.
        mask: where frames show tissue.
        rgb: the frames.
    """
    import cv2

    seen = np.asarray(np.any(mask, axis=0)).astype(np.uint8)
    rows, width = seen.shape
    # The rim is a circle where pixels are square.
    height = max(1, round(rows * K[0, 0, 0] / K[0, 1, 1]))
    if height != rows:
        seen = cv2.resize(seen, (width, height), interpolation=cv2.INTER_NEAREST)
    circle = content_circle(np.repeat(seen[None, :, :, None] * 255, 3, axis=3))
    in_circle = None
    if circle is not None:
        center = circle.center_x, circle.center_y * rows / height
        in_circle = _fitted(K, center, 2 * circle.radius_px / width)
        offset = max(abs(circle.center_x - width / 2), abs(circle.center_y - height / 2))
        if offset <= _MAX_OFFSET_SHARE * width:
            return in_circle
    picture = framed_picture(mask, rgb)
    if picture is None:
        return K
    # The image may cut a round picture off, more above than below: its box has another centre then.
    if circle is not None and in_circle is not None and _is_its_rim(circle, picture, (width, rows, height)):
        return in_circle
    return _fitted(K, picture.center, picture.width / width)


def _is_its_rim(circle: Circle, picture: FramedPicture, sizes: tuple[int, int, int]) -> bool:
    """Whether a picture ends where a circle does, or the image.

    Args:
        circle: in an image of square pixels.
        picture: in the image as it is.
        sizes: columns and rows of the image, and its rows where pixels are square.
    """
    width, rows, height = sizes
    x, y, radius = circle.center_x, circle.center_y, circle.radius_px
    ends = np.array([max(x - radius, 0), min(x + radius, width), max(y - radius, 0), min(y + radius, height)])
    found = np.array([picture.left, picture.left + picture.width, picture.top, picture.top + picture.height])
    found = found * np.array([1, 1, height / rows, height / rows])
    return bool((np.abs(ends - found) <= _SAME_RIM_SHARE * width).all())


def _fitted(
    K: Float[np.ndarray, "f 3 3"], center: tuple[float, float], width_share: float
) -> Float[np.ndarray, "f 3 3"]:
    """K through another centre, whose field of view is that of a part of the image's width."""
    fitted = K.copy()
    fitted[:, :2, 2] = center
    narrower = min(1.0, width_share)
    fitted[:, 0, 0] *= narrower
    fitted[:, 1, 1] *= narrower
    return fitted
