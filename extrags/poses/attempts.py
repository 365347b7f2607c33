"""COLMAP's attempts at a sequence: the exact one, and a lenient one where part of it gets no pose."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from extrags.config import PosesConfig
from extrags.errors import CaptureError
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.poses.registration_report import MIN_TRAINING_FRAMES, colmap_report
from extrags.sequence import EndoscopicSequence

__all__ = ["Attempt", "attempted", "enough_registered"]

CLEAR_SHARE = 0.1
"""Of the training frames. Where more than this is missing, COLMAP tries again, and where the second attempt
registers more than this in addition, it counts. Single frames that are blurred or covered fail in any
attempt, and are no reason to give up the more exact poses of the first; a stretch of the recording is."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Attempt:
    """What COLMAP found.

    Args:
        result: of its process.
        registered: true for frames with a pose, [F].
        report: counts, from `colmap_report`; of the second attempt with `lenient` and, under
            `first_attempt`, what the first one registered.
    """

    result: PoseJobResult
    registered: Bool[np.ndarray, "f"]
    report: dict[str, Any]

    @property
    def lens_determined(self) -> bool:
        """Whether a lens was estimated; false also where none was sought."""
        return bool(self.report.get("calibration", {}).get("determined", False))


def enough_registered(report: dict[str, Any], config: PosesConfig) -> bool:
    """Whether training frames with poses make a map, and as many of them as the settings expect."""
    share = report["registered_train"] / report["n_train"]
    return bool(report["registered_train"] >= MIN_TRAINING_FRAMES and share >= config.min_registered_share)


def attempted(
    sequence: EndoscopicSequence,
    job: PoseJob,
    config: PosesConfig,
    run: Callable[[PoseJob, str], PoseJobResult],
    *,
    retry_too_few: bool,
) -> Attempt:
    """COLMAP's first attempt, or its second where that registers clearly more training frames.

    Args:
        sequence: whose frames they are.
        job: the first attempt.
        config: settings; `lenient_retry` allows the second.
        run: the job of a sequence of a name.
        retry_too_few: whether COLMAP tries again where too few frames registered to go on: false where
            frames can be aligned by depth instead.

    Raises:
        CaptureError: from `run`; from that of the second attempt only where the first was not enough.
    """
    first = _attempt(sequence, job, run)
    found, total = first.report["registered_train"], first.report["n_train"]
    enough = enough_registered(first.report, config)
    wanted = total - found > CLEAR_SHARE * total if enough else retry_too_few
    if not (config.lenient_retry and wanted):
        return first
    _LOG.warning(
        "%s: COLMAP registered %d of %d training frames; trying again with guided matching and lower "
        "thresholds, which makes less exact poses and takes about as long once more",
        sequence.name,
        found,
        total,
    )
    try:
        second = _attempt(sequence, replace(job, lenient=True), run)
    except CaptureError as error:
        if not enough:
            raise
        _LOG.warning("%s: the second attempt failed; the first one counts (%s)", sequence.name, error)
        return first
    gained = second.report["registered_train"] - found
    # A part of the recording with the right lens is worth more than all of it with a guess.
    loses_lens = enough and first.lens_determined and not second.lens_determined
    if loses_lens or gained <= (CLEAR_SHARE * total if enough else 0):
        _LOG.warning(
            "%s: the second attempt registered %d of %d training frames%s; the first one counts",
            sequence.name,
            second.report["registered_train"],
            total,
            " and did not determine the lens" if loses_lens else "",
        )
        return first
    told = {key: first.report[key] for key in ("registered_train", "registered_test", "model_sizes")}
    return replace(second, report=second.report | {"lenient": True, "first_attempt": told})


def _attempt(
    sequence: EndoscopicSequence, job: PoseJob, run: Callable[[PoseJob, str], PoseJobResult]
) -> Attempt:
    result = run(job, sequence.name)
    registered = np.isfinite(result.world_from_camera).all((1, 2))
    return Attempt(result, registered, colmap_report(sequence, result, registered))
