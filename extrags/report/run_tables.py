"""What a run was: its facts, plan, times of stages and settings, ready to be shown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from extrags.config import PROFILES, PipelineConfig
from extrags.report.inputs import ReportInputs
from extrags.report.measurements import measured_figure, measurement_rows
from extrags.report.numbers import metrics_of
from extrags.report.wording import count, duration, intrinsics_in_words, metric_of

__all__ = [
    "facts",
    "flat_settings",
    "plain_value",
    "plan_rows",
    "setting_groups",
    "stage_rows",
    "stage_summary",
    "usual_settings",
]


def facts(inputs: ReportInputs) -> list[tuple[str, str]]:
    """Frames, split, size, scale and run time, each with its label."""
    sequence = inputs.sequence
    final = metrics_of(inputs.final_metrics) or metrics_of(inputs.coarse_metrics)
    facts = [
        ("Training frames", _frames(len(sequence.train), inputs.without_pose[0])),
        ("Held-out frames", _frames(len(inputs.frames), inputs.without_pose[1])),
        ("Split", sequence.split.name),
        ("Image size", f"{sequence.width} \N{MULTIPLICATION SIGN} {sequence.height} px"),
    ]
    recordings = 1 if sequence.recording is None else len(np.unique(sequence.recording))
    if recordings > 1:
        facts.append(("Recordings", count(recordings)))
    if sequence.stereo_camera is not None:
        facts.append(("Camera", f"{sequence.stereo_camera} one of a stereo endoscope"))
    facts.append(("Scale", sequence.scale_words.removesuffix(" scale")))
    if sequence.intrinsics != "given":
        facts.append(("Focal length", intrinsics_in_words(sequence)))
    if (gaussians := metric_of(final, "n_gaussians")) is not None:
        facts.append(("Gaussians", count(gaussians)))
    if inputs.stages:
        facts.append(("Run time", duration(_spent(inputs))))
    return facts


def _frames(there: int, without_pose: int) -> str:
    if not without_pose:
        return count(there)
    return f"{count(there)} of {count(there + without_pose)}, the others without a pose"


def plan_rows(inputs: ReportInputs) -> dict[str, Any] | None:
    """Measurements and decisions of the scene plan; None without one."""
    if inputs.plan is None:
        return None
    return {
        "measurements": measurement_rows(inputs.plan["measurements"], metric=inputs.sequence.metric),
        "decisions": [
            {
                "stage": line["stage"],
                "run": line["run"],
                "value": measured_figure(line["value"]),
                "threshold": measured_figure(line["threshold"]),
                "budget": [f"{key} = {value}" for key, value in line["budget"].items()],
                "saves": "" if line.get("saves_s") is None else f"{line['saves_s']:.1f} s",
                "reason": line["reason"],
            }
            for line in inputs.plan["decisions"]
        ],
    }


def stage_rows(inputs: ReportInputs) -> list[dict[str, Any]]:
    """Times of the stages, with bars in proportion."""
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


def stage_summary(inputs: ReportInputs) -> str:
    """How long it took, how many stages ran, and what the cache spared."""
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


def usual_settings(profile: str) -> tuple[str, PipelineConfig]:
    """What a run's settings are held against, by its name: the profile it was run with, else the defaults.

    Args:
        profile: as pages have it: its name, and what else there is to say after a comma.
    """
    name = profile.partition(",")[0]
    return (f"profile {name}", PROFILES[name]) if name in PROFILES else ("default", PipelineConfig())


def setting_groups(config: PipelineConfig | None, profile: str) -> list[dict[str, Any]]:
    """All settings by stage, those that differ from the profile's marked.

    Args:
        config: of the run.
        profile: see `usual_settings`.
    """
    if config is None:
        return []
    _, defaults = usual_settings(profile)
    groups = []
    for stage in type(config).model_fields:
        values, usual = (_group(whole, stage) for whole in (config, defaults))
        groups.append(
            {
                "stage": stage,
                "rows": [
                    {
                        "name": name,
                        "value": plain_value(value),
                        "usual": plain_value(usual[name]) if value != usual[name] else "",
                    }
                    for name, value in values.items()
                ],
            }
        )
    return groups


def _group(config: PipelineConfig, name: str) -> dict[str, Any]:
    """Settings of a stage; one that is set for the whole run is a group of its own."""
    found = getattr(config, name)
    return flat_settings(found) if isinstance(found, BaseModel) else {name: found}


def flat_settings(model: BaseModel, prefix: str = "") -> dict[str, Any]:
    """Values of all settings by dotted name."""
    found: dict[str, Any] = {}
    for name, value in model:
        if isinstance(value, BaseModel):
            found |= flat_settings(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def plain_value(value: Any) -> str:
    """A setting as a page shows it."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value is None else str(value)
