"""How far training frames disagree about their measured depth, and what is made of it.

Measured depth is taken as it is: Gaussians start on all of it, and the loss draws them to it. Depth maps that
are off by some percent, each in its own way, as those of a stereo matcher or a monocular network are, start a
shell round the surface instead. Frames tell: depth that poses carry from one frame to another meets what is
measured there, or it does not. Poses that are off cause differences too, but such as a rigid motion between
the two cameras takes away. What is left beyond that is the depth's own.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from extrags.carried_depth import MEDIAN, CarriedDepth, evenly, relative_error
from extrags.frame_stacks import stacked
from extrags.sequence import EndoscopicSequence

__all__ = [
    "GROSS_ERROR",
    "MeasuredDepthError",
    "as_given",
    "doubts_in_words",
    "measured_depth_error",
    "with_depth_error",
]

_log = logging.getLogger(__name__)

LEAST_ERROR = 0.0075
"""Of depth, beyond any motion of the frames, from which on it is not taken as it is. Exact depth has at most
0.0003, in steps of eight bits 0.005, with poses that are off by 3 % of the depth and 1.5 degrees 0.001, with
a focal length that is off by 5 % 0.002; smooth errors of 2 % 0.0085 to 0.009 (docs/experiments/depth.md)."""

EXACT = 0.003
"""Error of depth that is not looked into any further."""

GROSS_ERROR = 0.1
"""From which on poses that are grossly wrong are as likely: the motion that fits a pair of frames best takes
as large a share of smooth errors of depth as of theirs."""

FITTED_PAIRS = 40
"""Pairs at most whose motion is fitted."""


@dataclass(frozen=True)
class MeasuredDepthError:
    """What frames tell of each other's measured depth.

    Args:
        error: relative error of depth that would explain the differences; a median over all pairs.
        beyond_motion: the same after the best rigid motion of each pair is taken out.
        of_frame: relative error of each training frame, [N]; `error` for frames that were not compared.
        pairs: how many pairs of frames met enough of each other's surface.
    """

    error: float
    beyond_motion: float
    of_frame: Float[np.ndarray, "n"]
    pairs: int


def measured_depth_error(carried: CarriedDepth) -> MeasuredDepthError:
    """How far training frames disagree about their depth.

    Args:
        carried: depth of a sequence's training frames.
    """
    ratios = [carried.ratio(pair) for pair in carried.pairs]
    error = beyond = relative_error(ratios)
    if error > EXACT:
        some = evenly(len(carried.pairs), FITTED_PAIRS).tolist()
        beyond = relative_error([carried.beyond_motion(carried.pairs[k]) for k in some])
    of_frame = np.full(len(carried.cameras), error)
    compared = zip(carried.pairs, ratios, strict=True)
    of_pairs: dict[int, list[Float[np.ndarray, "_"]]] = {}
    for pair, ratio in compared:
        for position in (pair.first, pair.second):
            of_pairs.setdefault(position, []).append(ratio)
    for position, own in of_pairs.items():
        # The difference has the error of the other frame in it, which is taken to be as large as most are.
        square = 2 * relative_error(own) ** 2 - error**2
        of_frame[position] = np.sqrt(max(square, (error / 2) ** 2))
    return MeasuredDepthError(error, beyond, of_frame, len(carried.pairs))


def with_depth_error(
    sequence: EndoscopicSequence, carried: CarriedDepth | None, error: float | Literal["auto"] = "auto"
) -> EndoscopicSequence:
    """The sequence, its measured depth with the error that frames find in it.

    Where they agree, and where depth is estimated or unknown, the sequence is returned as it is. Else depth
    has an expected error (`EndoscopicSequence.depth_error`) from here on, so that the depth stage looks for a
    better one (`extrags.depth.combination`), and what was measured stays beside it for the evaluation. A
    warning tells of it.

    Args:
        sequence: in the unit of its poses.
        carried: its depth; None where frames tell nothing of each other's.
        error: relative error of all depth; auto: as training frames tell, frame by frame.
    """
    if sequence.depth_mm is None or sequence.depth_error is not None or not sequence.training_depth_known:
        return sequence
    if error != "auto":
        return _uncertain(sequence, np.full(len(sequence.train), error)) if error > 0 else sequence
    found = None if carried is None else measured_depth_error(carried)
    if found is None or found.beyond_motion < LEAST_ERROR:
        return sequence
    _log.warning(
        "%s: training frames disagree about their depth by %.1f %% (median), %s; depth is corrected by what "
        "is estimated from the images (ingest.depth_error)",
        sequence.name,
        100 * MEDIAN * found.error,
        doubts_in_words(found.error),
        extra={"topic": "depth and poses", "field": "depth_mm"},
    )
    return _uncertain(sequence, found.of_frame)


def doubts_in_words(error: float) -> str:
    """What a relative error of depth, from what frames tell of each other's, may come from."""
    own = f"as if each were off by {100 * error:.1f} % in its own way"
    if error < GROSS_ERROR:
        return own
    return (
        f"{own}, or as if poses were wrong (are frames and poses in the same order, and is w of quaternions "
        "in its place?) or depth inverse"
    )


def as_given(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """A sequence from `with_depth_error` without the expected error, which holds for its poses alone."""
    if sequence.depth_error is None:
        return sequence
    return replace(sequence, depth_error=None, withheld_depth_mm=None)


def _uncertain(sequence: EndoscopicSequence, of_training: Float[np.ndarray, "n"]) -> EndoscopicSequence:
    """With a relative error of each training frame's depth; of the others the median of these."""
    of_frame = np.full(len(sequence), np.median(of_training))
    of_frame[sequence.train] = of_training
    size = (sequence.height, sequence.width)
    depth_error = stacked((np.full(size, error, np.float32) for error in of_frame), len(of_frame))
    true = sequence.depth_mm if sequence.withheld_depth_mm is None else sequence.withheld_depth_mm
    return replace(sequence, depth_error=depth_error, withheld_depth_mm=true)
