"""benchmark-report: the page that compares methods, and its tables as files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from extrags.redaction import without_credentials, without_credentials_in
from extrags.store import Ref, Slot
from tasks.evaluate import METRICS_FILE
from tasks.report import PAGE
from tasks.stage import stage

__all__ = ["COMPARISON_FILE", "PER_VIEW_FILE", "benchmark_report"]

COMPARISON_FILE = "comparison.json"
"""Spread and paired differences: `extrags.metrics.comparison.compare_runs`."""
PER_VIEW_FILE = "per_view.json"
"""Every figure of every held-out view of every run."""


# `rows` holds times and memory of the runs, `history` those of earlier ones. The page shows them, but they
# are not part of its cache key; a run that measures anew makes its page anew as well.
@stage("benchmark-report", version=11, ignore=("rows", "history"))
def benchmark_report(
    slot: Slot,
    name: str,
    baseline: str,
    methods: dict[str, str],
    runs: list[dict[str, Any]],
    metrics: dict[str, Ref],
    failures: dict[str, str],
    pictures: list[dict[str, Any]],
    sequences: dict[str, Ref],
    renders: dict[str, Ref],
    views: int,
    rows: list[dict[str, Any]],
    history: dict[str, Any],
) -> None:
    """Build the page; writes `report.html`, `comparison.json` and `per_view.json`.

    Args:
        slot: the artefact to write.
        name: title of the page.
        baseline: method the others are compared with.
        methods: a description of each method.
        runs: `{method, profile, sequence, setting, seed, settings, image_size}` of each.
        metrics: artefact with the metrics of each run, by its index as text; failed runs have none.
        failures: error messages of failed runs, by the same index.
        pictures: `{baseline, contender, label}`: two runs, by index as text, shown side by side.
        sequences: the sequence of each run that is shown, by index.
        renders: its renders.
        views: rows of pictures per pair at most.
        rows: `{seconds, stages, peak_mib}` of each run.
        history: `{trend, regressions, not_judged}`: see `BenchmarkInputs`; empty where nothing is on record.
    """
    from extrags.metrics.comparison import compare_runs
    from extrags.metrics.protocol import RenderedViews
    from extrags.report.benchmark import BenchmarkInputs, ComparedViews, build_benchmark_report, run_label
    from extrags.report.comparison import RenderedMethod
    from extrags.sequence import EndoscopicSequence

    found = {index: slot.load_json(METRICS_FILE, ref) for index, ref in metrics.items()}
    every = _with_figures(runs, rows, found, failures)

    def rendered(index: str) -> RenderedMethod:
        shown = slot.load(RenderedViews, renders[index])
        return RenderedMethod(str(runs[int(index)]["method"]), shown.rgb, found[index]["per_view"])

    compared = [
        ComparedViews(
            # Frames of equal content are one artefact, whatever their sources are called.
            replace(
                slot.load(EndoscopicSequence, sequences[pair["baseline"]]),
                name=run_label(runs[int(pair["baseline"])]),
            ),
            pair["label"],
            rendered(pair["baseline"]),
            rendered(pair["contender"]),
        )
        for pair in pictures
    ]
    page = build_benchmark_report(
        BenchmarkInputs(
            name=name,
            runs=every,
            baseline=baseline,
            methods=methods,
            pictures=compared,
            views=views,
            history=history.get("trend", ()),
            regressions=history.get("regressions", ()),
            not_judged=history.get("not_judged", ()),
        )
    )
    (slot.path / PAGE).write_text(without_credentials(page), encoding="utf-8")
    slot.save_json(COMPARISON_FILE, compare_runs(every, baseline), indent=1)
    slot.save_json(PER_VIEW_FILE, without_credentials_in(_per_view(runs, found)), indent=1)
    slot.counts.update(runs=len(runs), kib=round(len(page.encode()) / 1024))


def _with_figures(
    runs: list[dict[str, Any]],
    rows: list[dict[str, Any]],
    found: dict[str, Any],
    failures: dict[str, str],
) -> list[dict[str, Any]]:
    """The runs with what they cost, their metrics (None where they failed) and their errors."""
    return [
        {
            **run,
            **rows[index],
            "metrics": found[str(index)]["metrics"] if str(index) in found else None,
            "error": failures.get(str(index), ""),
        }
        for index, run in enumerate(runs)
    ]


def _per_view(runs: list[dict[str, Any]], found: dict[str, Any]) -> list[dict[str, Any]]:
    """Every figure of every held-out view of every run that has figures."""
    return [
        {**run, "protocol": found[str(index)]["protocol"], "per_view": found[str(index)]["per_view"]}
        for index, run in enumerate(runs)
        if str(index) in found
    ]
