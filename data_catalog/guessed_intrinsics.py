"""Intrinsics of images that nothing states: a usual field of view, through the round picture's centre."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from data_catalog.content import content_circle

__all__ = ["ASSUMED_FIELD_OF_VIEW_DEG", "fitted_to_picture", "intrinsics_of_field_of_view"]

ASSUMED_FIELD_OF_VIEW_DEG = 90.0
"""Near the middle of what endoscopes have: 70 (laparoscopes) to 170 degrees (capsules, duodenoscopes)."""

_MAX_OFFSET_SHARE = 0.2
"""A round picture whose centre is farther from the image's middle, in widths, is no lens's rim."""


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
    K: Float[np.ndarray, "f 3 3"], mask: Bool[np.ndarray, "f h w"]
) -> Float[np.ndarray, "f 3 3"]:
    """A guess of intrinsics that respects the round picture inside the frame, where there is one.

    The stop that cuts the picture out sits on the optical axis: the circle's centre is the better guess of
    the principal point. Where the circle is narrower than the image, the assumed field of view is the
    circle's.

    Args:
        K: guessed from the image's size, in pixels.
        mask: where frames show tissue.
    """
    import cv2

    seen = np.asarray(np.any(mask, axis=0)).astype(np.uint8)
    rows, width = seen.shape
    # The rim is a circle where pixels are square.
    height = max(1, round(rows * K[0, 0, 0] / K[0, 1, 1]))
    if height != rows:
        seen = cv2.resize(seen, (width, height), interpolation=cv2.INTER_NEAREST)
    circle = content_circle(np.repeat(seen[None, :, :, None] * 255, 3, axis=3))
    if circle is None:
        return K
    offset = max(abs(circle.center_x - width / 2), abs(circle.center_y - height / 2))
    if offset > _MAX_OFFSET_SHARE * width:
        return K
    fitted = K.copy()
    fitted[:, 0, 2], fitted[:, 1, 2] = circle.center_x, circle.center_y * rows / height
    narrower = min(1.0, 2 * circle.radius_px / width)
    fitted[:, 0, 0] *= narrower
    fitted[:, 1, 1] *= narrower
    return fitted
