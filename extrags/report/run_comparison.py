"""The page that compares runs of one sequence: figures, held-out views, settings that differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from extrags.errors import ConfigError, ShapeError
from extrags.metrics.registry import Metric
from extrags.report.chart_labels import row_labels
from extrags.report.charts import LEGEND_COLUMNS, drawing_style, method_marks, run_colors, svg_image
from extrags.report.downloads import Cell, Chart, csv_uri, file_name
from extrags.report.encode import as_uint8
from extrags.report.image_table import ImageTable, Judged, evenly_spaced, judged_table
from extrags.report.numbers import REGIONS, per_view_psnr
from extrags.report.page import rendered_page
from extrags.report.viewer.content import script_text
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
    with_coverages,
)
from extrags.sequence import EndoscopicSequence

__all__ = ["ComparedRun", "build_run_comparison"]

MOST_PICTURED = 4
"""Runs whose renders stand side by side; more would be too small to be judged."""
IMAGE_BYTES = 4_500_000
"""For all pictures together."""
LEGEND_LETTERS = 110
"""So many letters are a line of the legend."""
LEGEND_LINE_IN = 0.16


@dataclass(frozen=True)
class ComparedRun:
    """One run of the sequence.

    Args:
        name: what sets it apart from the others, in a few words.
        rgb: its final renders of the held-out views, float in [0, 1] or uint8, [T, H, W, 3].
        result: `EvaluationResult` as JSON: `{protocol, metrics, per_view}`.
        settings: values by dotted name, as they are to be shown.
        seconds: its stages took; None where nobody has measured.
        link: address of its own page; empty for none.
        held_out_trained_on: its scene has seen these views.
        imported: its scene was made elsewhere; nobody knows whether it has seen them.
        held_out: digest of the images and masks that its figures are of; empty where it is not known.
    """

    name: str
    rgb: np.ndarray
    result: Mapping[str, Any]
    settings: Mapping[str, str] = field(default_factory=dict)
    seconds: float | None = None
    link: str = ""
    held_out_trained_on: bool = False
    imported: bool = False
    held_out: str = ""

    @property
    def unseen(self) -> bool:
        """Whether it is known not to have seen these views."""
        return not (self.held_out_trained_on or self.imported)


def build_run_comparison(sequence: EndoscopicSequence, runs: Sequence[ComparedRun], *, views: int = 6) -> str:
    """One self-contained HTML page. The first run is the one that the others are held against.

    Args:
        sequence: holds the truth.
        runs: two or more of it.
        views: held-out views that are shown, evenly spaced and not picked by score.

    Raises:
        ConfigError: for fewer than two runs, or two of the same name.
        ShapeError: when the renders of a run are not of these held-out frames, or these frames have changed.
    """
    names = [run.name for run in runs]
    if len(runs) < 2 or len(set(names)) < len(names):
        raise ConfigError(f"a comparison takes two or more runs of different names: {', '.join(names)}")
    expected = (len(sequence.test), sequence.height, sequence.width, 3)
    for run in runs:
        if run.rgb.shape != expected or len(run.result["per_view"]) != len(sequence.test):
            raise ShapeError(
                f"{sequence.name}: the run {run.name} has renders of shape {run.rgb.shape}, "
                f"expected {expected}: its held-out frames or its image size are others"
            )
    frames = [sequence.frame_name(int(frame)) for frame in sequence.test]
    truths = {run.held_out for run in runs if run.held_out}
    for run in runs:
        own = [view.get("name", name) for view, name in zip(run.result["per_view"], frames, strict=True)]
        other = next((pair for pair in zip(own, frames, strict=True) if pair[0] != pair[1]), None)
        if other is not None:
            raise ShapeError(
                f"{sequence.name}: the run {run.name} has other held-out frames: {other[0]} in place of "
                f"{other[1]}"
            )
    if len(truths) > 1:
        raise ShapeError(f"{sequence.name}: images or masks of the held-out frames differ between the runs")
    trees = [run.result["metrics"] for run in runs]
    metrics = shown_metrics(*trees)
    pictured = runs[:MOST_PICTURED]
    differing = _differing(runs)
    return rendered_page(
        "runs.html.j2",
        name=sequence.name,
        files=file_name(sequence.name),
        summary=_summary(runs),
        runs=[_head(run) for run in runs],
        figures=_figures(runs, metrics),
        figures_csv=_figures_csv(runs, metrics),
        chart=_views_chart(sequence, runs),
        pictures=_pictures(sequence, pictured, views),
        not_pictured=[run.name for run in runs[MOST_PICTURED:]],
        differing=differing,
        same=len(set().union(*(run.settings for run in runs))) - len(differing),
        protocol={
            "version": runs[0].result.get("protocol"),
            "metrics": described_metrics(*trees),
            "surface": False,
        },
        protocols=sorted({str(run.result.get("protocol")) for run in runs}),
        compare_script=script_text("compare.js"),
    )


def _summary(runs: Sequence[ComparedRun]) -> str:
    values = [metric_of(run.result["metrics"], "psnr") for run in runs]
    views = len(runs[0].result["per_view"])
    text = f"{len(runs)} runs on the same {views} held-out views."
    ceilings = [run.name for run in runs if run.held_out_trained_on]
    if ceilings:
        text += f" Held-out frames were trained on in {', '.join(ceilings)}."
    if imported := [run.name for run in runs if run.imported]:
        text += (
            " Whether they were trained on is not known of imported scenes, which are not marked as best: "
            f"{', '.join(imported)}."
        )
    known = [
        (value, run.name) for value, run in zip(values, runs, strict=True) if value is not None and run.unseen
    ]
    if not known:
        return text
    highest = max(value for value, _ in known)
    # Of those that are written alike the first: nobody is better by what is not shown.
    best, name = next(item for item in known if _same(item[0], highest, 2))
    text += f" The highest PSNR is that of {name}, {number(best, 2)} dB"
    first = values[0]
    if first is None or name == runs[0].name or not runs[0].unseen:
        return text + "."
    return f"{text}, {number(best - first, 2)} dB above {runs[0].name}."


def _head(run: ComparedRun) -> dict[str, Any]:
    gaussians = metric_of(run.result["metrics"], "n_gaussians")
    said = [
        "" if gaussians is None else f"{count(gaussians)} Gaussians",
        "" if run.seconds is None else duration(run.seconds),
    ]
    return {"name": run.name, "link": run.link, "notes": [part for part in said if part]}


def _figures(runs: Sequence[ComparedRun], metrics: Sequence[Metric]) -> list[dict[str, Any]]:
    """Rows of the table, by kind of pixels and metric; one cell per run, held against the first."""
    rows = []
    for path, label in REGIONS:
        for metric in with_coverages(metrics):
            values = [metric_of(run.result["metrics"], *path, metric.key) for run in runs]
            shares = [coverage_of(metric, run.result["metrics"], *path) for run in runs]
            if all(value is None for value in values):
                continue
            known = [
                value for value, run in zip(values, runs, strict=True) if value is not None and run.unseen
            ]
            best = max(known, default=None) if metric.higher_is_better else min(known, default=None)
            rivals = [share for share, run in zip(shares, runs, strict=True) if run.unseen]
            if not same_pixels(*rivals):
                best = None
            rows.append(
                {
                    "pixels": label,
                    "metric": metric,
                    "cells": [
                        {
                            "value": number(value, metric.digits),
                            "best": len(known) > 1 and run.unseen and _same(value, best, metric.digits),
                            "change": compare(metric, values[0], value, coverage=(shares[0], shares[place]))
                            if place
                            else None,
                        }
                        for place, (value, run) in enumerate(zip(values, runs, strict=True))
                    ],
                }
            )
    return rows


def _same(value: float | None, best: float | None, digits: int) -> bool:
    """Whether both are written alike: nobody is better by what is not shown."""
    return value is not None and best is not None and round(value, digits) == round(best, digits)


def _figures_csv(runs: Sequence[ComparedRun], metrics: Sequence[Metric]) -> str:
    rows: list[list[Cell]] = [
        [
            label,
            metric.key,
            metric.unit,
            *(metric_of(run.result["metrics"], *path, metric.key) for run in runs),
        ]
        for path, label in REGIONS
        for metric in with_coverages(metrics)
    ]
    return csv_uri(["pixels", "metric", "unit", *(run.name for run in runs)], rows)


def _differing(runs: Sequence[ComparedRun]) -> list[dict[str, Any]]:
    """Settings that not all runs share; a dash where a run does not know one."""
    names = dict.fromkeys(name for run in runs for name in run.settings)
    found = []
    for name in names:
        values = [run.settings.get(name, "\N{EN DASH}") for run in runs]
        if len(set(values)) > 1:
            found.append({"name": name, "values": values})
    return found


def _pictures(sequence: EndoscopicSequence, runs: Sequence[ComparedRun], views: int) -> ImageTable:
    chosen = evenly_spaced(len(sequence.test), views)
    judged = [Judged(run.name, run.name, as_uint8(run.rgb[chosen])) for run in runs]
    pictures = len(chosen) * (2 * len(runs) + 1)
    notes = [_note(runs, int(place)) for place in chosen]
    largest = IMAGE_BYTES // max(1, pictures)
    return judged_table(sequence, sequence.test[chosen], judged, notes, len(sequence.test), largest)


def _note(runs: Sequence[ComparedRun], view: int) -> str:
    values = [number(metric_of(run.result["per_view"][view], "psnr"), 2) for run in runs]
    share = metric_of(runs[0].result["per_view"][view], "unobserved", "pixel_share")
    said = [f"PSNR {', '.join(values)} dB"]
    if share is not None:
        said.append(f"{100 * share:.1f} % never observed")
    return " · ".join(said)


def _views_chart(sequence: EndoscopicSequence, runs: Sequence[ComparedRun]) -> Chart:
    """PSNR of every held-out view, one line per run."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = {run.name: per_view_psnr(run.result) for run in runs}
    colors = run_colors(list(values))
    marks = method_marks(colors)
    order = np.arange(len(sequence.test)) + 1
    labels = row_labels(list(values))
    columns = next(
        (count for count in range(LEGEND_COLUMNS, 1, -1) if count * max(map(len, labels)) <= LEGEND_LETTERS),
        1,
    )
    lines = -(-len(labels) // columns)
    with drawing_style():
        figure = Figure(figsize=(9.6, 2.8 + LEGEND_LINE_IN * lines), layout="constrained")
        FigureCanvasAgg(figure)
        axes: Any = figure.add_subplot()
        for label, (name, psnr) in zip(labels, values.items(), strict=True):
            axes.plot(
                order,
                psnr,
                color=colors[name],
                marker=marks[name],
                markersize=3.5,
                linewidth=1.2,
                label=label,
            )
        axes.set_title("PSNR of each held-out view (dB)")
        axes.set_xlabel("held-out view, in the order of the recording")
        axes.xaxis.get_major_locator().set_params(integer=True)
        # Not over the lines: names of runs have the settings that set them apart.
        figure.legend(ncols=columns, loc="outside lower center")
        chart = svg_image(figure)
    rows = [
        [
            sequence.frame_name(int(frame)),
            *(None if psnr is None else float(psnr[view]) for psnr in values.values()),
        ]
        for view, frame in enumerate(sequence.test)
    ]
    return chart.with_numbers("psnr_of_views", ["frame", *values], rows)
