"""What a run will need, stated before a sequence is reconstructed; its memory is held against a limit."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from typing import Any

from extrags.config import PipelineConfig
from extrags.cores import usable_cores
from extrags.errors import ConfigError, DamagedArtefactError
from extrags.memory_estimate import FrameSize, MemoryEstimate, estimate_memory, fitting_settings
from extrags.stages import STAGES, StageName, stages_until
from flows.cached_stages import CachedStages
from flows.estimate import expected_seconds, without_kernels_in_words
from flows.runners import NotInStoreError
from flows.workloads import frames_stages, frames_work
from tasks.progress import duration_text, observed

__all__ = ["check_memory", "made_stages"]

log = logging.getLogger(__name__)


def check_memory(
    name: str,
    config: PipelineConfig,
    counts: Mapping[str, Any],
    limit_gb: float | None,
    until: StageName,
    leave_out: Collection[str],
    made: Collection[str] = (),
    pinned: Collection[str] = (),
) -> MemoryEstimate:
    """State what memory and time a run will need, and refuse one that needs more memory than it may.

    The time is that of all stages that can run, on the machine that `extrags.run_costs` rests on: the plan,
    which may skip some, is not made yet.

    Args:
        name: of the sequence.
        config: settings of all stages.
        counts: of the artefact of `ingest`: frames, train, test, width, height, has_poses, has_depth.
        limit_gb: in GB (1e9 bytes); None for no limit.
        until: last stage.
        leave_out: stages that the method leaves out.
        made: stages that are in the store: they need neither memory nor time.
        pinned: settings that the method sets itself, which nobody is advised to set.

    Raises:
        ConfigError: when the estimate exceeds the limit; names settings that fit.
    """
    frames, train, test, width, height = (
        int(counts[name] or 0) for name in ("frames", "train", "test", "width", "height")
    )
    size = FrameSize(frames, train, width, height, held_out_frames=test)
    threads = usable_cores()
    leave_out = set(STAGES).difference(frames_stages(counts, config, leave_out))
    found = estimate_memory(config, size, threads=threads, until=until, leave_out=leave_out)
    to_make: dict[StageName, int] = {
        stage: needed for stage, needed in found.by_stage.items() if stage not in made
    }
    if not to_make:
        return found
    found = MemoryEstimate(to_make)
    what = f"{name}: {size.frames} frames of {size.width} x {size.height} px take {found}"
    expected = expected_seconds(config, frames_work(counts, config))
    ahead = set(stages_until(until)[1:]).difference(leave_out, made)
    seconds = sum(sum(expected[stage].values()) for stage in ahead)
    # What comes after the last stage, as of a plan, is not in it.
    end = "" if until == STAGES[-1] else f" until {until}"
    time, slow = duration_text(seconds), without_kernels_in_words()
    log.info("%s, and about %s of processor time%s%s", what, time, end, slow)
    if limit_gb is None or found.peak_gb <= limit_gb:
        return found
    settings = fitting_settings(
        config, size, limit_gb, threads=threads, until=until, leave_out=leave_out, fixed=pinned
    )
    if settings is None:
        advice = "no smaller frames or fewer virtual views were found that fit"
    else:
        advice = "it fits with " + " ".join(f"--{key} {value}" for key, value in settings.items())
        if "ingest.width" in settings and config.ingest.downscale is not None:
            # The width takes the place of the divisor.
            advice += " --ingest.downscale none"
    raise ConfigError(f"{what}, more than the limit of {limit_gb:g} GB; {advice}")


def made_stages(run: CachedStages, until: StageName) -> set[str]:
    """The stages before the first one of which something would have to be made.

    Args:
        run: with a runner that only looks (`flows.runners.StoreRunner`); it has looked then.
        until: last stage.
    """

    def ignore(_: object) -> None:
        """Looking is no progress."""

    try:
        with observed(ignore):
            run.run(until)
    except (NotInStoreError, DamagedArtefactError):
        # The last row is that of the stage in which something was missing.
        return {row.stage for row in run.outcome.stages[:-1]}
    return {row.stage for row in run.outcome.stages if row.state == "cached"}
