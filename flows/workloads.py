"""Size of the work that a sequence is: of the catalogue before it is read, or as it was read."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from data_catalog import Descriptor, Glance, describe, glance
from data_catalog.catalog import drawn_formats
from extrags.config import PipelineConfig
from extrags.errors import ExtragsError
from extrags.pipeline import stages_that_can_run
from extrags.run_costs import FOOTAGE_NUMBERS, Workload
from extrags.stages import Repeats, StageName, modelled_tasks

__all__ = [
    "at_detail_size",
    "detail_flags",
    "expected_work",
    "footage_numbers",
    "frames_stages",
    "frames_work",
    "known_work",
    "knows_depth",
    "read_size",
    "task_repeats",
    "usual_work",
    "work_before_reading",
]

THUMBNAIL_DIVISORS = {"simcol3d": 2, "sinus": 4}
"""Of formats whose thumbnails are divided alike; others but C3VD are read as they are."""
SINUS_BOX = (1048, 972)
"""Width and height in pixels of what the sinus frames show: their black border is cut off."""


def known_work(name: str, config: PipelineConfig) -> Workload | None:
    """That of a sequence as far as the catalogue tells; None for a path."""
    try:
        return _catalogue_work(describe(name), config)
    except (ExtragsError, OSError):
        return None


def expected_work(name: str, config: PipelineConfig) -> Workload | None:
    """That of a sequence as far as can be told before it is read; None where it cannot be."""
    try:
        return work_before_reading(name, config, ())[0]
    except (ExtragsError, OSError):
        # What is wrong with a source, or with the disk it is on, is said by its own run.
        return None


def usual_work(config: PipelineConfig) -> Workload:
    """That of a phantom's recording, for sequences of which nothing is known."""
    return Workload(160 * 128, 48, 24, 24, config, width=160)


def frames_work(
    counts: Mapping[str, Any],
    config: PipelineConfig,
    coarse: Mapping[str, Any] | None = None,
    *,
    drawn: bool = False,
) -> Workload:
    """That of a sequence that has been read.

    Args:
        counts: of the artefact of its `ingest`.
        config: settings of all stages.
        coarse: counts of that of its coarse scene, where there is one.
        drawn: whether its frames were drawn by a procedural scene.
    """
    gaussians = None if coarse is None else coarse.get("n_gaussians")
    width, height, frames, train, test = (
        float(counts[name] or 0) for name in ("width", "height", "frames", "train", "test")
    )
    size = width * height, frames, train, test
    return Workload(
        *size,
        config,
        width=width,
        coarse_gaussians=gaussians,
        drawn=drawn,
        has_depth=knows_depth(counts, config),
        **footage_numbers(counts),
    )


def footage_numbers(counts: Mapping[str, Any]) -> dict[str, Any]:
    """Of `Workload`: how much of a video or DICOM file was looked at; zeros for other sources.

    Args:
        counts: of the artefact of `ingest`.
    """
    return {name: float(counts.get(name) or 0) for name in FOOTAGE_NUMBERS}


def knows_depth(counts: Mapping[str, Any], config: PipelineConfig) -> bool:
    """Whether depth was read with the frames, given to training or withheld.

    Args:
        counts: of the artefact of `ingest`.
        config: settings of all stages.
    """
    return bool(counts.get("has_depth", True)) or config.ingest.withhold_depth


def frames_stages(
    counts: Mapping[str, Any], config: PipelineConfig, leave_out: Collection[str] = ()
) -> set[StageName]:
    """The stages that can run of a sequence that has been read (`extrags.pipeline.stages_that_can_run`).

    Args:
        counts: of the artefact of its `ingest`.
        config: settings of all stages.
        leave_out: stages that the method leaves out.
    """
    has_poses = bool(counts.get("has_poses"))
    has_depth = bool(counts.get("has_depth")) and not counts.get("depth_error")
    train, test = (float(counts[name] or 0) for name in ("train", "test"))
    return stages_that_can_run(
        config, leave_out, has_poses=has_poses, has_depth=has_depth, train=train, test=test
    )


def at_detail_size(work: Workload, counts: Mapping[str, Any]) -> Workload | None:
    """The same run with frames of the size that keeps their detail; None where that is the size they have.

    Args:
        work: of a sequence that has been read.
        counts: of the artefact of its `ingest`.
    """
    width, height = float(counts["detail_width"]), float(counts["detail_height"])
    if work.width is None or width >= work.width:
        return None
    return replace(work, pixels=width * height, width=width, coarse_gaussians=None)


