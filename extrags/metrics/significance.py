"""How certain a change between two samples of runs is: its noise, and what could have been told from it.

Two or three seeds say next to nothing about their own spread, so that no change that ever happens would be
beyond noise by it. Spreads of a quantity are therefore pooled over all groups of the comparison, and taken
`UNEQUAL` times as large, because noise differs from sequence to sequence. Elapsed and processor time have the
noise of the machine as well (`SITTING`), which repeats of one sitting do not show.

A method's costs and whole figures are also judged over all of its sequences: there every pair is one of a
sample, seeds and sequences alike, which finds what is lost by little everywhere. That t test holds however
unlike the noise of the sequences is ([Ibragimov2010] in docs/references.md).

As many quantities are looked at, the threshold is Holm's ([Holm1979]), in three families: costs and whole
figures, of which a change counts for itself, on each sequence and over all, and figures of parts of the
pixels, which say much the same again. The chance of a single false alarm in a comparison is at most `LEVEL`
for normal noise whose deviation differs up to three times between groups. A difference smaller than what
matters (`MATTERS`) is never a regression, however certain it is; where even `PLAUSIBLE` times as much could
not have been told from noise, nothing is judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, Literal

import numpy as np

__all__ = ["LEVEL", "MATTERS", "SITTING", "Change", "changes_over_sequences", "judge_changes"]

LEVEL = 0.05
"""Chance of a false alarm in a whole comparison."""
LEVELS = {"each": 0.02, "all": 0.02, "parts": 0.01}
"""Shares of `LEVEL` by family: costs and whole figures on each sequence, over all sequences of a method, and
figures of parts of the pixels."""
MATTERS = {"cost": 0.05, "dB": 0.1, "other": 0.01, "absolute": 0.01}
"""The smallest change that counts: share of a cost, decibels, share of any other figure; of what was 0, which
has no shares, the change itself."""
PLAUSIBLE = 10.0
"""So many times what matters has to be found: a comparison that could not is not said to have found noise."""
ENOUGH = 5
"""From so many pairs on a row is judged by its own spread alone."""
UNEQUAL = 2.0
"""Pooled deviations are multiplied by this: a group has at most its square root of all groups' number, and of
groups whose deviations differ three times the noisiest has up to twice the pooled one."""
SITTING = 0.1
"""Standard deviation of the logarithm of a machine's speed between two sittings: of one virtual machine it
changed by a tenth within two hours (docs/algorithms/rasteriser.md)."""
MANY = 1e9
"""Degrees of freedom from which Student's t is the normal distribution."""
TIMES = ("seconds", "processor_seconds")
UNITS = {"cost": "share", "dB": "dB", "other": "share", "absolute": "absolute"}
Verdict = Literal["worse", "better", "noise", "equal", "not judged"]


@dataclass
class Change:
    """A cost or figure of one group of runs, before and after, and what is made of it."""

    about: dict[str, Any]
    quantity: str
    kind: str
    paired: bool
    n: int
    before: float
    after: float
    primary: bool
    """Judged in the first family."""
    logarithms: bool
    """`change` is of logarithms."""
    change: float
    """Mean difference; positive is worse."""
    variance: float | None
    """Of single differences, or of the runs of a side; None where there is one."""
    freedom: int
    share: float
    """The variance of `change` is so many times that of single differences."""
    differences: tuple[float, ...] = ()
    """Of the pairs, as `change`."""
    low: float | None = None
    high: float | None = None
    p_worse: float | None = None
    p_better: float | None = None
    least: float = math.inf
    """The smallest change that could have been told from noise, as `change`."""
    verdict: Verdict = "not judged"

    @property
    def family(self) -> str:
        """Key of `LEVELS`."""
        if not self.primary:
            return "parts"
        return "each" if self.about["sequence"] is not None else "all"

    @property
    def worsening(self) -> float:
        """In the unit of `kind`: positive is worse."""
        return self.in_unit(self.change)

    def in_unit(self, change: float) -> float:
        """A change of logarithms as a share."""
        return math.expm1(change) if self.logarithms else change

    def to_json(self) -> dict[str, Any]:
        """As results of a comparison have it; JSON types."""
        return {
            **self.about,
            "quantity": self.quantity,
            "primary": self.primary,
            "unit": UNITS[self.kind],
            "paired": self.paired,
            "n": self.n,
            "before": self.before,
            "after": self.after,
            "worsening": self.worsening,
            "interval": None
            if self.low is None or self.high is None
            else [self.in_unit(self.low), self.in_unit(self.high)],
            "verdict": self.verdict,
        }


