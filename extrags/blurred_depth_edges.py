"""Edges of measured depth that are blurred, as by enlarging depth maps: their depth is taken to be unknown.

Between a near and a far surface a blurred map has points in the air. In a single map these look like the far
end of a tube; but other frames look through them.
"""

from __future__ import annotations

import logging

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from extrags.carried_depth import CarriedDepth, evenly, relative_error
from extrags.depth_votes import depth_votes
from extrags.sequence import EndoscopicSequence

__all__ = ["ramps", "without_blurred_depth_edges"]

_log = logging.getLogger(__name__)

REACH = 5
"""Pixels of the grid to each side of a ramp's middle."""

BESIDE = 3
"""Pixels beyond, which tell how level the surfaces at its ends are."""

LEAST_STEP = 0.12
"""Log-ratio of depth from end to end."""

LEVEL = 0.25
"""Slope beside a ramp at most, relative to the mean slope inside."""

OFF_BOTH = 0.04
"""Log-ratio from either end's depth, from which on a pixel is of neither surface."""

IN_FRONT = 0.05
"""Log-ratio of the surface's depth to a point's from which on another frame looks through the point."""

LEAST_SHARE = 0.08
"""Of the pixels on ramps that other frames look through. Of blurred edges these are 9 to 44 %, of clean ones
none, with poses off by 1 % of the depth and half a degree 4 % at most."""

LEAST_RATIO = 5.0
"""Of that share to the one elsewhere. Where poses or depth are off, others look through both alike: of poses
that are off by three times as much 1.5 to 3.5 times as often."""

LEAST_AREA = 0.0005
"""Of pixels on ramps that others look through, of all."""

MOST_ERROR = 0.1
"""Relative error of depth beyond which frames do not tell what is in front."""

TRIED_FRAMES = 24
"""Training frames at most that tell whether there is anything, spread over the recording."""

TRIED_EVERY = 10
"""One in so many of the pixels that are on no ramp is carried for that."""


def without_blurred_depth_edges(
    sequence: EndoscopicSequence, carried: CarriedDepth | None
) -> EndoscopicSequence:
    """The sequence, depth of its training frames unknown between surfaces where edges are blurred.

    A warning tells how much is left out. Frames keep their colours. Where edges are sharp, or frames do not
    tell, the sequence is returned as it is.

    Args:
        sequence: in the unit of its poses.
        carried: its depth; None where frames tell nothing of each other's.
    """
    if carried is None:
        return sequence
    error = relative_error([carried.ratio(pair) for pair in carried.pairs])
    if error > MOST_ERROR or not (share := _looked_through(carried)):
        return sequence
    count = len(carried.cameras)
    others = carried.sources(np.arange(count))
    size = (sequence.width, sequence.height)
    unsure = {}
    for position, frame in enumerate(sequence.train.tolist()):
        pixels = _unsure(carried, position, others[position]).astype(np.uint8)
        unsure[frame] = cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST) > 0
    _log.warning(
        "%s: edges of depth are blurred: other frames look through %.0f %% of the pixels between a near and "
        "a far surface; depth is taken to be unknown there, at %.1f %% of the pixels. Resize depth without "
        "interpolation",
        sequence.name,
        100 * share,
        100 * float(np.mean([pixels.mean() for pixels in unsure.values()])),
        extra={"topic": "depth", "field": "depth_mm"},
    )
    return sequence.with_changed_depth(
        lambda frame, depth: np.where(unsure[frame], 0, depth) if frame in unsure else depth
    )


def ramps(depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that lie between a near and a far surface, along rows or columns.

    A ramp has level surfaces at both ends, `2 * REACH` pixels apart; of it are the pixels whose depth is
    neither the one's nor the other's. Blurred edges are such, and so is the far end of a tube.

    Args:
        depth: 0 where unknown; ramps end there.
    """
    log = np.log(np.where(depth > 0, depth, np.nan)).astype(np.float32)
    found = np.zeros(depth.shape, bool)
    for along, here in ((log, found), (log.T, found.T)):
        _add_ramps(along, here)
    return found


def _add_ramps(log: Float32[np.ndarray, "h w"], found: Bool[np.ndarray, "h w"]) -> None:
    """Sets what is on ramps along rows."""
    around = REACH + BESIDE
    middles = log.shape[1] - 2 * around
    if middles <= 0:
        return
    before, begin, end, after = (
        log[:, around + offset : around + offset + middles] for offset in (-around, -REACH, REACH, around)
    )
    with np.errstate(invalid="ignore"):
        step = np.abs(end - begin)
        beside = np.maximum(np.abs(begin - before), np.abs(after - end)) / BESIDE
        ramp = (step > LEAST_STEP) & (beside < LEVEL * step / (2 * REACH))
        nearest, farthest = np.minimum(begin, end) + OFF_BOTH, np.maximum(begin, end) - OFF_BOTH
        for offset in range(-REACH, REACH + 1):
            columns = slice(around + offset, around + offset + middles)
            found[:, columns] |= ramp & (log[:, columns] > nearest) & (log[:, columns] < farthest)


def _looked_through(carried: CarriedDepth) -> float:
    """Share of the pixels on ramps that others look through; 0 where that does not tell blurred edges."""
    tried = evenly(len(carried.cameras), TRIED_FRAMES)
    others = carried.sources(tried)
    carried_, through = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for position in tried.tolist():
        depth = carried.known(position)
        ramp = ramps(depth)
        elsewhere = np.flatnonzero((depth > 0) & ~ramp)[::TRIED_EVERY]
        for kind, pixels in enumerate((np.flatnonzero(ramp), elsewhere)):
            carried_[kind] += len(pixels)
            through[kind] += _seen_through(carried, position, others[position], pixels).sum()
    on_ramps, elsewhere_share = through / np.maximum(carried_, 1)
    area = through[0] / (len(tried) * carried.cameras.width * carried.cameras.height)
    blurred = area >= LEAST_AREA and on_ramps >= max(LEAST_SHARE, LEAST_RATIO * elsewhere_share)
    return float(on_ramps) if blurred else 0.0


def _unsure(carried: CarriedDepth, position: int, others: list[int]) -> Bool[np.ndarray, "h w"]:
    """Pixels of a frame on ramps, and those that others look through with a pixel round them."""
    depth = carried.known(position)
    pixels = np.flatnonzero(depth > 0)
    through = np.zeros(depth.shape, np.uint8)
    through.ravel()[pixels] = _seen_through(carried, position, others, pixels)
    round_them = cv2.dilate(through, np.ones((3, 3), np.uint8)) > 0
    return np.asarray(ramps(depth) | round_them)


def _seen_through(
    carried: CarriedDepth, position: int, others: list[int], pixels: np.ndarray
) -> Bool[np.ndarray, "p"]:
    """Whether more frames look through pixels of a frame, given by their numbers, than support them."""
    rows, columns = np.divmod(pixels, carried.cameras.width)
    votes = depth_votes(carried, position, others, (rows, columns), IN_FRONT, IN_FRONT)
    return np.asarray(votes.looks_through > votes.supports)