def detail_flags(config: PipelineConfig, counts: Mapping[str, Any]) -> str:
    """What asks for frames of that size, on the command line.

    Frames that are at least of the source's size can be measured again, whatever they are; smaller ones were
    measured as they are, and the size is named, in place of a divisor.

    Args:
        config: settings that they were read with.
        counts: of the artefact of `ingest`.
    """
    given = config.ingest
    if given.width is None and not counts["has_poses"]:
        # Such frames may have been cut to the picture, where a width is that of whole frames. None of these
        # sources has thumbnails.
        return "--ingest.size detail" + (" --ingest.downscale none" if given.downscale is not None else "")
    if given.size != "thumbnail" and given.width is None and given.downscale is None:
        return "--ingest.size detail"
    height = "" if given.height is None else f" --ingest.height {counts['detail_height']}"
    divisor = "" if given.downscale is None else " --ingest.downscale none"
    return f"--ingest.width {counts['detail_width']}{height}{divisor}"


def work_before_reading(
    name: str, config: PipelineConfig, leave_out: Collection[str]
) -> tuple[Workload, set[StageName]]:
    """Size and settings of a sequence that has not been read, and the stages that may run.

    How many frames are held out is not in the catalogue: half of them are taken to be. Of folders and footage
    names and headers tell; of footage, how many frames there will be at most. The plan is taken to skip none.

    Raises:
        UnknownSequenceError: neither a known name nor an existing path.
        SourceError: a source that cannot be read.
        ConfigError: a size that it cannot give.
    """
    if config.imported.scene is not None and config.imported.keep:
        # As `of_imported_scene` does, which knows more once the scene is read.
        config = config.with_overrides({"finetune.keep_scene": True})
    seen = glance(name, config.ingest)
    about: Glance | Descriptor = describe(name) if seen is None else seen
    if isinstance(about, Descriptor):
        work = _catalogue_work(about, config)
    else:
        told = ("width", "height", "train", "test", "has_depth", *FOOTAGE_NUMBERS)
        counts = {name: getattr(about, name) for name in told}
        work = frames_work({**counts, "frames": about.train + about.test}, config)
    return work, stages_that_can_run(
        config,
        leave_out,
        has_poses=about.has_poses,
        has_depth=about.has_depth and not config.ingest.withhold_depth,
        train=work.train,
        test=work.test,
    )


def _catalogue_work(about: Descriptor, config: PipelineConfig) -> Workload:
    width, height = read_size(about, config)
    frames = float(min(about.frames, config.ingest.max_frames or about.frames))
    held_out = frames / 2
    drawn = about.format in drawn_formats()
    size = width * height, frames, held_out, held_out
    return Workload(*size, config, width=width, drawn=drawn, has_depth=about.has_depth)


def read_size(about: Descriptor, config: PipelineConfig) -> tuple[float, float]:
    """About the width and height that a sequence of the catalogue is read at, in pixels.

    Raises:
        ConfigError: for a size that cannot be rendered.
    """
    from data_catalog.c3vd.pinhole import USUAL_WIDTH
    from data_catalog.rendered_size import rendered_size

    ingest = config.ingest
    if about.format in drawn_formats():
        return rendered_size(ingest, about.width, about.height)
    width, height = SINUS_BOX if about.format == "sinus" else (about.width, about.height)
    if ingest.width is not None:
        return ingest.width, ingest.height or ingest.width * height / width
    usual = max(1, round(width / USUAL_WIDTH)) if about.format == "c3vd" else 1
    usual = THUMBNAIL_DIVISORS.get(about.format, usual)
    divisor = ingest.downscale or (usual if ingest.size == "thumbnail" else 1)
    return width / divisor, height / divisor


def task_repeats(stage: str, measured_scenes: int, restored: int) -> dict[str, int]:
    """How often each task of a stage runs; those that do not run are left out.

    Args:
        stage: name.
        measured_scenes: scenes that are evaluated.
        restored: sets of restored views that are evaluated beside them, 0 or 1.
    """
    times: dict[Repeats, int] = {
        "once": 1,
        "scenes": measured_scenes,
        "restored": restored,
        "measured": measured_scenes + restored,
    }
    return {task: times[cost.repeats] for task, cost in modelled_tasks(stage).items() if times[cost.repeats]}