def changes_over_sequences(rows: Sequence[Change]) -> list[Change]:
    """Costs and whole figures of each method, profile and budget over all its sequences, two at least.

    Args:
        rows: changes on single sequences; those of pairs count.
    """
    samples: dict[tuple[Any, ...], list[Change]] = {}
    for row in rows:
        if row.primary and row.paired:
            what = (*(row.about[key] for key in ("method", "profile", "budget")), row.quantity, row.kind)
            samples.setdefault((*what, row.logarithms), []).append(row)
    found = []
    for inside in samples.values():
        if len(inside) < 2:
            continue
        pairs = np.concatenate([row.differences for row in inside])
        found.append(
            replace(
                inside[0],
                about={**inside[0].about, **dict.fromkeys(("sequence", "setting", "width", "height"))},
                n=len(pairs),
                before=fmean(row.before for row in inside),
                after=fmean(row.after for row in inside),
                change=float(pairs.mean()),
                variance=float(pairs.var(ddof=1)),
                freedom=len(pairs) - 1,
                share=1 / len(pairs),
            )
        )
    return found


def judge_changes(rows: Sequence[Change]) -> None:
    """Noise of each change, Holm's procedure in each family and direction, then what matters.

    Args:
        rows: all changes of a comparison, those over sequences included; their verdicts, probabilities and
            intervals are filled in.
    """
    for row in rows:
        if row.worsening == 0.0 and row.before == row.after and not row.variance:
            row.verdict = "equal"
    tested = [row for row in rows if row.variance is not None]
    pools: dict[tuple[Any, ...], list[Change]] = {}
    for row in tested:
        pool = (row.family, row.quantity, row.kind, row.paired, row.logarithms)
        pools.setdefault(pool, []).append(row)
    for alike in pools.values():
        # Over all that could be judged: to look only at what has changed by enough would be to look at the
        # data first, and to be content with fewer quantities than were looked at.
        family = alike[0].family
        level = LEVELS[family] / sum(row.family == family for row in tested)
        for row in alike:
            _measure(row, alike, level)
    for family, level in LEVELS.items():
        _holm([row for row in tested if row.family == family], level)


def _measure(row: Change, alike: Sequence[Change], level: float) -> None:
    """Probabilities of the change of a row by chance, its interval, and what could have been found.

    Args:
        row: with at least two pairs, or runs a side; filled in.
        alike: rows of its quantity that can be judged, itself among them: their noise is pooled.
        level: of its family, divided by the number of rows there.
    """
    from scipy.special import stdtr, stdtrit

    own = row.variance or 0.0
    if row.n >= ENOUGH or len(alike) == 1 or row.family == "all":
        variance, freedom = own, float(row.freedom)
    else:
        freedom = float(sum(other.freedom for other in alike))
        pooled = sum((other.variance or 0.0) * other.freedom for other in alike) / freedom
        variance = max(own, pooled * min(UNEQUAL**2, len(alike)))
    square = variance * row.share
    if row.quantity in TIMES:
        # Of known size, so that it adds degrees of freedom (Satterthwaite).
        whole = square + SITTING**2
        freedom *= (whole / square) ** 2 if square > 0 else math.inf
        square = whole
    error, freedom = math.sqrt(square), min(freedom, MANY)
    reach = float(stdtrit(freedom, 0.975)) * error
    row.low, row.high = row.change - reach, row.change + reach
    row.least = -float(stdtrit(freedom, level)) * error
    # What is the same in every pair is certain, with whatever sign.
    statistic = (
        row.change / error if error > 0 else math.copysign(math.inf, row.change) if row.change else 0.0
    )
    row.p_worse, row.p_better = float(stdtr(freedom, -statistic)), float(stdtr(freedom, statistic))


def _holm(tested: Sequence[Change], level: float) -> None:
    """Holm's procedure in each direction; what it leaves is noise where a plausible change would be found."""
    for row in tested:
        if row.verdict != "equal" and row.in_unit(row.least) <= PLAUSIBLE * MATTERS[row.kind]:
            row.verdict = "noise"
    directions: tuple[tuple[str, Verdict, float], ...] = (
        ("p_worse", "worse", 1.0),
        ("p_better", "better", -1.0),
    )
    for attribute, verdict, sign in directions:
        for rank, row in enumerate(sorted(tested, key=lambda row: float(getattr(row, attribute)))):
            if getattr(row, attribute) > level / (len(tested) - rank):
                break
            if sign * row.worsening >= MATTERS[row.kind]:
                row.verdict = verdict
