"""report: one self-contained HTML page from the artefacts of a run."""

from __future__ import annotations

import platform
from dataclasses import replace
from typing import Any, TypeVar

from extrags.config import PipelineConfig
from extrags.redaction import without_credentials
from extrags.stages import REGISTRY, Part, StageName
from extrags.store import Ref, Slot, Storable, digest_of
from extrags.store.slot import Artefacts
from tasks.coarse import HISTORY
from tasks.evaluate import METRICS_FILE
from tasks.stage import stage

__all__ = ["PAGE", "REPORT_PARTS", "ROWS", "dataset_report", "report"]

PAGE = "report.html"
CONTENT = "content.json"
"""Beside a page: the digest of what it shows, apart from times and machine of the run."""
ROWS = "stages.json"
"""Beside a page: the times of the stages that it tells of."""

S = TypeVar("S", bound=Storable)


REPORT_PARTS: tuple[Part, ...] = tuple(part for stage in REGISTRY for part in stage.page_parts)
"""What a page shows of a run, in the order of the stages; all but `sequence` may be missing."""


# `rows` holds the times of the stages in this run. The page shows them, but they are not part of its cache
# key.
@stage("report", version=25, ignore=("rows",))
def report(
    slot: Slot,
    name: str,
    parts: dict[str, Ref],
    skipped: dict[str, str],
    config: PipelineConfig,
    profile: str,
    without_pose: tuple[int, int],
    rows: list[dict[str, Any]],
) -> None:
    """Build the page; writes `report.html`, `content.json` and `stages.json`.

    Args:
        slot: the artefact to write.
        name: of the sequence. Its frames know one as well, but frames of equal content are one artefact,
            which has the name of the source that was read first.
        parts: the artefacts to show, of `REPORT_PARTS`.
        skipped: why stages were skipped, by name.
        config: settings of the run, the plan's budgets included.
        profile: name of the profile they started from.
        without_pose: numbers of training and of held-out frames that left the sequence for want of a pose.
        rows: `{stage, state, seconds, reason, made_seconds}` of each stage.
    """
    from extrags.depth.estimate import DepthEstimate
    from extrags.exploration import Exploration
    from extrags.freespace import FreeSpace
    from extrags.metrics.protocol import RenderedViews
    from extrags.pseudo_views import PseudoViews
    from extrags.report.build import build_pages
    from extrags.report.inputs import ReportInputs
    from extrags.scene import Scene
    from extrags.scene_plan import ScenePlan
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import Mesh

    def part(kind: type[S], name: str) -> S | None:
        return slot.load(kind, parts[name]) if name in parts else None

    def figures(name: str, file: str) -> Any:
        return slot.load_json(file, parts[name]) if name in parts else None

    sequence = slot.load(EndoscopicSequence, parts["sequence"])
    exploration, plan = part(Exploration, "explore"), part(ScenePlan, "plan")
    trajectories = [] if exploration is None else exploration.trajectories
    curves = {stage: figures(stage, HISTORY) for stage in ("coarse", "finetune")}
    pseudo = part(PseudoViews, "enhance")
    inputs = ReportInputs(
        name=name,
        sequence=sequence,
        coarse=part(RenderedViews, "renders_coarse"),
        final=part(RenderedViews, "renders_final"),
        restored=part(RenderedViews, "renders_restored"),
        coarse_metrics=figures("metrics_coarse", METRICS_FILE),
        final_metrics=figures("metrics_final", METRICS_FILE),
        restored_metrics=figures("metrics_restored", METRICS_FILE),
        depth=part(DepthEstimate, "depth"),
        pseudo=pseudo,
        virtual_cameras=None if pseudo is None else pseudo.cameras,
        # UC-NeRF keeps a field there, not Gaussians.
        coarse_scene=None if config.uc_nerf.enabled else part(Scene, "coarse"),
        final_scene=part(Scene, "finetune"),
        trajectories=[cameras.world_from_camera for cameras in trajectories],
        exploration=None if exploration is None else exploration.summary(),
        grid=part(FreeSpace, "freespace"),
        mesh=part(Mesh, "surface"),
        plan=None if plan is None else plan.model_dump(mode="json"),
        stages=rows,
        history={stage: curve for stage, curve in curves.items() if curve is not None},
        environment=_environment(slot.store, parts),
        config=config,
        profile=profile,
        without_pose=without_pose,
        absent=_absent(skipped),
    )
    page, content = build_pages(inputs, config.report)
    _save_page(slot, page, content)
    # A page that is built again tells of the same run.
    slot.save_json(ROWS, rows)
    slot.run_files.add(ROWS)
    slot.counts["kib"] = round(len(page.encode()) / 1024)


