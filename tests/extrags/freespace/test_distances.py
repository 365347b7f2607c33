from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from extrags.freespace.distances import box_around, distance_to_cubes, signed_distance


def brute_force(marked: np.ndarray) -> np.ndarray:
    index = np.argwhere(np.ones_like(marked))
    gap = np.maximum(np.abs(index[:, None] - np.argwhere(marked)[None]) - 0.5, 0)
    return np.sqrt((gap**2).sum(axis=-1)).min(axis=1).reshape(marked.shape)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.002, 0.9))
def test_agrees_with_brute_force(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    marked = rng.random((9, 7, 8)) < share
    marked[tuple(rng.integers(0, 7, 3))] = True
    exact = brute_force(marked)
    np.testing.assert_allclose(distance_to_cubes(marked), exact, rtol=1e-6)
    np.testing.assert_allclose(distance_to_cubes(marked, 2.2), np.minimum(exact, 2.2), rtol=1e-6)


def test_signed_is_negative_inside() -> None:
    marked = np.zeros((9, 9, 9), bool)
    marked[2:7, 2:7, 2:7] = True
    signed = signed_distance(marked, 10.0, 10.0)
    assert signed[4, 4, 4] == pytest.approx(-2.5)
    assert signed[2, 4, 4] == pytest.approx(-0.5)
    assert signed[1, 4, 4] == pytest.approx(0.5)
    assert signed[1, 1, 1] == pytest.approx(0.5 * np.sqrt(3))
    np.testing.assert_array_equal(signed < 0, marked)


def test_none_marked_is_nowhere_near() -> None:
    assert (distance_to_cubes(np.zeros((4, 4, 4), bool), 3.0) == 3.0).all()
    assert box_around(np.zeros((4, 4, 4), bool), 1.0) == (slice(0), slice(0), slice(0))
