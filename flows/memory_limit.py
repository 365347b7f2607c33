"""The peak memory of a sequence's run: stated, and held against a limit, before it is reconstructed."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Mapping
from typing import Any

from extrags.config import PipelineConfig
from extrags.errors import ConfigError
from extrags.memory_estimate import FrameSize, MemoryEstimate, estimate_memory, fitting_settings
from extrags.pipeline import StageName

__all__ = ["check_memory"]

log = logging.getLogger(__name__)


def check_memory(
    name: str,
    config: PipelineConfig,
    counts: Mapping[str, Any],
    limit_gb: float | None,
    until: StageName,
    leave_out: Collection[str],
) -> MemoryEstimate:
    """State what a run will need, and refuse one that needs more than it may.

    Args:
        name: of the sequence.
        config: settings of all stages.
        counts: of the artefact of `ingest`: frames, train, width, height.
        limit_gb: in GB (1e9 bytes); None for no limit.
        until: last stage.
        leave_out: stages that the method leaves out.

    Raises:
        ConfigError: when the estimate exceeds the limit; names settings that fit.
    """
    size = FrameSize(int(counts["frames"]), int(counts["train"]), int(counts["width"]), int(counts["height"]))
    threads = len(os.sched_getaffinity(0))
    found = estimate_memory(config, size, threads=threads, until=until, leave_out=leave_out)
    what = f"{name}: {size.frames} frames of {size.width} x {size.height} px take {found}"
    log.info("%s", what)
    if limit_gb is None or found.peak_gb <= limit_gb:
        return found
    settings = fitting_settings(config, size, limit_gb, threads=threads, until=until, leave_out=leave_out)
    if settings is None:
        advice = "no smaller frames or fewer virtual views were found that fit"
    else:
        advice = "it fits with " + " ".join(f"--{key} {value}" for key, value in settings.items())
    raise ConfigError(f"{what}, more than the limit of {limit_gb:g} GB; {advice}")
