"""The figures of a run: tiles, the table by kind of pixels, the summary in words, and all of it as CSV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from extrags.metrics.registry import Metric, figures, metrics
from extrags.report.downloads import Cell, csv_uri
from extrags.report.inputs import ReportInputs
from extrags.report.wording import (
    Comparison,
    compare,
    coverage_of,
    described_metrics,
    metric_of,
    number,
    same_pixels,
    shown_metrics,
    with_coverages,
)

__all__ = [
    "REGIONS",
    "metrics_of",
    "missing_reasons",
    "numbers_csv",
    "per_view_csv",
    "per_view_psnr",
    "protocol",
    "regions",
    "summary",
    "surface_rows",
    "tiles",
    "unobserved_shares",
]

REGIONS = (
    ((), "All valid pixels"),
    (("observed",), "Observed by training"),
    (("unobserved",), "Never observed"),
)
"""Kinds of pixels: where their figures stand in a tree of metrics, and what they are called."""
SURFACE_PARTS = (
    (("surface",), "Observed by training"),
    (("surface", "unobserved"), "Never observed"),
    (("surface",), "All that a camera sees"),
)
"""Parts of the true surface, the same way; the coverage alone is of all of it."""
_GROUP_LABELS = {
    "observed": "Observed pixels",
    "unobserved": "Unobserved pixels",
    "surface": "Figures of the surface",
    "n_gaussians": "Number of Gaussians",
}
"""Of what `EvaluationResult.reasons` names beside single figures."""


def summary(inputs: ReportInputs) -> str:
    """The result in two sentences."""
    coarse, final = metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics)
    before, after = metric_of(coarse, "psnr"), metric_of(final, "psnr")
    views = f"On {len(inputs.frames)} held-out views"
    if after is None:
        if before is None:
            return "There are no figures. " + inputs.why_absent("final", "evaluate")
        return (
            f"{views} the coarse scene reaches {number(before, 2)} dB PSNR. There is no fine-tuned scene to "
            f"compare with. {inputs.why_absent('final', 'finetune')}"
        )
    text = f"{views} the final scene reaches {number(after, 2)} dB PSNR"
    if before is not None:
        text += f", {_against(before, after)} the coarse reconstruction"
    restored = metric_of(metrics_of(inputs.restored_metrics), "psnr")
    mended = "" if restored is None else f" Restored in the image, its views reach {number(restored, 2)} dB."
    unseen = metric_of(final, "unobserved", "psnr")
    if unseen is None:
        return text + "." + mended
    text += f". On surface that no training frame saw it reaches {number(unseen, 2)} dB"
    unseen_before = metric_of(coarse, "unobserved", "psnr")
    if unseen_before is not None:
        text += f", {_against(unseen_before, unseen)} the coarse one"
    return text + "." + mended


def _against(before: float, after: float) -> str:
    change = round(after - before, 2)
    if change == 0:
        return "level with"
    return f"{number(abs(change), 2)} dB {'above' if change > 0 else 'below'}"


def tiles(inputs: ReportInputs) -> list[dict[str, Any]]:
    """One tile per metric: the final figure, and the change from the coarse one."""
    coarse, final = metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics)
    if coarse is None and final is None:
        return []
    return [
        {
            "metric": metric,
            "value": number(
                _first(metric_of(final, metric.key), metric_of(coarse, metric.key)), metric.digits
            ),
            "is_final": metric_of(final, metric.key) is not None,
            "comparison": compare(
                metric,
                metric_of(coarse, metric.key),
                metric_of(final, metric.key),
                _reason(inputs, metric.key),
                _coverage(metric, coarse, final),
            ),
        }
        for metric in shown_metrics(coarse, final)
    ]


def regions(inputs: ReportInputs) -> list[dict[str, Any]]:
    """Rows of the full table: pixels apart, plain and exposure-aligned."""
    coarse, final = metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics)
    if coarse is None and final is None:
        return []
    rows = []
    for path, label in REGIONS:
        share = _first(metric_of(final, *path, "pixel_share"), metric_of(coarse, *path, "pixel_share"))
        for alignment, kind in (((), "plain"), (("aligned",), "exposure-aligned")):
            cells = [
                None
                if alignment and metric.kind == "depth"
                else compare(
                    metric,
                    metric_of(coarse, *path, *alignment, metric.key),
                    metric_of(final, *path, *alignment, metric.key),
                    _reason(inputs, path[0] if path else metric.key),
                    _coverage(metric, coarse, final, path),
                )
                for metric in shown_metrics(coarse, final)
            ]
            rows.append(
                {
                    "label": label,
                    "share": None if share is None else f"{share:.1%}".replace("%", " %"),
                    "kind": kind,
                    "cells": cells,
                }
            )
    return rows


def surface_rows(inputs: ReportInputs) -> dict[str, Any] | None:
    """The table of the surface, `{metrics, unit, rows}`; None where neither scene has figures of it."""
    coarse, final = metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics)
    if not _has_surface(coarse, final):
        return None
    shown = [metric for metric in metrics("surface") if metric.shown.get("columns")]
    rows = []
    for path, label in SURFACE_PARTS:
        of_all = label == SURFACE_PARTS[-1][1]
        cells = [
            _surface_comparison(metric, coarse, final, path) if (metric.key == "coverage") == of_all else None
            for metric in shown
        ]
        rows.append({"label": label, "cells": cells})
    return {"metrics": shown, "unit": "mm" if inputs.sequence.metric else "units", "rows": rows}


def _surface_comparison(
    metric: Metric, coarse: Mapping[str, Any] | None, final: Mapping[str, Any] | None, path: tuple[str, ...]
) -> Comparison:
    """A figure of the surface; accuracy is judged only where about as much of the true one was found."""
    found = compare(metric, metric_of(coarse, *path, metric.key), metric_of(final, *path, metric.key))
    before, after = (metric_of(tree, *path, "recall") for tree in (coarse, final))
    if metric.key != "accuracy_mm" or before is None or after is None or same_pixels(before, after):
        return found
    said = f"over {'more' if after > before else 'less'} of the surface"
    return replace(found, verdict="other pixels", coverage=said)


def _has_surface(*trees: Mapping[str, Any] | None) -> bool:
    return any(
        metric_of(tree, *path, metric.key) is not None
        for tree in trees
        for path, _ in SURFACE_PARTS
        for metric in metrics("surface")
    )


def _coverage(
    metric: Metric,
    coarse: Mapping[str, Any] | None,
    final: Mapping[str, Any] | None,
    path: tuple[str, ...] = (),
) -> tuple[float | None, float | None]:
    """Share of the pixels that a metric is over in both scenes; None for all of them."""
    return coverage_of(metric, coarse, *path), coverage_of(metric, final, *path)


def missing_reasons(inputs: ReportInputs) -> list[tuple[str, str]]:
    """Which figures the page has no value for, and why; of the surface only where there is a table of it."""
    no_surface = not _has_surface(metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics))
    labels = {figure.name: figure.label for figure in figures()} | _GROUP_LABELS
    found: dict[str, str] = {}
    for result in (inputs.coarse_metrics, inputs.final_metrics):
        for key, reason in (result or {}).get("reasons", {}).items():
            if no_surface and key.partition(".")[0] == "surface":
                continue
            found.setdefault(labels.get(key, key), str(reason))
    return sorted(found.items())


def protocol(inputs: ReportInputs) -> dict[str, Any]:
    """Version of the protocol, and what its metrics are."""
    result = inputs.final_metrics or inputs.coarse_metrics or {}
    trees = (metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics))
    return {
        "version": result.get("protocol"),
        "metrics": described_metrics(*trees, reasons="the reason stands below the table of numbers"),
        "surface": _has_surface(*trees),
    }


def _reason(inputs: ReportInputs, key: str) -> str:
    for result in (inputs.final_metrics, inputs.coarse_metrics):
        if result is not None and key in result.get("reasons", {}):
            return str(result["reasons"][key])
    return ""


def metrics_of(result: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The means of an `EvaluationResult` as JSON."""
    return None if result is None else result["metrics"]


