"""The distinct rows of an array, several times as fast as numpy finds them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, Shaped

__all__ = ["unique_rows"]


def unique_rows(
    rows: Shaped[np.ndarray, "n k"],
) -> tuple[Shaped[np.ndarray, "m k"], Int[np.ndarray, "n"]]:
    """As `numpy.unique(rows, axis=0, return_inverse=True)`, which compares rows byte by byte.

    Args:
        rows: numbers, none of them NaN.

    Returns:
        The distinct rows in the order of their columns, and which of them each row is.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    first = np.ones(len(rows), dtype=bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    which = np.empty(len(rows), dtype=np.int64)
    which[order] = np.cumsum(first) - 1
    return ordered[first], which
