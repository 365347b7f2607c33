"""Estimated and measured depth of one frame, and of a phantom whose measured depth is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.config import DepthConfig
from extrags.depth.combination import Depth, combined
from extrags.depth.estimate import estimate_depth
from extrags.depth.training_depth import with_training_depth
from tests.extrags.depth.withheld import recorded, true_training_depth, with_points, withheld_phantom
from tests.extrags.test_measured_depth import smoothly_wrong, with_depth, with_depth_error

SIZE = (60, 80)


@pytest.fixture
def truth() -> np.ndarray:
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.asarray(30 + 0.1 * u + 0.2 * v)


def estimated(truth: np.ndarray, error: float) -> Depth:
    """Right in the mean, with noise at single pixels."""
    noise = np.random.default_rng(0).normal(scale=error, size=truth.shape)
    return Depth(truth * np.exp(noise), np.full(truth.shape, error))


def off(depth: Depth, truth: np.ndarray) -> float:
    return float(np.abs(np.log(depth.z / truth)).mean())


def test_a_factor_is_taken_out(truth: np.ndarray) -> None:
    found = combined(estimated(truth, 0.02), Depth(1.08 * truth, np.full(SIZE, 0.05)))
    assert off(found, truth) < 0.01
    assert np.median(found.error) < 0.02


def test_a_smooth_error_is_taken_out(truth: np.ndarray) -> None:
    wrong = Depth(smoothly_wrong(0.05)(3, truth), np.full(SIZE, 0.05))
    found = combined(estimated(truth, 0.02), wrong)
    assert off(found, truth) < 0.4 * off(wrong, truth)
    assert off(found, truth) < 0.9 * off(estimated(truth, 0.02), truth)


def test_an_unsure_estimate_corrects_nothing(truth: np.ndarray) -> None:
    measured = Depth(1.02 * truth, np.full(SIZE, 0.02))
    found = combined(Depth(1.5 * truth, np.full(SIZE, 0.5)), measured)
    assert off(found, measured.z) < 0.01


def test_each_fills_what_the_other_does_not_know(truth: np.ndarray) -> None:
    own, given = estimated(truth, 0.02), Depth(truth.copy(), np.full(SIZE, 0.03))
    own.z[:10], given.z[-10:] = 0, 0
    own.z[:, 0] = given.z[:, 0] = 0
    found = combined(own, given)
    np.testing.assert_allclose(found.z[:10, 1:], given.z[:10, 1:], rtol=1e-6)
    np.testing.assert_allclose(found.z[-10:, 1:], own.z[-10:, 1:], rtol=1e-6)
    assert not found.z[:, 0].any()
    assert not found.error[:, 0].any()


def test_what_contradicts_itself_is_unsure(truth: np.ndarray) -> None:
    given = Depth(truth.copy(), np.full(SIZE, 0.02))
    given.z[20:24, 30:34] *= 1.6
    found = combined(estimated(truth, 0.02), given)
    assert found.error[20:24, 30:34].min() > 0.1
    assert np.median(found.error) < 0.02


def test_a_phantoms_wrong_depth_is_corrected() -> None:
    withheld = with_points(withheld_phantom())
    truth, mask = true_training_depth(withheld), withheld.mask[withheld.train]
    known = (truth > 0) & mask
    wrong = with_depth(recorded(10, 96, 72), smoothly_wrong(0.06))
    given = with_depth_error(replace(wrong, points=withheld.points, points_rgb=withheld.points_rgb))
    settings = DepthConfig(hypotheses=48, sources=4)
    estimate = estimate_depth(given.training_part(), settings)
    alone = estimate_depth(withheld.training_part(), settings)

    def error(depth: np.ndarray) -> float:
        return float(np.abs(np.log(depth[known] / truth[known])).mean())

    assert given.depth_mm is not None
    measured = error(given.depth_mm[given.train])
    assert error(estimate.depth) < 0.7 * min(measured, error(alone.depth))
    assert "% as measured)" in estimate.summary
    # Later stages are given the result, and the evaluation what was measured.
    found = with_training_depth(given, estimate)
    assert found.depth_mm is not None
    np.testing.assert_array_equal(found.depth_mm[found.train], estimate.depth)
    np.testing.assert_array_equal(found.true_depth_mm, wrong.depth_mm)