def _save_page(slot: Slot, page: str, content: str) -> None:
    """Write a page, and the digest of what does not depend on the run it shows.

    The artefact's digest covers the latter alone: equal inputs give equal digests.
    """
    (slot.path / PAGE).write_text(without_credentials(page), encoding="utf-8")
    slot.run_files.add(PAGE)
    slot.save_json(CONTENT, {"digest": digest_of(without_credentials(content))})


def _environment(store: Artefacts, parts: dict[str, Ref]) -> dict[str, str]:
    """Software the scene was made with, and the machine this page is made on."""
    made_with = store.manifest(parts["coarse" if "coarse" in parts else "sequence"]).software
    return {**made_with, "machine": platform.machine(), "system": platform.system()}


def _absent(skipped: dict[str, str]) -> dict[str, str]:
    """Parts of the page that a skipped stage would have made."""
    made_by: dict[str, StageName] = {
        "mesh": "surface",
        "grid": "freespace",
        "trajectories": "explore",
        "pseudo": "enhance",
        "final": "finetune",
    }
    return {
        part: f"{stage} was skipped: {skipped[stage]}" for part, stage in made_by.items() if stage in skipped
    }


@stage("dataset-report", version=8, ignore=("rows",))
def dataset_report(
    slot: Slot,
    name: str,
    profile: str,
    sequences: list[str],
    metrics: dict[str, Ref],
    reports: dict[str, Ref],
    failures: dict[str, str],
    settings: list[dict[str, Any]],
    sizes: list[tuple[int, int] | None],
    rows: list[dict[str, Any]],
) -> None:
    """Build the page that compares sequences; writes `report.html` and `content.json`.

    Args:
        slot: the artefact to write.
        name: title of the page.
        profile: name of the profile of the settings.
        sequences: their names, with the variant where there is one, in the order they are shown.
        metrics: artefacts with the metrics of each sequence, by `NAME coarse` and `NAME final`.
        reports: artefacts with the pages that are linked, by sequence; they stay as long as this page does.
        failures: error messages by sequence.
        settings: that were given for each sequence beside the profile, by dotted name.
        sizes: width and height of its images in px; None where nothing was read.
        rows: `SequenceOutcome.to_json()` of each: times and states, not part of the cache key.
    """
    from extrags.report.dataset import DatasetRow, build_dataset_report

    def figures(sequence: str, which: str) -> Any:
        ref = metrics.get(f"{sequence} {which}")
        return None if ref is None else slot.load_json(METRICS_FILE, ref)["metrics"]

    shown = [
        DatasetRow(
            name=row["name"],
            variant=_without_seed(row["variant"], row["seed"]),
            seed=row["seed"],
            status="failed" if sequence in failures else "completed",
            seconds=sum(stage["made_seconds"] for stage in row["stages"]),
            coarse=figures(sequence, "coarse"),
            final=figures(sequence, "final"),
            stages=row["stages"],
            error=failures.get(sequence, ""),
            link=_neighbour(reports.get(sequence)),
            settings=given,
            image_size=size,
        )
        for sequence, given, size, row in zip(sequences, settings, sizes, rows, strict=True)
    ]
    page, content = (
        build_dataset_report(every, name=name, profile=profile)
        for every in (shown, [replace(row, seconds=0.0, stages=()) for row in shown])
    )
    _save_page(slot, page, content)


def _without_seed(variant: str, seed: int | None) -> str:
    """What else sets a run apart: its seed stands in a column of its own."""
    return ", ".join(word for word in variant.split(", ") if word != f"seed {seed}")


def _neighbour(report: Ref | None) -> str:
    """Relative URL of another artefact's page: artefacts are sibling directories."""
    return "" if report is None else f"../{report.uri.rsplit('/', 1)[-1]}/{PAGE}"
