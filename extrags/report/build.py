"""The page of one sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import BaseModel

from extrags.config import PipelineConfig, ReportConfig
from extrags.metrics.registry import metrics
from extrags.report.charts import gain_chart, history_chart, views_chart
from extrags.report.estimated_depth import estimated_depth
from extrags.report.inputs import ReportInputs
from extrags.report.page import rendered_page
from extrags.report.space import occupancy_slices, scene_views, trajectory_colors
from extrags.report.viewer.content import viewer_section
from extrags.report.views import depth_rows, held_out_rows, virtual_rows
from extrags.report.wording import (
    compare,
    count,
    described_metrics,
    duration,
    intrinsics_in_words,
    metric_of,
    number,
    shown_metrics,
)

__all__ = ["build_pages", "build_report"]

IMAGE_BYTES = 4_200_000
"""For all images of views together; charts and figures of the scene need about one million more."""

_REGIONS = (
    ((), "All valid pixels"),
    (("observed",), "Observed by training"),
    (("unobserved",), "Never observed"),
)


def build_report(inputs: ReportInputs, config: ReportConfig) -> str:
    """One self-contained HTML page: numbers, images, figures, plan, times and settings.

    The page needs no network and depends on its inputs only: the same inputs give the same text. What is
    missing is left out with a sentence saying why. Its scripts, which stand in the page, draw the scene and
    lay views on each other; all else can be read without them.

    Args:
        inputs: what the stages made.
        config: how many views to show.

    Returns:
        HTML, below about 6 MB, and what `viewer_mb` allows for the scenes.

    Raises:
        NonFiniteError: when an image to be shown holds NaN or infinity.
        ConfigError: when so many views are asked for that not even thumbnails fit.
    """
    return build_pages(inputs, config)[0]


def build_pages(inputs: ReportInputs, config: ReportConfig) -> tuple[str, str]:
    """The page of `build_report`, and the same page without what two runs with equal results differ in.

    These are times, whether stages ran or came from the cache, and the machine.

    Args:
        inputs: what the stages made.
        config: how many views to show.

    Raises:
        NonFiniteError: when an image to be shown holds NaN or infinity.
        ConfigError: when so many views are asked for that not even thumbnails fit.
    """
    shared: dict[str, Any] = dict(
        name=inputs.name,
        profile=inputs.profile,
        summary=_summary(inputs),
        tiles=_tiles(inputs),
        regions=_regions(inputs),
        missing_reasons=_missing_reasons(inputs),
        **_views(inputs, config),
        **viewer_section(inputs, config),
        curves=history_chart(inputs.history) if any(inputs.history.values()) else None,
        curves_absent=inputs.why_absent("history", "coarse"),
        **_space(inputs),
        plan=_plan(inputs),
        plan_absent=inputs.why_absent("plan", "assess"),
        stages_absent="No stage times were handed to this report.",
        protocol=_protocol(inputs),
        settings=_settings(inputs.config),
    )
    pages = [
        rendered_page(
            "sequence.html.j2",
            **shared,
            made=shown.made,
            facts=_facts(shown),
            stages=_stages(shown),
            stage_summary=_stage_summary(shown),
            environment=dict(shown.environment),
        )
        for shown in (inputs, replace(inputs, made="", stages=[], environment={}))
    ]
    return pages[0], pages[1]


def _facts(inputs: ReportInputs) -> list[tuple[str, str]]:
    sequence = inputs.sequence
    final = _metrics(inputs.final_metrics) or _metrics(inputs.coarse_metrics)
    facts = [
        ("Training frames", count(len(sequence.train))),
        ("Held-out frames", count(len(inputs.frames))),
        ("Split", sequence.split.name),
        ("Image size", f"{sequence.width} \N{MULTIPLICATION SIGN} {sequence.height} px"),
    ]
    recordings = 1 if sequence.recording is None else len(np.unique(sequence.recording))
    if recordings > 1:
        facts.append(("Recordings", count(recordings)))
    facts.append(("Scale", sequence.scale_words.removesuffix(" scale")))
    if sequence.intrinsics != "given":
        facts.append(("Focal length", intrinsics_in_words(sequence)))
    if (gaussians := metric_of(final, "n_gaussians")) is not None:
        facts.append(("Gaussians", count(gaussians)))
    if inputs.stages:
        facts.append(("Run time", duration(_spent(inputs))))
    return facts


def _summary(inputs: ReportInputs) -> str:
    """The result in two sentences."""
    coarse, final = _metrics(inputs.coarse_metrics), _metrics(inputs.final_metrics)
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
    restored = metric_of(_metrics(inputs.restored_metrics), "psnr")
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


def _tiles(inputs: ReportInputs) -> list[dict[str, Any]]:
    coarse, final = _metrics(inputs.coarse_metrics), _metrics(inputs.final_metrics)
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
            ),
        }
        for metric in shown_metrics(coarse, final)
    ]


def _regions(inputs: ReportInputs) -> list[dict[str, Any]]:
    """Rows of the full table: pixels apart, plain and exposure-aligned."""
    coarse, final = _metrics(inputs.coarse_metrics), _metrics(inputs.final_metrics)
    if coarse is None and final is None:
        return []
    rows = []
    for path, label in _REGIONS:
        share = _first(metric_of(final, *path, "pixel_share"), metric_of(coarse, *path, "pixel_share"))
        for alignment, kind in (((), "plain"), (("aligned",), "exposure-aligned")):
            cells = [
                None
                if alignment and metric.key.startswith("depth")
                else compare(
                    metric,
                    metric_of(coarse, *path, *alignment, metric.key),
                    metric_of(final, *path, *alignment, metric.key),
                    _reason(inputs, path[0] if path else metric.key),
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


def _missing_reasons(inputs: ReportInputs) -> list[tuple[str, str]]:
    labels = {metric.key: metric.label for metric in metrics()}
    found: dict[str, str] = {}
    for result in (inputs.coarse_metrics, inputs.final_metrics):
        for key, reason in (result or {}).get("reasons", {}).items():
            found.setdefault(labels.get(key, f"{key} pixels".capitalize()), str(reason))
    return sorted(found.items())


def _views(inputs: ReportInputs, config: ReportConfig) -> dict[str, Any]:
    held_out = min(config.held_out_views, len(inputs.frames)) if inputs.coarse or inputs.final else 0
    virtual = 0 if inputs.pseudo is None else min(config.virtual_views, len(inputs.pseudo.rendered))
    has_depth = held_out > 0 and inputs.sequence.true_depth_mm is not None
    estimated = 0 if inputs.depth is None else min(config.held_out_views, len(inputs.sequence.train))
    images = 5 * (held_out + virtual + (held_out if has_depth else 0) + estimated)
    largest = IMAGE_BYTES // max(1, images)
    coarse, final = _per_view_psnr(inputs.coarse_metrics), _per_view_psnr(inputs.final_metrics)
    chart = None if coarse is None else views_chart(coarse, final, _unobserved_shares(inputs))
    return {
        "held_out": held_out_rows(inputs, held_out, largest) if held_out else None,
        "held_out_absent": inputs.why_absent("coarse", "evaluate"),
        "final_absent": None if inputs.final is not None else inputs.why_absent("final", "finetune"),
        "views_chart": chart,
        "depth": depth_rows(inputs, held_out, largest) if has_depth else None,
        "estimated": None
        if inputs.depth is None
        else estimated_depth(inputs.sequence, inputs.depth, estimated, largest),
        "depth_absent": inputs.absent.get("depth", "there is no true depth to compare with"),
        "virtual": virtual_rows(inputs.pseudo, inputs.sequence, virtual, largest)
        if inputs.pseudo is not None and virtual
        else None,
        "virtual_absent": inputs.why_absent("pseudo", "enhance"),
    }


def _space(inputs: ReportInputs) -> dict[str, Any]:
    sequence = inputs.sequence
    unit = "mm" if sequence.metric else "units"
    found: dict[str, Any] = {
        "scene_figures": None,
        "scene_absent": inputs.why_absent("poses", "poses"),
        "slices": None,
        "slices_absent": inputs.why_absent("grid", "freespace"),
        "surface_note": None,
        "has_surface": inputs.mesh is not None or inputs.grid is not None,
        "exploration": _exploration(inputs),
        "exploration_absent": inputs.why_absent("trajectories", "explore"),
        "gain_chart": None,
        "gain_title": None,
        "voxel": None,
        "unit": unit,
    }
    if sequence.world_from_camera is None:
        return found
    cameras = sequence.cameras
    train, held_out = cameras[sequence.train], cameras[inputs.frames]
    found["scene_figures"] = scene_views(
        train, held_out, inputs.trajectories, inputs.mesh, inputs.grid, unit=unit
    )
    if inputs.mesh is None:
        instead = (
            "No surface is drawn"
            if inputs.grid is None
            else "Squares between free and occupied voxels stand for it"
        )
        found["surface_note"] = f"There is no mesh. {inputs.why_absent('mesh', 'surface')} {instead}."
    if inputs.grid is not None:
        found["slices"] = occupancy_slices(inputs.grid, train, inputs.trajectories)
        size = inputs.grid.occupancy.shape[0]
        found["voxel"] = f"{size}³ voxels of {inputs.grid.voxel_mm:.3g} {unit}"
    if inputs.exploration and inputs.exploration["trajectories"]:
        paths = inputs.exploration["trajectories"]
        found["gain_chart"] = gain_chart(
            [_worth_percent(path, inputs.exploration) for path in paths],
            trajectory_colors(len(paths)),
            title=GAIN_TITLES[_score(inputs.exploration)],
        )
        found["gain_title"] = GAIN_TITLES[_score(inputs.exploration)]
    return found


GAIN_TITLES = {
    "error": "Removable error that each trajectory takes away (% of all)",
    "pairs": "Newly covered (Gaussian, direction) pairs per trajectory (% of all)",
}
"""By what a view is worth, `explore.score`."""


def _score(summary: Mapping[str, Any]) -> str:
    return str(summary.get("score", "pairs"))


def _worth_percent(path: Mapping[str, Any], summary: Mapping[str, Any]) -> float:
    """What a trajectory adds: of the error that views could take away, or of all pairs."""
    if _score(summary) == "error":
        return float(100 * path["value"] / max(summary["removable_error"], 1e-12))
    return float(100 * path["gain"] / max(1, summary["pairs"]))


def _exploration(inputs: ReportInputs) -> dict[str, Any] | None:
    """The numbers of the search and one row per trajectory; None when there is no trajectory."""
    if not inputs.trajectories:
        return None
    summary = inputs.exploration or {}
    colors = trajectory_colors(len(inputs.trajectories))
    rows = []
    for index, poses in enumerate(inputs.trajectories):
        said = summary["trajectories"][index] if summary else {}
        length = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
        rows.append(
            {
                "color": colors[index],
                "start": inputs.sequence.frame_name(said["anchor_frame"]) if said else "",
                "views": len(poses),
                "length": number(length, 1),
                "gain": f"{_worth_percent(said, summary):.2f} %" if said else "",
                "reason": said.get("reason", ""),
            }
        )
    facts = []
    if summary:
        share = summary["coverage_share"]
        facts = [("Virtual views", count(summary["virtual_views"]))]
        if _score(summary) == "error":
            removable, removed = summary["removable_error"], summary["removed_error"]
            facts += [
                (
                    "Error of views off the trajectory that virtual views could take away",
                    f"{100 * removable:.2f} %",
                ),
                ("Taken away", f"{100 * removed / max(removable, 1e-12):.0f} % of it"),
            ]
        facts += [
            ("Coverage before", f"{100 * share['before']:.2f} %"),
            ("Coverage after", f"{100 * share['after']:.2f} %"),
            ("Renders spent", count(summary["renders"])),
            ("Waves", count(summary["waves"])),
            ("Branches not accepted", count(len(summary["rejected"]))),
        ]
    return {"facts": facts, "rows": rows, "rejected": [str(line) for line in summary.get("rejected", ())]}


def _plan(inputs: ReportInputs) -> dict[str, Any] | None:
    if inputs.plan is None:
        return None
    return {
        "measurements": [
            (name.replace("_", " "), _figure(value)) for name, value in inputs.plan["measurements"].items()
        ],
        "decisions": [
            {
                "stage": line["stage"],
                "run": line["run"],
                "value": _figure(line["value"]),
                "threshold": _figure(line["threshold"]),
                "budget": [f"{key} = {value}" for key, value in line["budget"].items()],
                "reason": line["reason"],
            }
            for line in inputs.plan["decisions"]
        ],
    }


def _stages(inputs: ReportInputs) -> list[dict[str, Any]]:
    longest = max((_cost(row) for row in inputs.stages), default=0.0)
    return [
        {
            "stage": row["stage"],
            "state": row["state"],
            "seconds": duration(None if row["state"] == "skipped" else row.get("seconds")),
            "made": duration(row["made_seconds"]) if _made(row) else "",
            "width": f"{100 * _cost(row) / longest:.2f}" if longest > 0 else "0",
            "reason": row.get("reason") or "",
        }
        for row in inputs.stages
    ]


def _stage_summary(inputs: ReportInputs) -> str:
    parts = []
    for state, words in (
        ("ran", "ran"),
        ("cached", "came from the cache"),
        ("skipped", "skipped"),
        ("failed", "failed"),
    ):
        found = sum(row["state"] == state for row in inputs.stages)
        if found:
            parts.append(f"{found} {words}")
    saved = sum(float(row["made_seconds"]) for row in inputs.stages if _made(row))
    text = f"{duration(_spent(inputs))} in all: {', '.join(parts)}."
    if saved > 0:
        text += f" The cache spared {duration(saved)}; those stages show what they took when they ran."
    return text


def _made(row: Mapping[str, Any]) -> bool:
    return row["state"] == "cached" and row.get("made_seconds") is not None


def _cost(row: Mapping[str, Any]) -> float:
    return float(row["made_seconds"] if _made(row) else row.get("seconds") or 0)


def _spent(inputs: ReportInputs) -> float:
    return sum((float(row.get("seconds") or 0) for row in inputs.stages), 0.0)


def _protocol(inputs: ReportInputs) -> dict[str, Any]:
    result = inputs.final_metrics or inputs.coarse_metrics or {}
    trees = (_metrics(inputs.coarse_metrics), _metrics(inputs.final_metrics))
    return {"version": result.get("protocol"), "metrics": described_metrics(*trees)}


def _settings(config: PipelineConfig | None) -> list[dict[str, Any]]:
    """All settings by stage, those that differ from the defaults marked."""
    if config is None:
        return []
    defaults = PipelineConfig()
    groups = []
    for stage in type(config).model_fields:
        values, usual = _flat(getattr(config, stage)), _flat(getattr(defaults, stage))
        groups.append(
            {
                "stage": stage,
                "rows": [
                    {
                        "name": name,
                        "value": _plain(value),
                        "usual": _plain(usual[name]) if value != usual[name] else "",
                    }
                    for name, value in values.items()
                ],
            }
        )
    return groups


def _flat(model: BaseModel, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in model:
        if isinstance(value, BaseModel):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def _figure(value: float | int) -> str:
    """A measured number: whole ones as counts, others with four digits."""
    return count(value) if float(value).is_integer() else f"{float(value):.4g}"


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value is None else str(value)


def _metrics(result: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    return None if result is None else result["metrics"]


def _reason(inputs: ReportInputs, key: str) -> str:
    for result in (inputs.final_metrics, inputs.coarse_metrics):
        if result is not None and key in result.get("reasons", {}):
            return str(result["reasons"][key])
    return ""


def _first(*values: float | None) -> float | None:
    return next((value for value in values if value is not None), None)


def _per_view_psnr(result: Mapping[str, Any] | None) -> np.ndarray | None:
    if result is None:
        return None
    values = [metric_of(view, "psnr") for view in result["per_view"]]
    return np.array([np.nan if value is None else value for value in values])


def _unobserved_shares(inputs: ReportInputs) -> np.ndarray | None:
    result = inputs.final_metrics or inputs.coarse_metrics
    if result is None:
        return None
    shares = [metric_of(view, "unobserved", "pixel_share") for view in result["per_view"]]
    if all(share is None for share in shares):
        return None
    return np.array([np.nan if share is None else share for share in shares])
