"""The page of one sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from extrags.config import ReportConfig
from extrags.measured_depth import GROSS_ERROR, doubts_in_words
from extrags.report.charts import gain_chart, history_chart, views_chart
from extrags.report.downloads import file_name
from extrags.report.estimated_depth import estimated_depth
from extrags.report.inputs import ReportInputs
from extrags.report.numbers import (
    missing_reasons,
    numbers_csv,
    per_view_csv,
    per_view_psnr,
    protocol,
    regions,
    summary,
    surface_rows,
    tiles,
    unobserved_shares,
)
from extrags.report.page import rendered_page
from extrags.report.run_tables import (
    facts,
    plan_rows,
    setting_groups,
    stage_rows,
    stage_summary,
    usual_settings,
)
from extrags.report.space import occupancy_slices, scene_views, trajectory_colors
from extrags.report.viewer.content import viewer_section
from extrags.report.views import depth_rows, held_out_rows, virtual_rows
from extrags.report.wording import count, number, restorer_words

__all__ = ["build_pages", "build_report"]

IMAGE_BYTES = 4_200_000
"""For all images of views together; charts and figures of the scene need about one million more."""


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
        files=file_name(inputs.name),
        profile=inputs.profile,
        summary=summary(inputs),
        warnings=_warnings(inputs),
        tiles=tiles(inputs),
        regions=regions(inputs),
        surface=surface_rows(inputs),
        missing_reasons=missing_reasons(inputs),
        numbers_csv=numbers_csv(inputs),
        per_view_csv=per_view_csv(inputs),
        **_views(inputs, config),
        **viewer_section(inputs, config),
        curves=history_chart(inputs.history) if any(inputs.history.values()) else None,
        curves_absent=inputs.why_absent("history", "coarse"),
        **_space(inputs),
        plan=plan_rows(inputs),
        plan_absent=inputs.why_absent("plan", "assess"),
        without_pose=inputs.without_pose[1],
        stages_absent="No stage times were handed to this report.",
        protocol=protocol(inputs),
        settings=setting_groups(inputs.config, inputs.profile),
        usual=usual_settings(inputs.profile)[0],
    )
    pages = [
        rendered_page(
            "sequence.html.j2",
            **shared,
            made=shown.made,
            facts=facts(shown),
            stages=stage_rows(shown),
            stage_summary=stage_summary(shown),
            environment=dict(shown.environment),
        )
        for shown in (inputs, replace(inputs, made="", stages=[], environment={}))
    ]
    return pages[0], pages[1]


def _warnings(inputs: ReportInputs) -> list[str]:
    """What makes all figures doubtful: poses that frames contradict grossly, as the log says it."""
    report = {} if inputs.depth is None else inputs.depth.report
    found = [str(report["contradiction"])] if report.get("contradiction") else []
    error = report.get("median_measured_error", 0.0)
    # An error that was given is not what frames tell.
    told_by_frames = inputs.config is None or inputs.config.ingest.depth_error == "auto"
    if error >= GROSS_ERROR and told_by_frames:
        found.append(f"training frames disagree about their depth, {doubts_in_words(error)}")
    return [f"{words[:1].upper()}{words[1:]}." for words in found]


def _views(inputs: ReportInputs, config: ReportConfig) -> dict[str, Any]:
    held_out = min(config.held_out_views, len(inputs.frames)) if inputs.coarse or inputs.final else 0
    virtual = 0 if inputs.pseudo is None else min(config.virtual_views, len(inputs.pseudo.rendered))
    has_depth = held_out > 0 and inputs.sequence.true_depth_mm is not None
    estimated = 0 if inputs.depth is None else min(config.held_out_views, len(inputs.sequence.train))
    images = 5 * (held_out + virtual + (held_out if has_depth else 0) + estimated)
    largest = IMAGE_BYTES // max(1, images)
    coarse, final = per_view_psnr(inputs.coarse_metrics), per_view_psnr(inputs.final_metrics)
    names = [inputs.sequence.frame_name(int(frame)) for frame in inputs.frames]
    unseen = unobserved_shares(inputs)
    chart = None if coarse is None else views_chart(coarse, final, unseen, names)
    return {
        "held_out": held_out_rows(inputs, held_out, largest) if held_out else None,
        "held_out_absent": inputs.why_absent("coarse", "evaluate"),
        "final_absent": None if inputs.final is not None else inputs.why_absent("final", "finetune"),
        "views_chart": chart,
        "views_chart_words": _views_chart_words(
            final=final is not None, scatter=final is not None and unseen is not None
        ),
        "depth": depth_rows(inputs, held_out, largest) if has_depth else None,
        "estimated": None
        if inputs.depth is None
        else estimated_depth(inputs.sequence, inputs.depth, estimated, largest),
        "depth_absent": inputs.absent.get("depth", "there is no true depth to compare with"),
        "virtual": virtual_rows(inputs.pseudo, inputs.sequence, virtual, largest)
        if inputs.pseudo is not None and virtual
        else None,
        "virtual_absent": inputs.why_absent("pseudo", "enhance"),
        "restorer": None if inputs.pseudo is None else restorer_words(inputs.pseudo.provenance),
        "not_restored": _not_restored(inputs),
    }


def _not_restored(inputs: ReportInputs) -> str:
    """How many virtual views of the exploration were not restored; empty where all were, or nobody knows."""
    found = (inputs.exploration or {}).get("virtual_views")
    if inputs.pseudo is None or found is None or found <= len(inputs.pseudo.rendered):
        return ""
    return (
        f"The exploration found {count(found)} views; {count(len(inputs.pseudo.rendered))} of them were "
        "restored, as many as enhance.max_views allows."
    )


def _views_chart_words(*, final: bool, scatter: bool) -> str:
    """What the chart of the held-out views shows."""
    scenes = "the coarse and the final scene" if final else "the coarse scene"
    said = f"PSNR of every held-out view in {scenes}"
    return f"{said}, and the gain against the share of pixels that training never saw" if scatter else said


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
    cameras = sequence.cameras.as_pinholes()
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
                # The first one is the real view it starts from.
                "views": len(poses) - 1,
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
