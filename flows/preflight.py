"""Checks before a run, of problems that would otherwise only be found after the reconstruction."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.config import PipelineConfig
from extrags.errors import ExtragsError, WeightsError
from extrags.metrics.registry import added_metrics
from extrags.stages import stages_until
from extrags.store import digest_of
from extrags.user_paths import expanded

if TYPE_CHECKING:
    from flows.cases import SequenceCase

__all__ = ["preflight", "preflight_cases"]

log = logging.getLogger(__name__)


def preflight(config: PipelineConfig, until: str, leave_out: Collection[str] = ()) -> None:
    """Check that the models, weights and packages that the settings need are available.

    LPIPS may be absent. Where `EXTRAGS_LPIPS_WEIGHTS` names a place that is not there, a warning says so: its
    columns would stay empty at the end of a run, or be those that a run with weights has left in the store.

    Args:
        config: settings of all stages.
        until: last stage to run.
        leave_out: stages that are left out whatever the plan says.

    Raises:
        WeightsError: when weights are not there, or damaged; says how to get them.
        MissingDependencyError: when a package is not there; says how to install it.
        SourceNotFoundError: when there is no such file as `imported.scene`.
        SourceError: when it is of a format that is not read.
        ConfigError: when settings do not fit each other, the model or the machine, EXTRAGS_ISA names an
            instruction set that is not usable here, or a metric that a program registered does not work.
        ExtragsError: when the code a checkpoint needs does not start.
    """
    # Only where it is set: asking the kernels loads torch, which looking up a deployment must not.
    if os.environ.get("EXTRAGS_ISA"):
        from extrags.raster import native_isa

        native_isa()
    config = config.with_run_device()
    wanted = stages_until(until)
    if "coarse" in wanted:
        from extrags.placement import check_device

        check_device(config)
    if "evaluate" in wanted and "evaluate" not in leave_out and added_metrics():
        # Here, because it loads torch, which looking up a deployment must not.
        from extrags.metrics.photometric import try_added_metrics
        from extrags.placement import run_device

        try_added_metrics(run_device(config))
    if "depth" in wanted and config.depth.enabled and "depth" not in leave_out:
        from extrags.devices import chosen_device
        from tasks.weights import depth_completion_digest, depth_monocular_digest

        chosen_device(config.depth.device, "depth.device")
        depth_completion_digest(config.depth)
        depth_monocular_digest(config.depth.monocular)
    if config.imported.scene is not None:
        from tasks.imported import scene_digest

        config.check_imported()
        scene_digest(config.imported)
        # Here, because it loads torch, which looking up a deployment must not.
        from extrags.splat_files.reading import splat_format

        splat_format(expanded(config.imported.scene))
    if "enhance" not in wanted:
        return
    # Here, because they load torch, which looking up a deployment must not.
    from extrags.metrics.lpips_weights import WEIGHTS_VARIABLE, check_weights
    from tasks.weights import lpips_weights

    named = os.environ.get(WEIGHTS_VARIABLE)
    found = lpips_weights(config.evaluate)
    for weights in found:
        if weights.paths:
            check_weights(tuple(map(Path, weights.paths)), weights.net)
        elif named and not expanded(named).is_file():
            _say_once(f"{weights.reason}; figures of LPIPS with {weights.net} stay empty")
    first, *_ = found
    if "enhance" not in leave_out:
        if config.enhance.pixel_confidence == "raw" and first.digest is None:
            raise WeightsError(f"enhance.pixel_confidence=raw is LPIPS itself: {first.reason}")
        from extrags.restoration import check_restorer

        check_restorer(config.enhance)


def preflight_cases(cases: Sequence[SequenceCase], until: str) -> None:
    """Check what the runs of a dataset need, before the first of them.

    What is missing for some alone, whose settings a manifest gives, is said by their own runs: these stop no
    other.

    Args:
        cases: all runs.
        until: last stage to run.

    Raises:
        ExtragsError: as `preflight`, where a method has no case that could run; of the first.
    """
    from flows.methods import METHODS

    for method in dict.fromkeys(case.method for case in cases):
        unlike = {
            digest_of([dict(case.settings), dict(case.changed)]): case
            for case in reversed(cases)
            if case.method == method
        }
        refused: list[ExtragsError] = []
        for case in reversed(unlike.values()):
            try:
                preflight(case.config(), until, METHODS[method].leave_out)
                break
            except ExtragsError as error:
                refused.append(error)
        else:
            raise refused[0]


@cache
def _say_once(sentence: str) -> None:
    """A command looks before its first sequence, and each sequence again."""
    log.warning("%s", sentence)
