"""Dense optical flow between two small grey pictures, of any size.

Source: Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016 (OpenCV's DIS).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

__all__ = ["DenseFlow"]

_SMALLEST_PX = 32
"""Of pictures with a shorter side OpenCV 5.0 ends the process, or gives NaN."""


class DenseFlow:
    """OpenCV's DIS at its fast preset; keeps its buffers between calls."""

    def __init__(self) -> None:
        import cv2

        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def between(
        self, first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "h w 2"]:
        """Where the pixels of the first picture lie in the second, less their own place, in pixels.

        Pictures that are too small are continued by their last row and column.

        Args:
            first: that keeps its place.
            second: of the same size.

        Returns:
            Columns to the right and rows down, float32.
        """
        height, width = first.shape
        missing = ((0, max(0, _SMALLEST_PX - height)), (0, max(0, _SMALLEST_PX - width)))
        if missing != ((0, 0), (0, 0)):
            first, second = np.pad(first, missing, mode="edge"), np.pad(second, missing, mode="edge")
        found = self._flow.calc(np.ascontiguousarray(first), np.ascontiguousarray(second), None)
        return np.ascontiguousarray(found[:height, :width])
