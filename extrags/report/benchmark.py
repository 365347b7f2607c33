"""The page of a benchmark: methods compared over sequences and seeds, in numbers, charts and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from extrags.metrics.comparison import CEILING, compare_runs, figure_of
from extrags.metrics.registry import Figure, figures
from extrags.report.charts import method_colors, methods_chart, pairs_chart
from extrags.report.comparison import RenderedMethod, compared_rows
from extrags.report.downloads import Chart
from extrags.report.page import rendered_page
from extrags.report.run_facts import given_settings, seconds_of_all, shared_facts
from extrags.report.trend import trend_chart
from extrags.report.wording import count, described_metrics, duration, number, percent, same_pixels
from extrags.sequence import EndoscopicSequence

__all__ = ["BenchmarkInputs", "ComparedViews", "build_benchmark_report", "run_label"]

NO_CELL = {"value": "–", "verdict": "", "note": "", "better": ""}  # noqa: RUF001
"""A figure that was not measured."""

LARGEST_PAGE_BYTES = 5_000_000
"""The share of the pictures; numbers and charts come on top."""


@dataclass(frozen=True)
class ComparedViews:
    """Renders of two methods to be shown side by side.

    Args:
        sequence: with its held-out frames.
        label: what is said of the run, e.g. `seed 0`.
        baseline: the method it is compared with.
        contender: the other.
    """

    sequence: EndoscopicSequence
    label: str
    baseline: RenderedMethod
    contender: RenderedMethod


@dataclass(frozen=True)
class BenchmarkInputs:
    """Everything the page shows.

    Args:
        name: title.
        runs: `{method, profile, sequence, setting, seed, settings, image_size, seconds, stages, peak_mib,
            metrics, error}` of each; `metrics` is None for a failed run, whose `error` says why. `settings`
            were given beside the profile, `image_size` is width and height in px, and of `stages`
            `{artefacts, made_seconds}` tell what runs share; these three may be missing.
        baseline: method the others are compared with.
        methods: what each method is, in words, in the order they are shown.
        pictures: held-out views side by side.
        views: rows of pictures per sequence at most.
        made: when, in words; nothing is said when empty.
        history: `{when, commit, version, methods: {METHOD: {psnr, seconds}}}` of its runs over time, the
            oldest first and this one last.
        regressions: what is worse than in the runs before, in words.
        not_judged: what too few runs before can be compared with, in words.
    """

    name: str
    runs: Sequence[Mapping[str, Any]]
    baseline: str
    methods: Mapping[str, str]
    pictures: Sequence[ComparedViews] = ()
    views: int = 4
    made: str = field(default="")
    history: Sequence[Mapping[str, Any]] = ()
    regressions: Sequence[str] = ()
    not_judged: Sequence[str] = ()


def build_benchmark_report(inputs: BenchmarkInputs) -> str:
    """One self-contained HTML page.

    Differences are paired: two runs that share all but the method. Intervals and means are those of
    `extrags.metrics.comparison`.
    """
    comparison = compare_runs(inputs.runs, inputs.baseline)
    measured = [run for run in inputs.runs if run["metrics"] is not None]
    columns = [
        column
        for column in figures("columns")
        if any(figure_of(run["metrics"], column.name) is not None for run in measured)
    ]
    settings = [run.get("settings", {}) for run in inputs.runs]
    images = sum(5 * min(inputs.views, len(pair.sequence.test)) for pair in inputs.pictures)
    largest = LARGEST_PAGE_BYTES // max(images, 1)
    return rendered_page(
        "benchmark.html.j2",
        name=inputs.name,
        made=inputs.made,
        baseline=inputs.baseline,
        summary=_summary(comparison, inputs),
        facts=[
            ("Runs", count(len(inputs.runs))),
            ("Sequences", count(len({(run["sequence"], run["setting"]) for run in inputs.runs}))),
            ("Seeds", count(len({run["seed"] for run in inputs.runs}))),
            (
                "Run time of all",
                duration(seconds_of_all((run["seconds"], run.get("stages", ())) for run in inputs.runs)),
            ),
            *shared_facts([run.get("image_size") for run in inputs.runs], settings),
        ],
        given=given_settings([run_label(run) for run in inputs.runs], settings),
        methods=inputs.methods,
        failures=[
            (
                f"{run_label(run)}, {run['method']}, seed {run['seed']}",
                run["error"] or "no reason was recorded",
            )
            for run in inputs.runs
            if run["metrics"] is None
        ],
        columns=columns,
        paired_datasets=_rows(comparison["paired_datasets"], columns, cell=_difference_cell),
        paired_sequences=_rows(comparison["paired_sequences"], columns, cell=_difference_cell),
        datasets=_rows(comparison["datasets"], columns, cell=_mean_cell),
        sequences=_rows(comparison["sequences"], columns, cell=_mean_cell),
        ceiling=CEILING,
        ceiling_datasets=_rows(comparison["ceiling_datasets"], columns, cell=_share_cell),
        ceiling_sequences=_rows(comparison["ceiling_sequences"], columns, cell=_share_cell),
        difference_chart=_difference_chart(comparison["paired_sequences"], columns, inputs.baseline),
        figure_charts=_figure_charts(measured, columns, inputs),
        regressions=inputs.regressions,
        not_judged=inputs.not_judged,
        history=inputs.history,
        trend_chart=_trend_chart(inputs),
        pictures=[
            (
                f"{pair.sequence.name}, {pair.label}",
                compared_rows(pair.sequence, (pair.baseline, pair.contender), inputs.views, largest),
            )
            for pair in inputs.pictures
        ],
        protocol={
            "version": None,
            "metrics": described_metrics(*(run["metrics"] for run in measured)),
            "surface": any(column.name.startswith("surface.") for column in columns),
        },
    )


def _summary(comparison: Mapping[str, Any], inputs: BenchmarkInputs) -> str:
    said = []
    several = _several_profiles(inputs.runs)
    for row in comparison["paired_datasets"]:
        if row["method"] == CEILING:
            continue
        name = next((name for name in ("observed.psnr", "psnr") if name in row["figures"]), None)
        if name is None:
            continue
        figure = row["figures"][name]
        where = "observed pixels" if name.startswith("observed") else "all valid pixels"
        interval = _interval(figure, 2)
        profile = f" ({row['profile']})" if several else ""
        said.append(
            f"{row['method']} against {inputs.baseline} on {row['dataset']}{profile}: "
            f"{number(figure['mean'], 2, signed=True)} dB PSNR on {where}"
            f"{f' (95 % interval {interval})' if interval else ''}, better on {figure['better']} of "
            f"{figure['n']} {'sequence' if figure['n'] == 1 else 'sequences'}."
        )
    return " ".join(said) or "No two runs share everything but the method: there is nothing to compare."


def _rows(
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[Figure],
    *,
    cell: Callable[[Mapping[str, Any], Figure], dict[str, str]],
) -> list[dict[str, Any]]:
    return [
        {
            "about": row["dataset"] if "dataset" in row else run_label(row),
            "profile": row["profile"],
            "method": row["method"],
            "sizes": _sizes(row),
            "cells": [
                cell(row["figures"], column) if column.name in row["figures"] else NO_CELL
                for column in columns
            ],
        }
        for row in rows
    ]


def _mean_cell(found: Mapping[str, Any], column: Figure) -> dict[str, str]:
    figure = found[column.name]
    deviation = figure["deviation"]
    note = "" if deviation is None else f"± {number(deviation, column.digits)}"
    return {**NO_CELL, "value": number(figure["mean"], column.digits), "note": note}


def _difference_cell(found: Mapping[str, Any], column: Figure) -> dict[str, str]:
    figure = found[column.name]
    if note := _apart(found, column):
        return {**NO_CELL, "value": number(figure["mean"], column.digits, signed=True), "note": note}
    if all(round(figure[end], column.digits) == 0 for end in ("smallest", "largest")):
        verdict = "equal"
    elif not _beyond_noise(figure):
        verdict = ""
    else:
        verdict = "better" if (figure["mean"] > 0) == column.higher_is_better else "worse"
    return {
        "value": number(figure["mean"], column.digits, signed=True),
        "verdict": verdict,
        "note": _interval(figure, column.digits),
        "better": f"better in {figure['better']} of {figure['n']}",
    }


def _beyond_noise(figure: Mapping[str, Any]) -> bool:
    """Whether the interval of a difference leaves out 0; never of a single pair, which has none."""
    return figure["low"] is not None and (figure["low"] > 0 or figure["high"] < 0)


def _apart(found: Mapping[str, Any], column: Figure) -> str:
    """Why the figure of a row of differences is not judged: it is over other pixels; else empty.

    A scene that leaves out what is hard looks accurate: the accuracy of the surface is judged where as much
    of the true one was found.
    """
    group, _, name = column.name.rpartition(".")
    of_surface = name == "accuracy_mm"
    share = found.get(f"{group}.recall" if of_surface else column.coverage)
    if share is None:
        return ""
    # One pair whose pixels differ is enough; those of two may differ in opposite ways.
    fewer, more = (not same_pixels(0.0, share[end]) for end in ("smallest", "largest"))
    fewer, more = fewer and share["smallest"] < 0, more and share["largest"] > 0
    if not fewer and not more:
        return ""
    if of_surface:
        return f"over {'other parts' if fewer and more else 'more' if more else 'less'} of the surface"
    return f"over {'other' if fewer and more else 'more' if more else 'fewer'} pixels: see the coverage"


def _share_cell(found: Mapping[str, Any], column: Figure) -> dict[str, str]:
    figure = found[column.name]
    note = "" if figure["low"] is None else f"{percent(figure['low'])} to {percent(figure['high'])}"
    return {**NO_CELL, "value": percent(figure["mean"]), "note": note}


def _interval(figure: Mapping[str, Any], digits: int) -> str:
    if figure["low"] is None:
        return ""
    low, high = (number(figure[end], digits, signed=True) for end in ("low", "high"))
    return f"{low} to {high}"


def _sizes(row: Mapping[str, Any]) -> str:
    parts = [f"{row['n_seeds']} seed{'s' * (row['n_seeds'] != 1)}"]
    if "dataset" in row:
        parts.insert(0, f"{row['n_sequences']} sequence{'s' * (row['n_sequences'] != 1)}")
    return ", ".join(parts)


def _difference_chart(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[Figure], baseline: str
) -> tuple[Chart, str] | None:
    panels = [column for column in columns if column in figures("charts")]
    if not rows or not panels:
        return None
    several = len({row["method"] for row in rows}) > 1
    line_of = _line_names(rows)
    lines: list[tuple[str, list[tuple[float, float | None, float | None] | None]]] = []
    unjudged: set[tuple[int, int]] = set()
    for row in rows:
        given = [row["figures"].get(panel.name) for panel in panels]
        cells = [None if found is None else (found["mean"], found["low"], found["high"]) for found in given]
        unjudged |= {
            (len(lines), place)
            for place, (panel, found) in enumerate(zip(panels, given, strict=True))
            if found is not None and (_apart(row["figures"], panel) or not _beyond_noise(found))
        }
        lines.append((f"{row['method']}, {line_of(row)}" if several else line_of(row), cells))
    titles = [
        (f"{panel.label} ({panel.unit})" if panel.unit else panel.label, panel.higher_is_better)
        for panel in panels
    ]
    alt = f"Differences to {baseline} of each sequence with their 95 % intervals over the seeds"
    return pairs_chart(titles, lines, unjudged), alt


def _figure_charts(
    runs: Sequence[Mapping[str, Any]], columns: Sequence[Figure], inputs: BenchmarkInputs
) -> list[tuple[Chart, str]]:
    known = {column.name: column for column in columns}
    names = [figure.name for figure in figures("charts")[:2] if figure.name in known]
    # Of all pixels only where some source cannot tell what was observed.
    told = [run for run in runs if any(figure_of(run["metrics"], name) is not None for name in names)]
    names += [name for name in ("psnr",) if name in known and len(told) < len(runs)]
    line_of = _line_names(runs)
    charts = []
    for name in names:
        having = [run for run in runs if figure_of(run["metrics"], name) is not None]
        title = f"{known[name].label} ({known[name].unit})"
        chart = methods_chart(
            list(dict.fromkeys(line_of(run) for run in having)),
            _by_method(having, [figure_of(run["metrics"], name) or 0.0 for run in having], line_of),
            _by_method(having, [float(run["seconds"]) for run in having], line_of),
            method_colors(list(inputs.methods), inputs.baseline),
            title,
        )
        which = (
            "every run" if len(having) == len(runs) else f"the {len(having)} of {len(runs)} runs that have it"
        )
        alt = f"{title} on held-out views of {which}, by sequence and method, and against run time"
        charts.append((chart, alt))
    return charts


def _trend_chart(inputs: BenchmarkInputs) -> tuple[Chart, str] | None:
    chart = trend_chart(inputs.history, method_colors(list(inputs.methods), inputs.baseline))
    if chart is None:
        return None
    return chart, f"PSNR and run time of each method over {len(inputs.history)} runs of this benchmark"


def _by_method(
    runs: Sequence[Mapping[str, Any]],
    values: Sequence[float],
    line_of: Callable[[Mapping[str, Any]], str],
) -> dict[str, dict[str, list[float]]]:
    found: dict[str, dict[str, list[float]]] = {}
    for run, value in zip(runs, values, strict=True):
        found.setdefault(run["method"], {}).setdefault(line_of(run), []).append(value)
    return found


def run_label(run: Mapping[str, Any]) -> str:
    """The sequence of a run, with its setting where it has one."""
    return f"{run['sequence']}@{run['setting']}" if run["setting"] else str(run["sequence"])


def _several_profiles(runs: Sequence[Mapping[str, Any]]) -> bool:
    return len({run["profile"] for run in runs}) > 1


def _line_names(runs: Sequence[Mapping[str, Any]]) -> Callable[[Mapping[str, Any]], str]:
    """What a line of a chart is called; profiles have lines of their own where there are several."""
    if not _several_profiles(runs):
        return run_label
    return lambda run: f"{run_label(run)}, {run['profile']}"
