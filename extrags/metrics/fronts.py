"""Pareto fronts: which runs no other run beats in both cost and error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from extrags.metrics.comparison import figure_of
from extrags.metrics.registry import Figure, figures
from extrags.metrics.regression import GROUP, grouped_runs, known_sizes, repetition

__all__ = ["COSTS", "front_of", "fronts", "means_by_cell"]

COSTS = {"seconds": "elapsed time (s)", "processor_seconds": "processor time (s)", "peak_mib": "memory (MiB)"}
"""What a run costs, by key of its JSON."""

CELL = ("sequence", "setting", "width", "height", "method", "profile", "budget")
"""What runs of one cell share; they differ in seed and repeat."""
SCENE = CELL[:4]
"""Figures are compared within a scene at one size: what is measured on other pixels is another figure."""


def front_of(points: Sequence[tuple[float | int, float | int]], *, higher_is_better: bool) -> list[int]:
    """Indices of the points that no other point dominates, the cheapest first.

    A point is dominated by another that costs no more and is no worse, and is better in one of the two
    (minimal elements of the product order). Of equal points the first is kept.

    Args:
        points: cost and figure of each.
        higher_is_better: whether larger figures are better.
    """
    sign = -1.0 if higher_is_better else 1.0
    ordered = sorted(range(len(points)), key=lambda index: (points[index][0], sign * points[index][1]))
    kept: list[int] = []
    best = float("inf")
    for index in ordered:
        error = sign * points[index][1]
        if error < best:
            kept.append(index)
            best = error
    return kept


def means_by_cell(cases: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Means over seeds and repeats of every cell that has figures.

    Returns:
        `{sequence, setting, width, height, method, profile, budget, runs, failed, repetitions, seconds,
        processor_seconds, peak_mib, figures: {NAME: mean}}`; a cost or figure that a run lacks is None or
        left out. Failed runs do not count towards means; `repetitions` has seed and repeat of those that do.
        Runs that failed before the size of their frames was known belong to the cell of the other runs.
    """
    found = []
    for group, runs in grouped_runs(cases, [known_sizes(cases)]).items():
        about = dict(zip(GROUP, group, strict=True))
        good = [run for run in runs if run["metrics"] is not None]
        costs = {cost: _mean([run[cost] for run in good]) for cost in COSTS}
        values = {
            figure.name: _mean([figure_of(run["metrics"], figure.name) for run in good])
            for figure in figures()
        }
        found.append(
            {
                **{name: about[name] for name in CELL},
                "runs": len(good),
                "failed": len(runs) - len(good),
                "repetitions": sorted(list(repetition(run)) for run in good),
                **costs,
                "figures": {name: value for name, value in values.items() if value is not None},
            }
        )
    return found


def fronts(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The front of every scene, cost and figure of the evaluation protocol.

    Means are compared over the same runs: a cell that lacks a seed or repeat that another cell of its scene
    has, because it failed there, is on no front, and displaces none. Its mean would leave out what was hard.

    Args:
        cells: from `means_by_cell`.

    Returns:
        `{sequence, setting, width, height, cost, figure, higher_is_better, front: [{method, profile,
        budget, cost, value}], left_off: [{method, profile, budget}]}`, the cheapest first.
    """
    scenes: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for cell in cells:
        scenes.setdefault(tuple(cell[name] for name in SCENE), []).append(cell)
    found = []
    for scene, inside in scenes.items():
        repetitions = {tuple(one) for cell in inside for one in cell["repetitions"]}
        whole, lacking = (
            [cell for cell in inside if (set(map(tuple, cell["repetitions"])) == repetitions) == complete]
            for complete in (True, False)
        )
        for cost in COSTS:
            for figure in figures():
                named = _with_both(whole, cost, figure)
                left_off = _with_both(lacking, cost, figure)
                if not named and not left_off:
                    continue
                points = [(float(cell[cost]), float(cell["figures"][figure.name])) for cell in named]
                kept = front_of(points, higher_is_better=figure.higher_is_better)
                found.append(
                    {
                        **dict(zip(SCENE, scene, strict=True)),
                        "cost": cost,
                        "figure": figure.name,
                        "higher_is_better": figure.higher_is_better,
                        "front": [
                            {
                                **{name: named[index][name] for name in ("method", "profile", "budget")},
                                "cost": points[index][0],
                                "value": points[index][1],
                            }
                            for index in kept
                        ],
                        "left_off": [
                            {name: cell[name] for name in ("method", "profile", "budget")}
                            for cell in left_off
                        ],
                    }
                )
    return found


def _with_both(cells: Sequence[Mapping[str, Any]], cost: str, figure: Figure) -> list[Mapping[str, Any]]:
    return [cell for cell in cells if cell[cost] is not None and figure.name in cell["figures"]]


def _mean(values: Sequence[float | int | None]) -> float | None:
    known = [float(value) for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None
