"""The leaderboard: sequences by methods from the runs that are on record, to be sorted and filtered."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any, Literal

from extrags.metrics.comparison import figure_of
from extrags.metrics.registry import Figure, figures
from extrags.report.downloads import Cell, csv_uri
from extrags.report.page import rendered_page
from extrags.report.wording import count, described_metrics, duration, number, same_pixels

__all__ = ["BoardRow", "build_leaderboard"]


@dataclass(frozen=True)
class BoardRow:
    """One run.

    Args:
        sequence: `DATASET/SEQUENCE[@SETTING]` or a path.
        method: name of the method.
        profile: named settings.
        seed: of all stages; empty for each stage's own.
        settings: what a matrix changed, in words; empty for nothing.
        further: other settings that were given, in words. They do not set runs apart: of runs that differ in
            these alone the last one is on record.
        status: how its last run ended.
        reason: why it failed.
        ended: UTC, ISO 8601.
        seconds: its stages took.
        metrics: of the final scene, as the `metrics` of an `EvaluationResult`; None without.
        link: address of its page; empty for none.
        protocol: version of the evaluation protocol that the metrics are by; None for records that lack it.
        held_out_trained_on: its scene has seen the frames that its figures are of.
        imported: its scene was made elsewhere; nobody knows whether it has seen them.
    """

    sequence: str
    method: str
    profile: str
    seed: str = ""
    settings: str = ""
    further: str = ""
    status: Literal["ok", "failed"] = "ok"
    reason: str = ""
    ended: str = ""
    seconds: float | int = 0.0
    metrics: Mapping[str, Any] | None = None
    link: str = ""
    protocol: int | None = None
    held_out_trained_on: bool = False
    imported: bool = False

    @property
    def dataset(self) -> str:
        """What stands before the slash; `files` for a path."""
        name, slash, rest = self.sequence.partition("/")
        return name if slash and name not in ("", ".", "..") and "/" not in rest else "files"

    @property
    def column(self) -> str:
        """The method, and the settings that set it apart."""
        return f"{self.method}, {self.settings}" if self.settings else self.method


def build_leaderboard(rows: Sequence[BoardRow], *, name: str = "Leaderboard") -> str:
    """One self-contained HTML page: a table of sequences by methods for each figure, and all runs.

    Cells of the first are means over seeds; its last row is the mean over those sequences that every method
    has, so that no method gains by what it was not run on. The best of a row is marked where all its methods
    have the same seeds. Scripts sort and filter; without them all tables are there.

    Args:
        rows: the runs, failed ones among them.
        name: title of the page.
    """
    trees = [row.metrics for row in rows if row.metrics is not None]
    shown, compared = (
        [item for item in asked if any(figure_of(tree, item.name) is not None for tree in trees)]
        # What training never saw is told of in differences; the list of runs has no room for it.
        for asked in (figures("tables"), dict.fromkeys([*figures("tables"), *figures("differences")]))
    )
    profiles = _distinct(row.profile for row in rows)
    return rendered_page(
        "leaderboard.html.j2",
        name=name,
        summary=_summary(rows),
        warnings=_warnings(rows),
        facts=[
            ("Runs", count(len(rows))),
            ("Sequences", count(len({row.sequence for row in rows}))),
            ("Methods", count(len({row.column for row in rows}))),
            ("Failed", count(sum(row.status == "failed" for row in rows))),
        ],
        figures=compared,
        columns=shown,
        profiles=profiles,
        datasets=_distinct(row.dataset for row in rows),
        methods=_distinct(row.column for row in rows),
        boards=[
            board
            for profile in profiles
            for item in compared
            if (board := _board(rows, item, profile)) is not None
        ],
        rows=[_run(row, shown) for row in rows],
        csv=_csv(rows, shown),
        protocol={"version": None, "metrics": described_metrics(*trees), "surface": False},
    )


def _distinct(values: Any) -> list[str]:
    return sorted(set(values))


def _summary(rows: Sequence[BoardRow]) -> str:
    if not rows:
        return "No run is on record."
    newest = max(row.ended for row in rows)[:16].replace("T", " ")
    return (
        "The last run of each sequence, method, profile and seed on record, whatever its further settings; "
        f"the newest ended {newest} UTC."
    )


def _warnings(rows: Sequence[BoardRow]) -> list[str]:
    found = []
    if columns := _distinct(row.column for row in rows if row.held_out_trained_on):
        found.append(
            f"Held-out frames were trained on in {', '.join(columns)}, which is never marked as best."
        )
    if columns := _distinct(row.column for row in rows if row.imported):
        found.append(
            "Whether the held-out frames were trained on is not known of imported scenes, which are not "
            f"marked as best either: {', '.join(columns)}."
        )
    protocols = {row.protocol for row in rows if row.metrics is not None}
    if len(protocols) > 1:
        known = ", ".join(str(version) for version in sorted(item for item in protocols if item is not None))
        unknown = " and of earlier ones that are not on record" if None in protocols else ""
        found.append(
            f"Figures are of several versions of the evaluation protocol ({known}{unknown}): some of them "
            "cannot be compared. Start the older runs again to measure them again; nothing else is "
            "recomputed."
        )
    if unlike := _unlike_seeds(rows):
        found.append(
            f"Not all methods have figures of the same seeds on {', '.join(unlike)}: none is marked as best "
            "there, and means over these sequences have no best either."
        )
    if len({row.further for row in rows}) > 1:
        found.append(
            "Not all runs had the same further settings: the list of all runs gives those of each, and the "
            "tables before it do not distinguish them."
        )
    return found


def _unlike_seeds(rows: Sequence[BoardRow]) -> list[str]:
    """Sequences, with the profile, on which methods that may be the best have other seeds than each other."""
    seeds: dict[tuple[str, str], dict[str, set[str]]] = {}
    ceilings = _ceilings(rows)
    for row in rows:
        if row.metrics is not None and row.status == "ok" and row.column not in ceilings:
            by_method = seeds.setdefault((row.sequence, row.profile), {})
            by_method.setdefault(row.column, set()).add(row.seed)
    return sorted(
        f"{sequence} ({profile})"
        for (sequence, profile), by_method in seeds.items()
        if not _all_equal(by_method.values())
    )


def _all_equal(sets: Iterable[set[str]]) -> bool:
    return len({frozenset(one) for one in sets}) <= 1


def _ceilings(rows: Sequence[BoardRow]) -> set[str]:
    """Methods whose scenes have seen the held-out frames, or may have."""
    return {row.column for row in rows if row.held_out_trained_on or row.imported}


def _board(rows: Sequence[BoardRow], figure: Figure, profile: str) -> dict[str, Any] | None:
    """A figure of one profile, sequences by methods; None where no run has it."""
    values: dict[tuple[str, str], list[float]] = {}
    shares: dict[tuple[str, str], list[float]] = {}
    seeds: dict[tuple[str, str], set[str]] = {}
    for row in rows:
        value = None if row.metrics is None or row.profile != profile else figure_of(row.metrics, figure.name)
        if value is not None and row.status == "ok":
            values.setdefault((row.sequence, row.column), []).append(value)
            seeds.setdefault((row.sequence, row.column), set()).add(row.seed)
            share = figure_of(row.metrics, figure.coverage) if figure.coverage else None
            if share is not None:
                shares.setdefault((row.sequence, row.column), []).append(share)
    if not values:
        return None
    methods = _distinct(method for _, method in values)
    ceilings = _ceilings(rows)
    rivals = [method for method in methods if method not in ceilings]
    sequences = _distinct(sequence for sequence, _ in values)
    datasets = {row.sequence: row.dataset for row in rows}
    means, covered = (
        {place: fmean(found) for place, found in by_place.items()} for by_place in (values, shares)
    )
    # A mean over the seeds that one method lacks, because it failed there, is of other runs.
    alike = {
        item: _all_equal(seeds[item, method] for method in rivals if (item, method) in seeds)
        for item in sequences
    }
    complete = [item for item in sequences if all((item, method) in means for method in methods)]
    lines = []
    for sequence in sequences:
        cells = {method: means.get((sequence, method)) for method in methods}
        deviations = [
            f"± {number(stdev(found), figure.digits)}" if len(found) > 1 else ""
            for found in (values.get((sequence, method), []) for method in methods)
        ]
        lines.append(
            {
                "sequence": sequence,
                "dataset": datasets[sequence],
                "cells": [
                    {**cell, "note": note}
                    for cell, note in zip(
                        _cells(
                            cells,
                            figure,
                            ceilings,
                            [covered.get((sequence, name)) for name in rivals],
                            same_seeds=alike[sequence],
                        ),
                        deviations,
                        strict=True,
                    )
                ],
            }
        )
    # One sequence whose pixels differ is enough for the means to be of different pixels.
    by_sequence = [[covered.get((item, method)) for method in rivals] for item in complete]
    apart = next((found for found in by_sequence if not same_pixels(*found)), [])
    overall = (
        {method: fmean(means[item, method] for item in complete) for method in methods} if complete else {}
    )
    return {
        "figure": figure,
        "profile": profile,
        "methods": methods,
        "lines": lines,
        "complete": len(complete),
        "means": _cells(
            {method: overall.get(method) for method in methods},
            figure,
            ceilings,
            apart,
            same_seeds=all(alike[item] for item in complete),
        )
        if overall
        else [],
    }


def _cells(
    values: Mapping[str, float | None],
    figure: Figure,
    ceilings: Collection[str],
    shares: Sequence[float | None],
    *,
    same_seeds: bool,
) -> list[dict[str, Any]]:
    """Figures of a row by method; the best marked where there are several over the same pixels and seeds.

    Args:
        values: by method.
        figure: what they are.
        ceilings: methods whose scenes have seen the held-out frames: they are no competitors.
        shares: of the pixels that the figures of the others are over, in [0, 1].
        same_seeds: whether the others have the same ones.
    """
    known = [value for method, value in values.items() if value is not None and method not in ceilings]
    comparable = len(known) > 1 and same_seeds and same_pixels(*shares)
    best = (max(known) if figure.higher_is_better else min(known)) if comparable else None
    return [
        {
            "text": number(value, figure.digits),
            "value": "" if value is None else repr(value),
            # Nobody is better by what is not shown.
            "best": best is not None
            and value is not None
            and method not in ceilings
            and round(value, figure.digits) == round(best, figure.digits),
        }
        for method, value in values.items()
    ]


def _run(row: BoardRow, shown: Sequence[Figure]) -> dict[str, Any]:
    values = [None if row.metrics is None else figure_of(row.metrics, item.name) for item in shown]
    return {
        "row": row,
        "cells": [
            {"text": number(value, item.digits), "value": "" if value is None else repr(value)}
            for value, item in zip(values, shown, strict=True)
        ],
        "time": duration(row.seconds) if row.seconds else "",
        "ended": row.ended[:10],
    }


def _csv(rows: Sequence[BoardRow], shown: Sequence[Figure]) -> str:
    header = ["sequence", "method", "profile", "seed", "settings", "further_settings"]
    header += ["status", "reason", "ended", "seconds"]
    lines: list[list[Cell]] = [
        [
            *(row.sequence, row.method, row.profile, row.seed, row.settings, row.further),
            *(row.status, row.reason, row.ended, row.seconds),
            *(None if row.metrics is None else figure_of(row.metrics, item.name) for item in shown),
        ]
        for row in rows
    ]
    return csv_uri([*header, *(item.name for item in shown)], lines)
