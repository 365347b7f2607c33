"""Depth errors by hand."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.metrics.depth import depth_errors


def test_by_hand() -> None:
    truth = np.array([[10.0, 20.0, 0.0, np.nan, 40.0]])
    found = np.array([[11.0, 30.0, 5.0, 5.0, 0.0]])
    errors = depth_errors(found, truth)
    assert errors is not None
    assert errors.n_pixels == 2
    assert errors.absrel == pytest.approx((0.1 + 0.5) / 2)
    assert errors.rmse == pytest.approx(np.sqrt((1 + 100) / 2))
    assert errors.delta125 == 0.5
    assert errors.coverage == pytest.approx(2 / 3)


def test_delta_takes_the_ratio_either_way() -> None:
    truth = np.array([[10.0, 10.0, 10.0, 10.0]])
    errors = depth_errors(np.array([[12.4, 12.6, 8.1, 7.9]]), truth)
    assert errors is not None
    assert errors.delta125 == 0.5


def test_nothing_to_compare_has_no_value() -> None:
    some = np.ones((2, 3))
    assert depth_errors(some, some, np.zeros((2, 3), dtype=bool)) is None
    assert depth_errors(0 * some, some) is None
    assert depth_errors(some, np.nan * some) is None


def test_mask() -> None:
    truth = np.full((1, 4), 10.0)
    found = np.array([[10.0, 10.0, 90.0, np.inf]])
    errors = depth_errors(found, truth, np.array([[True, True, False, True]]))
    assert errors is not None
    assert errors.absrel == 0
    assert errors.coverage == pytest.approx(2 / 3)