def _first(*values: float | None) -> float | None:
    return next((value for value in values if value is not None), None)


def per_view_psnr(result: Mapping[str, Any] | None) -> np.ndarray | None:
    """PSNR of each held-out view in dB, NaN where there is none; None without a result."""
    if result is None:
        return None
    values = [metric_of(view, "psnr") for view in result["per_view"]]
    return np.array([np.nan if value is None else value for value in values])


def unobserved_shares(inputs: ReportInputs) -> np.ndarray | None:
    """Share of each held-out view's pixels that training did not see; None where the source cannot tell."""
    result = inputs.final_metrics or inputs.coarse_metrics
    if result is None:
        return None
    shares = [metric_of(view, "unobserved", "pixel_share") for view in result["per_view"]]
    if all(share is None for share in shares):
        return None
    return np.array([np.nan if share is None else share for share in shares])


def numbers_csv(inputs: ReportInputs) -> str:
    """All means over the held-out views as a `data:` URI: kind of pixels, exposure, metric, both scenes."""
    coarse, final = metrics_of(inputs.coarse_metrics), metrics_of(inputs.final_metrics)
    trees = {"coarse": coarse, "final": final}
    if inputs.restored_metrics is not None:
        trees["restored"] = metrics_of(inputs.restored_metrics)
    rows: list[list[Cell]] = []
    for path, label in REGIONS:
        for alignment, kind in (((), "plain"), (("aligned",), "exposure-aligned")):
            for metric in with_coverages(shown_metrics(coarse, final)):
                values = [metric_of(tree, *path, *alignment, metric.key) for tree in trees.values()]
                if any(value is not None for value in values):
                    better = "higher" if metric.higher_is_better else "lower"
                    rows.append([label, kind, metric.key, metric.unit, better, *values])
    return csv_uri(["pixels", "exposure", "metric", "unit", "better", *trees], rows)


def per_view_csv(inputs: ReportInputs) -> str:
    """Every figure of every held-out view as a `data:` URI, one line per view and scene."""
    rows: list[list[Cell]] = []
    found = {
        "coarse": inputs.coarse_metrics,
        "final": inputs.final_metrics,
        "restored": inputs.restored_metrics,
    }
    flat = {
        # The name stands in a column `frame` of its own; here it is the index in the sequence.
        scene: [
            _leaves({key: value for key, value in view.items() if key != "frame"})
            for view in result["per_view"]
        ]
        for scene, result in found.items()
        if result is not None
    }
    columns = list(dict.fromkeys(name for views in flat.values() for view in views for name in view))
    for scene, views in flat.items():
        for frame, view in zip(inputs.frames, views, strict=True):
            name = inputs.sequence.frame_name(int(frame))
            rows.append([name, scene, *(view.get(column) for column in columns)])
    return csv_uri(["frame", "scene", *columns], rows)


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Cell]:
    """The numbers of a tree by dotted name."""
    found: dict[str, Cell] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= _leaves(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[prefix + name] = value
    return found
