"""Distinct rows beside numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.unique_rows import unique_rows


@pytest.mark.parametrize("dtype", [np.int64, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(500, 3), (500, 1), (1, 3), (0, 3)])
def test_they_are_those_of_numpy(shape: tuple[int, int], dtype: type) -> None:
    rows = np.random.default_rng(0).integers(-4, 4, shape).astype(dtype) / dtype(2)
    rows = rows.astype(dtype)
    expected, index = np.unique(rows, axis=0, return_inverse=True)
    found, which = unique_rows(rows)
    np.testing.assert_array_equal(found, expected, strict=True)
    np.testing.assert_array_equal(which, index.reshape(-1))
    np.testing.assert_array_equal(found[which], rows)
