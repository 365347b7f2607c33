"""Frames that show nothing, and frames whose pose is grossly wrong: no stage uses them."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from extrags.carried_depth import CarriedDepth, Pair
from extrags.frame_stacks import frames_of
from extrags.observed_surface import observed_by_those_left
from extrags.sequence import EndoscopicSequence
from extrags.splits import Split

__all__ = ["of_split", "shows_nothing", "without_blank_frames", "without_misplaced_frames"]

_log = logging.getLogger(__name__)

DARK = 20
"""Brightest channel of 255 that hardly a pixel of a black frame exceeds."""

UNIFORM = 10
"""Spread of each channel of 255, below which a frame has one colour: a lens on the wall, or covered."""

LOOKED_AT_PX = 5_000
"""Pixels of a frame that tell, about."""

HARDLY = 2.0
"""Percent of the pixels at either end that are passed over: highlights, dead pixels, a clock."""

MOST = 0.25
"""Share of training frames that may be unusable; where more seem so, it is the scene, and all are kept."""

LEAST_LEFT = 2
"""Training frames that are kept in any case."""

PARTNERS = 3
"""Frames that agree best with a frame, which judge its pose."""

EXPLAINED = 0.3
"""Share of the disagreement that is left, at most, with another motion between the cameras."""

MISPLACED_TIMES, MISPLACED_ERROR = 5.0, 0.02
"""A misplaced frame disagrees with them so many times as much as frames do in the median, and by so much."""


def shows_nothing(rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a picture is black, or of one colour, inside its mask; so is one without any valid pixel.

    Args:
        rgb: from 0 to 255.
        mask: true where a pixel shows tissue.
    """
    every = max(1, round(np.sqrt(mask.size / LOOKED_AT_PX)))
    pixels = rgb[::every, ::every][mask[::every, ::every]]
    if not len(pixels):
        return True
    low, high = np.percentile(pixels, (HARDLY, 100 - HARDLY), axis=0)
    return bool(high.max() < DARK or (high - low).max() < UNIFORM)


def without_blank_frames(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The sequence, its split without frames that show nothing; a warning names them.

    A camera that is covered or switched off between two frames teaches the surface to be black. Held-out
    frames of this kind measure nothing. Where more than `MOST` of the training frames are so, all stay.

    Args:
        sequence: with or without poses.
    """
    blank = np.array(
        [shows_nothing(rgb, mask) for rgb, mask in zip(sequence.rgb, sequence.mask, strict=True)], dtype=bool
    )
    return _without(sequence, np.flatnonzero(blank), "black, or of one colour", "rgb")


def without_misplaced_frames(
    sequence: EndoscopicSequence, carried: CarriedDepth | None
) -> EndoscopicSequence:
    """The sequence, its split without training frames whose pose is grossly wrong; a warning names them.

    Depth that is carried to the frames that agree with it best is off by much more than that of other frames,
    and another motion between the two cameras explains most of it.

    Args:
        sequence: with at least four training frames, else it is returned as it is.
        carried: its depth; None where nothing can be told.
    """
    if carried is None or len(sequence.train) < 4:
        return sequence
    errors: dict[int, list[tuple[float, Pair]]] = {}
    for pair in carried.pairs:
        error = _difference(carried.ratio(pair))
        for position in (pair.first, pair.second):
            errors.setdefault(position, []).append((error, pair))
    nearest = {k: sorted(found, key=lambda item: item[0])[:PARTNERS] for k, found in errors.items()}
    best = {k: float(np.mean([error for error, _ in found])) for k, found in nearest.items()}
    limit = max(MISPLACED_TIMES * float(np.median(list(best.values()))), MISPLACED_ERROR)

    def is_explained(position: int) -> bool:
        moved = [_difference(carried.beyond_motion(pair)) for _, pair in nearest[position]]
        return float(np.mean(moved)) < EXPLAINED * best[position]

    suspects = sorted(position for position, error in best.items() if error > limit)
    wrong = np.array([position for position in suspects if is_explained(position)], dtype=np.int64)
    what = "at a place that the depth of the others contradicts"
    return _without(sequence, sequence.train[wrong], what, "world_from_camera")


def _difference(ratio: Float[np.ndarray, "p"]) -> float:
    """Median of how far depths differ, in front and behind."""
    return float(np.nanmedian(np.abs(ratio)))


def _without(
    sequence: EndoscopicSequence, frames: Int[np.ndarray, "n"], what: str, field: str
) -> EndoscopicSequence:
    """With a split that does not name these frames; what they saw does not count as observed."""
    split = sequence.split
    train, test = (np.setdiff1d(part, frames) for part in (split.train, split.test))
    lost = len(split.train) - len(train)
    if lost + len(split.test) - len(test) == 0:
        return sequence
    if lost > MOST * len(split.train) or len(train) < min(LEAST_LEFT, len(split.train)):
        return sequence
    gone = np.intersect1d(frames, np.concatenate([split.train, split.test]))
    _log.warning(
        "%s: %d of %d frames, %s first, are %s: they are left out",
        sequence.name,
        len(gone),
        len(split.train) + len(split.test),
        sequence.frame_name(int(gone[0])),
        what,
        extra={"topic": "unusable frames", "field": field},
    )
    return replace(
        sequence,
        split=Split(split.name, train, test, split.version),
        observed=observed_by_those_left(sequence, train),
    )


def of_split(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The sequence without the frames that are neither trained on nor held out, for who knows no split.

    Frames keep their names; the split is renumbered. Where there are no such frames, the sequence is returned
    as it is.

    Args:
        sequence: with or without poses.
    """
    kept = sequence.split.frames
    if len(kept) == len(sequence):
        return sequence

    def of_kept(stack: Any) -> Any:
        return None if stack is None else frames_of(stack, kept)

    split = sequence.split
    train, test = (np.searchsorted(kept, part) for part in (split.train, split.test))
    stacks = ("depth_mm", "withheld_depth_mm", "depth_error", "observed", "specular")
    return replace(
        sequence,
        rgb=of_kept(sequence.rgb),
        K=sequence.K[kept],
        mask=of_kept(sequence.mask),
        split=Split(split.name, train, test, split.version),
        frame_names=tuple(sequence.frame_name(int(frame)) for frame in kept),
        **{name: of_kept(getattr(sequence, name)) for name in (*stacks, "world_from_camera", "recording")},
    )
