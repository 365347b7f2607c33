"""The page of a dataset: all sequences of a run, side by side."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Any, Literal

import numpy as np

from extrags.metrics.registry import Metric, metric_named
from extrags.report.charts import sequences_chart
from extrags.report.page import rendered_page
from extrags.report.run_facts import given_settings, seconds_of_all, shared_facts
from extrags.report.wording import (
    compare,
    count,
    coverage_of,
    described_metrics,
    duration,
    metric_of,
    number,
    same_pixels,
    shown_metrics,
)

__all__ = ["DatasetRow", "build_dataset_report"]


@dataclass(frozen=True)
class DatasetRow:
    """One sequence of a run.

    Args:
        name: of the sequence.
        status: `completed` or `failed`.
        seconds: that its stages took when they were made.
        coarse: metrics of the coarse scene, as the `metrics` of an `EvaluationResult`.
        final: the same of the fine-tuned scene; None when the plan left fine-tuning out.
        stages: `{stage, state, seconds, reason, made_seconds, artefacts}` of each, the last two where they
            are known: keys of its artefacts, which other rows may share.
        error: what went wrong, for a failed sequence.
        seed: of the run, when there are several of the same sequence and variant.
        variant: what else sets it apart from other runs of the same sequence, in words.
        link: relative address of the sequence's own page; no link when empty.
        settings: that were given beside the profile, by dotted name.
        image_size: width and height in px; None where it is not known.
    """

    name: str
    status: Literal["completed", "failed"]
    seconds: float | int
    coarse: Mapping[str, Any] | None = None
    final: Mapping[str, Any] | None = None
    stages: Sequence[Mapping[str, Any]] = ()
    error: str = ""
    seed: int | None = None
    variant: str = ""
    link: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    image_size: Sequence[int] | None = None

    @property
    def label(self) -> str:
        """Name, seed and variant."""
        named = self.name if self.seed is None else f"{self.name}, seed {self.seed}"
        return f"{named} [{self.variant}]" if self.variant else named


def build_dataset_report(
    rows: Sequence[DatasetRow], *, name: str = "Dataset", made: str = "", profile: str = ""
) -> str:
    """One self-contained HTML page that compares the sequences of a run.

    Means are over the sequences that have both a coarse and a final figure, with the standard deviation
    between them; of several seeds of a sequence the mean counts, each variant by itself, and their spread
    gets a table. Where there are more rows than sequences, rows are called runs. Failures stand at the top.

    Args:
        rows: the sequences, or runs of them, in the order they are to be shown.
        name: title of the page.
        made: when, in words; nothing is said when empty.
        profile: of the settings.
    """
    trees = [tree for row in rows for tree in (row.coarse, row.final)]
    metrics, psnr = shown_metrics(*trees), metric_named("psnr")
    measured = [row for row in rows if metric_of(row.final or row.coarse, "psnr") is not None]
    chart = None
    if measured:
        chart = sequences_chart(
            [row.label for row in measured],
            _column([metric_of(row.coarse, "psnr") for row in measured]),
            _column([metric_of(row.final, "psnr") for row in measured]),
            np.array([row.seconds for row in measured]),
        )
    return rendered_page(
        "dataset.html.j2",
        name=name,
        made=made,
        profile=profile,
        summary=_summary(rows),
        facts=[
            ("Sequences", count(len({row.name for row in rows}))),
            *([("Runs", count(len(rows)))] if _kind(rows) == "runs" else []),
            ("Completed", count(sum(row.status == "completed" for row in rows))),
            ("Failed", count(sum(row.status == "failed" for row in rows))),
            ("Time to make all", duration(seconds_of_all((row.seconds, row.stages) for row in rows))),
            *shared_facts([row.image_size for row in rows], [row.settings for row in rows]),
        ],
        given=given_settings([row.name for row in rows], [row.settings for row in rows]),
        failures=[
            (row.label, row.error or "no reason was recorded") for row in rows if row.status == "failed"
        ],
        metrics=metrics,
        rows=[_table_row(row, metrics) for row in rows],
        means=[_mean_cell(metric, _by_sequence(rows).values(), ()) for metric in metrics],
        unobserved=[_mean_cell(metric, _by_sequence(rows).values(), ("unobserved",)) for metric in metrics],
        compared=len(_means_of_seeds(rows, psnr, ())),
        seeds=_seed_rows(rows, metrics),
        chart=chart,
        protocol={"version": None, "metrics": described_metrics(*trees), "surface": False},
    )


def _summary(rows: Sequence[DatasetRow]) -> str:
    psnr = metric_named("psnr")
    pairs = _pairs(rows, psnr, ())
    completed = sum(row.status == "completed" for row in rows)
    text = f"{completed} of {len(rows)} {_kind(rows)} completed."
    if not pairs:
        return f"{text} None of them has both a coarse and a final figure to compare."
    better = sum(final > coarse for coarse, final in pairs)
    change = fmean(final - coarse for coarse, final in _means_of_seeds(rows, psnr, ()))
    return (
        f"{text} Over the {len(pairs)} with a coarse and a final scene, PSNR on held-out views changes by "
        f"{number(change, 2, signed=True)} dB on average; {better} of {len(pairs)} gain."
    )


def _kind(rows: Sequence[DatasetRow]) -> Literal["sequences", "runs"]:
    """What the rows are."""
    return "sequences" if len({row.name for row in rows}) == len(rows) else "runs"


def _table_row(row: DatasetRow, metrics: Sequence[Metric]) -> dict[str, Any]:
    states = [stage["state"] for stage in row.stages]
    said = [
        f"{states.count(state)} {state}"
        for state in ("ran", "cached", "skipped", "failed")
        if state in states
    ]
    size = metric_of(row.final or row.coarse, "n_gaussians")
    gaussians = "" if size is None else f"{count(size)} Gaussians"
    return {
        "label": row.label,
        "link": row.link,
        "status": row.status,
        "seconds": duration(row.seconds),
        "note": " · ".join(part for part in (", ".join(said), gaussians) if part),
        "cells": [
            compare(
                metric,
                metric_of(row.coarse, metric.key),
                metric_of(row.final, metric.key),
                coverage=(coverage_of(metric, row.coarse), coverage_of(metric, row.final)),
            )
            for metric in metrics
        ],
    }


def _both(row: DatasetRow, metric: Metric, path: tuple[str, ...]) -> tuple[float, float] | None:
    coarse, final = metric_of(row.coarse, *path, metric.key), metric_of(row.final, *path, metric.key)
    return None if coarse is None or final is None else (coarse, final)


def _pairs(rows: Sequence[DatasetRow], metric: Metric, path: tuple[str, ...]) -> list[tuple[float, float]]:
    return [pair for row in rows if (pair := _both(row, metric, path)) is not None]


def _by_sequence(rows: Sequence[DatasetRow]) -> dict[str, list[DatasetRow]]:
    """The seeds of each sequence, each variant by itself."""
    groups: dict[str, list[DatasetRow]] = {}
    for row in rows:
        groups.setdefault(replace(row, seed=None).label, []).append(row)
    return groups


def _means_of_seeds(
    rows: Sequence[DatasetRow], metric: Metric, path: tuple[str, ...]
) -> list[tuple[float, float]]:
    """A pair for each sequence, whatever its number of seeds."""
    return _means(_by_sequence(rows).values(), metric, path)


def _means(
    groups: Iterable[Sequence[DatasetRow]], metric: Metric, path: tuple[str, ...]
) -> list[tuple[float, float]]:
    """The mean pair of each group that has one."""
    found = [_pairs(group, metric, path) for group in groups]
    return [
        (fmean(first for first, _ in pairs), fmean(last for _, last in pairs)) for pairs in found if pairs
    ]


def _mean_cell(
    metric: Metric, groups: Iterable[Sequence[DatasetRow]], path: tuple[str, ...]
) -> dict[str, Any]:
    """The mean over groups of rows, each of which counts once."""
    having = [[row for row in group if _both(row, metric, path) is not None] for group in groups]
    pairs = _means(having, metric, path)
    if not pairs:
        return {"comparison": compare(metric, None, None), "deviation": "", "n": 0}
    coarse, final = np.array(pairs).T
    coverage: tuple[float | None, float | None] = (None, None)
    if metric.coverage and (shares := _means(having, metric_named(metric.coverage), path)):
        coverage = (fmean(first for first, _ in shares), fmean(last for _, last in shares))
    comparison = compare(metric, float(coarse.mean()), float(final.mean()), coverage=coverage)
    if metric.coverage:
        # One row whose pixels differ is enough for the means to be of different pixels.
        of_rows = _pairs([row for group in having for row in group], metric_named(metric.coverage), path)
        if not all(same_pixels(*shares) for shares in of_rows):
            comparison = replace(comparison, verdict="other pixels")
    return {
        "comparison": comparison,
        "deviation": _deviation(final - coarse, metric.digits),
        "n": len(pairs),
    }


def _seed_rows(rows: Sequence[DatasetRow], metrics: Sequence[Metric]) -> list[dict[str, Any]]:
    return [
        {
            "label": label,
            "seeds": len(group),
            "cells": [_mean_cell(metric, [[row] for row in group], ()) for metric in metrics],
        }
        for label, group in _by_sequence([row for row in rows if row.seed is not None]).items()
        if len(group) > 1
    ]


def _deviation(change: np.ndarray, digits: int) -> str:
    """Standard deviation of the change between rows, when there are at least two."""
    return f"± {number(float(change.std(ddof=1)), digits)}" if len(change) > 1 else ""


def _column(values: list[float | None]) -> np.ndarray:
    return np.array([math.nan if value is None else value for value in values])
