"""Depth errors by hand and against torchmetrics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.metrics.depth import DepthErrors, depth_errors


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
    at_the_limit = depth_errors(np.array([[12.5, 8.0, 10.0, 10.0]]), truth)
    assert at_the_limit is not None
    assert at_the_limit.delta125 == 0.5


@pytest.mark.parametrize("unit", [2.0**-12, 2.0**12])
def test_shares_do_not_depend_on_the_unit(unit: float) -> None:
    truth = np.array([[10.0, 20.0, 0.0, np.nan, 40.0]])
    found = np.array([[11.0, 30.0, 5.0, 5.0, 0.0]])
    errors, scaled = depth_errors(found, truth), depth_errors(found * unit, truth * unit)
    assert errors is not None
    assert errors.rmse is not None
    assert scaled == replace(errors, rmse=errors.rmse * unit)


def test_nothing_to_compare_has_no_value() -> None:
    some = np.ones((2, 3))
    assert depth_errors(some, some, np.zeros((2, 3), dtype=bool)) is None
    assert depth_errors(some, np.nan * some) is None


def test_where_nothing_was_rendered_nothing_is_covered() -> None:
    some = np.ones((2, 3))
    assert depth_errors(0 * some, some) == DepthErrors(None, None, None, 0.0, 0)


def test_mask() -> None:
    truth = np.full((1, 4), 10.0)
    found = np.array([[10.0, 10.0, 90.0, np.inf]])
    errors = depth_errors(found, truth, np.array([[True, True, False, True]]))
    assert errors is not None
    assert errors.absrel == 0
    assert errors.coverage == pytest.approx(2 / 3)


def test_agrees_with_torchmetrics() -> None:
    import torch
    from torchmetrics.functional import mean_absolute_percentage_error, mean_squared_error

    rng = np.random.default_rng(0)
    truth = rng.uniform(5, 80, (3, 20, 30))
    found = truth * rng.lognormal(0, 0.2, truth.shape)
    mask = rng.random(truth.shape) < 0.7
    errors = depth_errors(found, truth, mask)
    assert errors is not None
    rendered, true = torch.from_numpy(found[mask]), torch.from_numpy(truth[mask])
    assert errors.absrel == pytest.approx(float(mean_absolute_percentage_error(rendered, true)), rel=1e-6)
    assert errors.rmse == pytest.approx(float(mean_squared_error(rendered, true, squared=False)), rel=1e-6)
    # Within a factor of 1.25 either way: |log ratio| below log 1.25.
    near = np.isclose(np.log(found[mask]), np.log(truth[mask]), rtol=0, atol=np.log(1.25))
    assert errors.delta125 == pytest.approx(near.mean(), abs=1e-12)
