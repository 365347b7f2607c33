"""Rotations as they stand in pose files."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from extrags.cameras import as_rotation
from extrags.errors import PoseError

__all__ = ["quaternion_rotation"]


def quaternion_rotation(
    quaternion: list[float], *, file: object = None, frame: object = None
) -> Float[np.ndarray, "3 3"]:
    """Rotation of a quaternion (x, y, z, w), normalised.

    Raises:
        PoseError: the quaternion is not finite, or its length is not 1 up to rounding.
    """
    x, y, z, w = quaternion
    length = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not np.isfinite(length) or abs(length - 1) > 0.01:
        raise PoseError(
            f"quaternion of length {length:.4g}, expected 1", file=file, frame=frame, field="orientation"
        )
    x, y, z, w = (part / length for part in (x, y, z, w))
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return as_rotation(matrix, file=file, frame=frame)
