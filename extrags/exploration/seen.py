"""What views show, as sparse rows, and what newly shown rows are worth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt32

from extrags.exploration.coverage import count_pairs

__all__ = ["ErrorValue", "PairValue", "Seen", "Value", "restored", "union"]


@dataclass(frozen=True, slots=True)
class Seen:
    """The rows that a view shows; a row is a Gaussian or a frontier voxel.

    Args:
        row: rising, no row twice, [M].
        value: of each row: the packed directions it is seen from (uint32, `PairValue`), or how well it is
            resolved, in (0, 1] (float32, `ErrorValue`), [M].
    """

    row: Int[np.ndarray, "m"]
    value: UInt32[np.ndarray, "m"] | Float[np.ndarray, "m"]


class Value(ABC):
    """What rows are worth. Monotone and submodular, so that what was gained before bounds what is left."""

    @abstractmethod
    def gain(self, known: np.ndarray, seen: Seen) -> float:
        """Worth of what a view shows beyond what is known.

        Args:
            known: by row, of the type of `Seen.value`, [R].
            seen: what the view shows.
        """

    @abstractmethod
    def add(self, known: np.ndarray, seen: Seen) -> None:
        """Make known what a view shows, in place."""

    @abstractmethod
    def beyond(self, known: np.ndarray, seen: Seen) -> Seen:
        """The part of what a view shows that is not known yet."""

    @abstractmethod
    def saved(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Attributes and arrays that `restored` makes it from."""


@dataclass(frozen=True)
class PairValue(Value):
    """What newly covered (Gaussian, direction) pairs are worth: one each.

    The rows of the coverage map are the N Gaussians and then F frontier voxels
    (`extrags.exploration.frontier`).

    Args:
        n_gaussians: N.
        frontier_pair: worth of a pair of a frontier voxel; 0 where there are none.
    """

    n_gaussians: int
    frontier_pair: float = 0.0

    def gain(self, known: UInt32[np.ndarray, "r"], seen: Seen) -> float:
        r"""Worth of the pairs that are not covered yet.

        .. math:: V = \sum_{j \le N, k} \Delta M[j, k] + \lambda_h \rho \sum_{j > N, k} \Delta M[j, k]

        A weighted coverage function: monotone and submodular.
        """
        new = seen.value & ~known[seen.row]
        split = int(np.searchsorted(seen.row, self.n_gaussians))
        return int(count_pairs(new[:split])) + self.frontier_pair * int(count_pairs(new[split:]))

    def add(self, known: UInt32[np.ndarray, "r"], seen: Seen) -> None:
        """Set the bits of a view."""
        known[seen.row] |= seen.value

    def beyond(self, known: UInt32[np.ndarray, "r"], seen: Seen) -> Seen:
        """Pairs that are not covered yet."""
        new = seen.value & ~known[seen.row]
        kept = np.flatnonzero(new)
        return Seen(seen.row[kept], new[kept])

    def saved(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Its two numbers."""
        return {"n_gaussians": self.n_gaussians, "frontier_pair": self.frontier_pair}, {}


@dataclass(frozen=True)
class ErrorValue(Value):
    """Error that a view takes from views off the trajectory (`extrags.exploration.expected_error`).

    Args:
        error: of each row, the error of a view off the trajectory that is gone once the row is seen well, as
            a share of full error in all of the view's pixels, [R].
    """

    error: Float[np.ndarray, "r"]

    def gain(self, known: Float[np.ndarray, "r"], seen: Seen) -> float:
        r"""Error removed, :math:`V = \sum_e \epsilon_e \max(0, \ell_e(v) - \ell_e)`, with levels l.

        The weighted maximum over views: monotone and submodular.
        """
        better = np.maximum(seen.value - known[seen.row], np.float32(0))
        return float(np.sum(self.error[seen.row] * better, dtype=np.float64))

    def add(self, known: Float[np.ndarray, "r"], seen: Seen) -> None:
        """Raise levels to those of a view."""
        known[seen.row] = np.maximum(known[seen.row], seen.value)

    def beyond(self, known: Float[np.ndarray, "r"], seen: Seen) -> Seen:
        """Rows that the view shows better than they are known."""
        kept = np.flatnonzero(seen.value > known[seen.row])
        return Seen(seen.row[kept], seen.value[kept])

    def saved(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The errors by row."""
        return {}, {"error": self.error}


def restored(attributes: dict[str, Any], error: np.ndarray | None) -> PairValue | ErrorValue:
    """The value that `saved` came from."""
    if error is not None:
        return ErrorValue(error)
    return PairValue(attributes["n_gaussians"], attributes["frontier_pair"])


def union(value: Value, parts: Sequence[Seen], known: np.ndarray) -> Seen:
    """What several views show together.

    Args:
        value: the rule of union.
        parts: what each of them shows.
        known: an array of the coverage's shape and type; its content does not count.
    """
    together = np.zeros_like(known)
    for part in parts:
        value.add(together, part)
    row = np.flatnonzero(together).astype(np.int32)
    return Seen(row, together[row])
