"""Calibration of the expected error by isotonic regression on validation pairs.

Networks rank their errors well before they predict their size. The means of predicted and true errors over
cells of pixels give a non-decreasing curve, which maps one to the other and keeps the ranking.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

__all__ = ["CELL_PX", "SMALLEST_ERROR", "Calibration", "cell_means", "non_decreasing"]

CELL_PX = 8
"""Side of the square cells in which errors are compared; errors of single pixels are too noisy."""
KNOTS = 17
MIN_CELLS = 2000
"""With fewer cells no curve is fitted."""
SMALLEST_ERROR = 1e-4


@dataclass(frozen=True)
class Calibration:
    """A non-decreasing, piecewise linear calibration curve; without knots, the identity.

    Args:
        predicted: knots, increasing.
        true: mean true error at the knots, non-decreasing.
    """

    predicted: tuple[float, ...] = ()
    true: tuple[float, ...] = ()

    @classmethod
    def fitted(cls, predicted: Float[np.ndarray, "n"], true: Float[np.ndarray, "n"]) -> Calibration:
        """The least-squares non-decreasing curve through means of cells; the identity with too few cells.

        Cells are sorted by prediction and averaged in equal shares, one per knot.

        Args:
            predicted: expected errors of the cells.
            true: true errors of the cells.
        """
        if len(predicted) < MIN_CELLS:
            return cls()
        order = np.argsort(predicted, kind="stable")
        # Means over equal shares first: the ends of an isotonic fit to single cells are single cells.
        shares = np.array_split(order, KNOTS)
        middle = np.array([predicted[share].mean() for share in shares])
        level = non_decreasing(np.array([true[share].mean() for share in shares]))
        middle = np.maximum.accumulate(middle + 1e-9 * np.arange(KNOTS))
        return cls(tuple(middle.tolist()), tuple(np.maximum(level, SMALLEST_ERROR).tolist()))

    def applied(self, error: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
        """Calibrated errors: linear between the knots, in proportion beyond the outermost ones."""
        if not self.predicted:
            return error
        knots, level = np.asarray(self.predicted), np.asarray(self.true)
        inside = np.interp(error, knots, level)
        beyond = np.where(error > knots[-1], error / knots[-1], np.minimum(error / knots[0], 1))
        return np.asarray(inside * beyond, dtype=np.float32)

    def as_dict(self) -> dict[str, tuple[float, ...]]:
        """For JSON; see `from_dict`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, entries: Mapping[str, Sequence[float]]) -> Calibration:
        """From what `as_dict` gave."""
        return cls(**{name: tuple(values) for name, values in entries.items()})


def non_decreasing(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """The non-decreasing sequence with the smallest sum of squared differences from `values`.

    For the few knots of a curve; `scipy.optimize` has the same, and takes half a second to load.

    Source: [Busing2022].
    """
    pools: list[tuple[float, int]] = []
    """Mean and number of values that are pooled so far."""
    waiting = [float(value) for value in values[::-1]]
    while waiting:
        total, count = waiting.pop(), 1
        if pools and pools[-1][0] >= total:
            mean, pooled = pools.pop()
            total, count = pooled * mean + total, count + pooled
            while waiting and total / count >= waiting[-1]:
                total, count = total + waiting.pop(), count + 1
            while pools and pools[-1][0] >= total / count:
                mean, pooled = pools.pop()
                total, count = total + pooled * mean, count + pooled
        pools.append((total / count, count))
    return np.repeat([mean for mean, _ in pools], [count for _, count in pools])


def cell_means(
    values: Float[Tensor, "n 1 h w"], weight: Float[Tensor, "n 1 h w"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Weighted mean and mean weight of each cell, row by row; an image smaller than a cell has none."""
    if min(values.shape[-2:]) < CELL_PX:
        return np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.float32)
    share = functional.avg_pool2d(weight, CELL_PX)
    mean = functional.avg_pool2d(values * weight, CELL_PX) / share.clamp_min(1e-6)
    return mean.flatten().numpy(), share.flatten().numpy()
