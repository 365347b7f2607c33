"""From the error a restorer expects to the error it makes, measured on pairs it has not learned from.

A network knows where it errs long before it knows by how much. Errors of cells of pixels, predicted and
true, are put in order; a curve through their means that never falls turns one into the other. It turns no
order round; where it is level, different predictions become equal.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

__all__ = ["CELL_PX", "Calibration", "cell_means"]

CELL_PX = 8
"""Predicted and true errors are compared in squares of this side: single pixels are noise."""
KNOTS = 17
MIN_CELLS = 2000
"""Fewer cells say nothing about a curve."""
SMALLEST_ERROR = 1e-4


@dataclass(frozen=True)
class Calibration:
    """A curve that never falls.

    Args:
        predicted: knots, rising.
        true: mean error at the knots, not falling.
    """

    predicted: tuple[float, ...] = ()
    true: tuple[float, ...] = ()

    @classmethod
    def fitted(cls, predicted: Float[np.ndarray, "n"], true: Float[np.ndarray, "n"]) -> Calibration:
        """The best curve (least squares) that never falls through means of cells; none where they are few.

        Cells are put in order by prediction and averaged in equal shares, one per knot.

        Args:
            predicted: errors as the restorer expects them.
            true: errors as they are.
        """
        from scipy.optimize import isotonic_regression

        if len(predicted) < MIN_CELLS:
            return cls()
        order = np.argsort(predicted, kind="stable")
        # Means over equal shares first: the ends of an isotonic fit to single cells are single cells.
        shares = np.array_split(order, KNOTS)
        middle = np.array([predicted[share].mean() for share in shares])
        level = isotonic_regression(np.array([true[share].mean() for share in shares])).x
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
        """For JSON."""
        return asdict(self)


def cell_means(
    values: Float[Tensor, "n 1 h w"], weight: Float[Tensor, "n 1 h w"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Weighted means of cells, and how much of each cell has weight, cells in order."""
    share = functional.avg_pool2d(weight, CELL_PX)
    mean = functional.avg_pool2d(values * weight, CELL_PX) / share.clamp_min(1e-6)
    return mean.flatten().numpy(), share.flatten().numpy()
