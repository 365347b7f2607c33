"""What of a depth map is a background."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.known_depth import FARTHEST, is_background


def test_a_wall_that_recedes_is_none() -> None:
    depth = np.geomspace(2, 2 * 500, 400).reshape(20, 20)
    assert not is_background(depth).any()
    assert not is_background(np.zeros((4, 4))).any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [1e6, 1e10, float(np.finfo(np.float32).max)])
@pytest.mark.parametrize("share", [0.01, 0.5, 0.85])
def test_backgrounds(value: float, share: float, dtype: type) -> None:
    depth = np.random.default_rng(0).uniform(10, 40, (40, 40)).astype(dtype)
    there = np.random.default_rng(1).random((40, 40)) < share
    depth[there] = value
    depth[0] = 0
    there[0] = False
    np.testing.assert_array_equal(is_background(depth), there)


def test_the_unit_does_not_matter() -> None:
    depth = np.array([1.0, 1.0, 0.9 * FARTHEST, 1.1 * FARTHEST])
    for scale in (1e-6, 1.0, 1e6):
        assert is_background(scale * depth).tolist() == [False, False, False, True]


@pytest.mark.parametrize("known", [11, 19, 20, 21, 31])
def test_a_thousand_times_what_a_tenth_of_the_known_depths_is_nearer_than(known: int) -> None:
    wall = np.geomspace(1, 3, known - 2)
    near = float(wall[(known - 1) // 10])
    # Unknown depth is no near one, however much of it there is.
    depth = np.concatenate([np.zeros(2 * known), wall[::-1], [999 * near, 1001 * near]])
    assert np.flatnonzero(is_background(depth)).tolist() == [len(depth) - 1]
