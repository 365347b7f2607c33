"""Dense flow of pictures of any size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from extrags.dense_flow import DenseFlow


def moved_by_two(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(0).integers(0, 255, (height, width + 2)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    grey = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    return grey[:, 2:].copy(), grey[:, :-2].copy()


@pytest.mark.parametrize(("width", "height"), [(192, 16), (192, 31), (320, 16), (100, 20), (24, 160)])
def test_flat_and_narrow_pictures(width, height) -> None:
    """OpenCV alone ends the process for the first four, or gives NaN."""
    first, second = moved_by_two(width, height)
    flow = DenseFlow().between(first, second)
    assert flow.shape == (height, width, 2)
    assert np.median(flow[..., 0]) == pytest.approx(2, abs=0.3)
    assert np.median(np.abs(flow[..., 1])) < 0.3


def test_others_are_opencvs() -> None:
    first, second = moved_by_two(80, 40)
    expected = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(first, second, None)
    np.testing.assert_array_equal(DenseFlow().between(first, second), expected)
