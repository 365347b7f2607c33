"""Speckles and noise in depth maps that are known to be clean."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.depth_noise import noise_level, smoothed, speckles, with_clean_depth
from extrags.sequence import EndoscopicSequence
from tests.extrags.depth.withheld import recorded
from tests.extrags.test_measured_depth import with_depth

SIZE = (60, 80)


@pytest.fixture
def tilted() -> np.ndarray:
    """A plane, in front of which a step stands; nothing is known in a corner."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = 1 / (0.02 + 1e-4 * u + 5e-5 * v)
    depth[:, 50:] *= 0.5
    depth[:8, :8] = 0
    return np.asarray(depth, dtype=np.float32)


def test_a_clean_map_has_neither(tilted: np.ndarray) -> None:
    assert not speckles(tilted).any()
    assert noise_level(tilted) < 1e-5
    assert noise_level(np.zeros(SIZE, np.float32)) == 0


def test_speckles_are_found_and_nothing_else(tilted: np.ndarray) -> None:
    spoilt = tilted.copy()
    rows, columns = np.array([3, 20, 20, 40, 59, 30]), np.array([30, 10, 70, 50, 79, 49])
    spoilt[rows, columns] *= 1.7
    found = np.zeros(SIZE, bool)
    found[rows, columns] = True
    np.testing.assert_array_equal(speckles(spoilt), found)


@pytest.mark.parametrize("level", [0.02, 0.05])
def test_noise_is_measured_and_taken_out(tilted: np.ndarray, level: float) -> None:
    noise = np.random.default_rng(0).normal(scale=level, size=SIZE)
    noisy = (tilted * np.exp(noise)).astype(np.float32)
    assert noise_level(noisy) == pytest.approx(level, rel=0.1)
    found = smoothed(noisy, level)
    known = tilted > 0
    error = np.log(found[known] / tilted[known])
    assert error.std() < 0.35 * level
    assert not found[~known].any()
    # The step stays where it is.
    step = found[10:, 49] / found[10:, 50]
    np.testing.assert_allclose(step, 2.0, rtol=0.15)


def test_depth_that_is_clean_is_returned_as_it_is(caplog: pytest.LogCaptureFixture) -> None:
    exact = recorded(10, 96, 72)
    assert with_clean_depth(exact) is exact
    bare = exact.without_training_depth()
    assert with_clean_depth(bare) is bare
    assert not caplog.messages


def test_a_sequence_with_speckles_and_noise_is_cleaned(caplog: pytest.LogCaptureFixture) -> None:
    exact: EndoscopicSequence = recorded(10, 96, 72)

    def spoilt(frame: int, depth: np.ndarray) -> np.ndarray:
        generator = np.random.default_rng(frame)
        noisy = depth * np.exp(generator.normal(scale=0.04, size=depth.shape))
        return np.where(generator.random(depth.shape) < 0.05, noisy * 2.5, noisy)

    given = with_depth(exact, spoilt)
    found = with_clean_depth(given)
    assert "are like too few of their neighbours" in caplog.text
    assert "depth has noise of 4." in caplog.text
    assert found.depth_mm is not None
    known = found.depth_mm > 0
    assert known.mean() > 0.9 * (given.depth_mm > 0).mean()
    error = np.abs(np.log(found.depth_mm[known] / exact.depth_mm[known]))
    assert np.quantile(error, 0.99) < 0.1
    assert error.mean() < 0.02
