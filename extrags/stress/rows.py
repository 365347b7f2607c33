"""Rows of the stability table: what is measured, the worst that was found, and where it was found."""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import torch
from torch import Tensor

from extrags.errors import ConfigError, ExtragsError
from extrags.events import Progress, emit
from extrags.raster import native

__all__ = [
    "EPS",
    "EXACT",
    "FINITE",
    "Effort",
    "Row",
    "Trial",
    "all_finite",
    "differs",
    "finite_or_refused",
    "only_refused",
    "relative",
    "run_rows",
    "same_on_threads",
    "with_threads",
]

EPS = float(np.finfo(np.float32).eps)
"""Distance from 1 to the next float32."""

EXACT = 0.0
"""Limit of rows whose trials must be the same to the last bit."""

FINITE = 0.5
"""Limit of rows whose trials are 0 where all is finite or clearly refused, else infinite."""

_log = logging.getLogger(__name__)

Trial = tuple[str, float]
"""Where it is, with its seed, and the value measured there."""


@dataclass(frozen=True)
class Effort:
    """How much is tried.

    Args:
        scenes: random scenes of each row that draws them.
        iterations: of the longest training and of the longest run of Adam; shorter ones are told on the way.
        largest: Gaussians of the largest scene.
    """

    scenes: int = 200
    iterations: int = 1000
    largest: int = 100_000

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value < 1:
                raise ConfigError(f"{name} is {value}, expected a number above zero")


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Args:
        part: which part of the computation.
        case: what it is given.
        measured: what the value of a trial is.
        limit: largest value that passes.
        trials: makes the trials.
    """

    part: str
    case: str
    measured: str
    limit: float
    trials: Callable[[Effort], Iterable[Trial]]

    @property
    def name(self) -> str:
        """Part and case."""
        return f"{self.part}/{self.case}"

    def run(self, effort: Effort) -> dict[str, Any]:
        """All trials; the worst is kept. What fails otherwise than by a named error is the worst there is."""
        worst, where, note, count = -math.inf, "", "", 0
        begun = time.perf_counter()
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                for place, value in self.trials(effort):
                    count += 1
                    # NaN is no measure: it must not hide behind a comparison.
                    value = math.inf if math.isnan(value) else float(value)
                    if value > worst:
                        worst, where = value, place
        except Exception as error:
            _log.warning("%s fails after %s", self.name, where, exc_info=True)
            worst, note = math.inf, f"after {count} trials: {type(error).__name__}: {error}"
        return {
            "part": self.part,
            "case": self.case,
            "measured": self.measured,
            "trials": count,
            # JSON knows no infinity.
            "worst": worst if math.isfinite(worst) else None,
            "where": where,
            "limit": self.limit,
            "passed": count > 0 and worst <= self.limit,
            "seconds": round(time.perf_counter() - begun, 2),
            "note": note,
        }


def run_rows(
    rows: Sequence[Row],
    patterns: Sequence[str] = ("*",),
    effort: Effort | None = None,
    told: Callable[[dict[str, Any]], None] | None = None,
) -> list[dict[str, Any]]:
    """Run the rows whose name, or part, matches one of the patterns.

    Args:
        rows: the table.
        patterns: as file names are matched, of `part/case` or of `part`.
        effort: how much is tried.
        told: called with each row's result.

    Returns:
        One entry per row: `part`, `case`, `measured`, `trials`, `worst` (None where it is not finite),
        `where`, `limit`, `passed`, `seconds`, `note`.

    Raises:
        ConfigError: when a pattern matches nothing.
    """
    for pattern in patterns:
        if not any(_matches(row, pattern) for row in rows):
            parts = ", ".join(dict.fromkeys(row.part for row in rows))
            raise ConfigError(f"no row matches {pattern}; rows are named PART/CASE, with the parts {parts}")
    chosen = [row for row in rows if any(_matches(row, pattern) for pattern in patterns)]
    found = []
    for number, row in enumerate(chosen):
        found.append(row.run(Effort() if effort is None else effort))
        emit(Progress("stability", number + 1, len(chosen)))
        if told is not None:
            told(found[-1])
    return found


def _matches(row: Row, pattern: str) -> bool:
    return fnmatchcase(row.name, pattern) or fnmatchcase(row.part, pattern)


def relative(found: Tensor | np.ndarray, exact: Tensor | np.ndarray) -> float:
    """Relative L2 error; infinite where a value is not finite."""
    one, other = (torch.as_tensor(values).detach().double() for values in (found, exact))
    if one.shape != other.shape or not bool(torch.isfinite(one).all()):
        return math.inf
    # The largest entry first: squares of what float64 holds must not overflow.
    largest = float(other.abs().max()) if other.numel() else 0.0
    if largest == 0:
        return float(one.norm()) if one.numel() else 0.0
    return float((one / largest - other / largest).norm() / (other / largest).norm())


def differs(first: Any, second: Any) -> float:
    """0 where two results are the same to the last bit, else 1."""
    one, other = list(_arrays(first)), list(_arrays(second))
    return float(len(one) != len(other) or not all(map(_same, one, other)))


def _same(first: np.ndarray, second: np.ndarray) -> bool:
    return first.shape == second.shape and first.tobytes() == second.tobytes()


def all_finite(values: Any) -> bool:
    """Whether arrays, numbers, and lists, dicts and dataclasses of them hold no NaN and no infinity."""
    return all(bool(np.isfinite(array).all()) for array in _arrays(values))


def _arrays(values: Any) -> Iterable[np.ndarray]:
    if isinstance(values, Tensor):
        values = values.detach()
        yield (values.float() if values.dtype in (torch.bfloat16, torch.float16) else values).numpy()
    elif isinstance(values, np.ndarray | int | float):
        yield np.asarray(values)
    elif isinstance(values, Mapping):
        for value in values.values():
            yield from _arrays(value)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _arrays(value)
    elif is_dataclass(values):
        yield from _arrays(vars(values) if hasattr(values, "__dict__") else _slots(values))


def _slots(values: Any) -> list[Any]:
    return [getattr(values, name) for name in values.__dataclass_fields__]


def finite_or_refused(compute: Callable[[], Any]) -> float:
    """0 where a result is finite or a named error says why there is none, else infinite."""
    try:
        return 0.0 if all_finite(compute()) else math.inf
    except ExtragsError:
        return 0.0


def only_refused(compute: Callable[[], Any]) -> float:
    """0 where a named error says why there is no result; infinite where there is one."""
    try:
        compute()
    except ExtragsError:
        return 0.0
    return math.inf


def with_threads(count: int, compute: Callable[[], Any]) -> Any:
    """A result on so many threads of torch and of the kernels."""
    before = torch.get_num_threads(), native.num_threads()
    torch.set_num_threads(count)
    native.set_num_threads(count)
    try:
        return compute()
    finally:
        torch.set_num_threads(before[0])
        native.set_num_threads(before[1])


def same_on_threads(
    compute: Callable[[], Any], counts: Sequence[int] = (1, 2, 4), place: str = ""
) -> Iterator[Trial]:
    """Trials of a result on one thread, which others must equal to the last bit.

    Args:
        compute: makes the result anew each time it is called.
        counts: threads of torch and of the kernels.
        place: what is computed; goes before their number.
    """
    first = with_threads(1, compute)
    before = f"{place}, " if place else ""
    for count in counts:
        # Results without an array would be equal whatever was computed.
        same = differs(with_threads(count, compute), first) if any(True for _ in _arrays(first)) else math.inf
        yield f"{before}{count} threads", same
