"""Quantiles of values that lie frame by frame: exact, without holding or sorting them all.

The bits of positive floats are in the order of their values. A first pass over the frames counts the upper
halves of the bits, a second the lower halves of those that the wanted ranks fall into.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

__all__ = ["median_of_frames", "quantile_of_frames"]

Frames = Callable[[], Iterable[Float[np.ndarray, "n"]]]
"""Gives the values of all frames, one frame after the other, whenever it is called."""

_HALF = 16
_LOWER = (1 << _HALF) - 1


def median_of_frames(frames: Frames) -> float | None:
    """As `numpy.median` of all float32 values together.

    Args:
        frames: gives positive values, each time the same.

    Returns:
        The median; None where there are no values.
    """
    pair = _at_ranks(frames, lambda count: ((count - 1) // 2, count // 2))
    return None if pair is None else float(np.median(pair))


def quantile_of_frames(frames: Frames, share: float) -> float | None:
    """As `numpy.quantile` of all float32 values together.

    Args:
        frames: gives positive values, each time the same.
        share: in [0, 1].

    Returns:
        The quantile; None where there are no values.
    """
    part = 0.0

    def ranks(count: int) -> tuple[int, int]:
        nonlocal part
        place = share * (count - 1)
        part = place - int(place)
        return int(place), min(int(place) + 1, count - 1)

    pair = _at_ranks(frames, ranks)
    return None if pair is None else float(np.quantile(pair, part))


def _counts_of_upper_halves(frames: Frames) -> np.ndarray:
    found = np.zeros(1 << _HALF, dtype=np.int64)
    for values in frames():
        found += np.bincount(_bits(values) >> _HALF, minlength=len(found))
    return found


def _at_ranks(frames: Frames, ranks_of: Callable[[int], tuple[int, int]]) -> Float[np.ndarray, "2"] | None:
    """Values at two ranks, from 0, which follow from how many there are; None where there are none."""
    upper = _counts_of_upper_halves(frames)
    count = int(upper.sum())
    if count == 0:
        return None
    ranks = ranks_of(count)
    ends = np.cumsum(upper)
    halves = np.searchsorted(ends, ranks, side="right")
    lower = {int(half): np.zeros(1 << _HALF, dtype=np.int64) for half in halves}
    for values in frames():
        bits = _bits(values)
        for half, counts in lower.items():
            counts += np.bincount(bits[bits >> _HALF == half] & _LOWER, minlength=len(counts))
    found = []
    for rank, half in zip(ranks, halves.tolist(), strict=True):
        among = rank - (int(ends[half]) - int(upper[half]))
        found.append(half << _HALF | int(np.searchsorted(np.cumsum(lower[half]), among, side="right")))
    return np.array(found, dtype=np.uint32).view(np.float32)


def _bits(values: Float[np.ndarray, "n"]) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
