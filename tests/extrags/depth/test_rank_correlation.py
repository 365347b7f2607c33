"""The rank correlation of `tests.benchmarks.bench_depth`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.bench_depth import rank_correlation


def test_the_order_of_equal_values_counts_for_nothing() -> None:
    error = np.array([1.0, 2.0, 3.0, 4.0])
    tied = np.array([1.0, 1.0, 2.0, 2.0])
    # Ranks 1.5, 1.5, 3.5, 3.5 against 1, 2, 3, 4: 4 / sqrt(5 * 4). By place they would agree wholly.
    assert rank_correlation(error, tied) == pytest.approx(0.8944, abs=1e-4)
    assert rank_correlation(error[::-1], tied) == pytest.approx(-0.8944, abs=1e-4)
