"""Objects in front of the surface that single frames show, such as instruments: they are masked.

Depth of an instrument starts Gaussians in the air, and its picture paints the tissue behind it. Frames tell:
points of it that poses carry to another frame lie in front of the surface that is measured there, so that
the other frame looks through them. An instrument that moves with the camera is found as well as one that
comes and goes, since in each frame it hangs elsewhere in the scene.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.blurred_depth_edges import ramps
from extrags.carried_depth import CHECKED_FRAMES, CarriedDepth, evenly, relative_error
from extrags.depth_votes import depth_votes
from extrags.frame_stacks import stacked
from extrags.observed_surface import observed_through_masks
from extrags.sequence import EndoscopicSequence

__all__ = ["foreground_objects", "without_foreground_objects"]

_log = logging.getLogger(__name__)

IN_FRONT, CLEARLY = 0.1, 0.3
"""Log-ratios of the surface's depth to a point's from which on another frame looks through the point, and
does so clearly."""

IN_FRONT_ERRORS, CLEARLY_ERRORS = 5.0, 10.0
"""The same in relative errors of depth, where these are larger."""

MOST_ERROR = 0.1
"""Relative error of depth beyond which frames do not tell what is in front."""

LEAST_FRAMES = 2
"""Other frames that have to look through a point."""

LEAST_CLEAR = 0.5
"""Share of a region that two frames look through clearly: at the edge of a fold that is a little off, few."""

LEAST_AREA = 0.003
"""Of an object, as a share of the image."""

MOST_AREA = 0.6
"""Share of a frame beyond which it is not an object that differs, but the frame."""

MOST_FRAMES_AREA = 0.3
"""Share of all training frames beyond which something else is wrong, and nothing is masked."""

STEP = 0.1
"""Log-ratio of depths of neighbouring pixels of one object at most."""

GROWN_FROM = 0.3
"""Share that was found of an object at least, to which what no other frame shows is added."""

PIXELS, TRIED_PIXELS = 20_000, 1_500
"""Of a frame that are carried to others, about, and that tell whether there is anything."""

TRIED_AREA = 0.002
"""Share of these that others look through, from which on a frame is looked at closely."""


@dataclass(frozen=True)
class _Votes:
    """What other frames say of a frame's pixels, on a grid.

    Args:
        depth: of the frame, 0 where unknown.
        looks_through: frames that see the surface behind the point.
        clearly: those of them that see it far behind.
        supports: frames that have the surface where the point is.
    """

    depth: Float[np.ndarray, "h w"]
    looks_through: Int[np.ndarray, "h w"]
    clearly: Int[np.ndarray, "h w"]
    supports: Int[np.ndarray, "h w"]

    @property
    def in_front(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that more frames look through than support."""
        return (self.looks_through >= LEAST_FRAMES) & (self.looks_through > self.supports)

    @property
    def clearly_in_front(self) -> Bool[np.ndarray, "h w"]:
        """Those that hang far in front of the surface, by a clear majority."""
        return (self.clearly >= LEAST_FRAMES) & (self.clearly > 2 * self.supports)


def without_foreground_objects(
    sequence: EndoscopicSequence, carried: CarriedDepth | None
) -> EndoscopicSequence:
    """The sequence, its training frames masked where they show objects in front of the surface.

    A warning tells how many frames show some. What only masked pixels saw does not count as observed. Where
    there are none, the sequence is returned as it is.

    Args:
        sequence: in the unit of its poses.
        carried: its depth; None where frames tell nothing of each other's.
    """
    if carried is None:
        return sequence
    found = foreground_objects(carried)
    area = sum(float(mask.mean()) for mask in found.values()) / len(sequence.train)
    if not found:
        return sequence
    first = sequence.frame_name(int(sequence.train[min(found)]))
    if area > MOST_FRAMES_AREA:
        _log.warning(
            "%s: %.0f %% of the depth of training frames lies in front of what other frames see there, more "
            "than instruments can; nothing is masked. Are frames and poses in the same order?",
            sequence.name,
            100 * area,
            extra={"topic": "depth and poses", "field": "depth_mm"},
        )
        return sequence
    _log.warning(
        "%s: %d of %d training frames, %s first, show something in front of the surface that other frames "
        "look through, as an instrument; it is masked (up to %.0f %% of a frame; ingest.mask_foreground)",
        sequence.name,
        len(found),
        len(sequence.train),
        first,
        100 * max(float(mask.mean()) for mask in found.values()),
        extra={"topic": "masks", "field": "mask"},
    )
    objects = {int(sequence.train[position]): mask for position, mask in found.items()}

    def masked(stack: np.ndarray) -> np.ndarray:
        frames = (
            np.where(objects[k], np.zeros((), frame.dtype), frame) if k in objects else frame
            for k, frame in enumerate(stack)
        )
        return stacked(frames, len(stack))

    assert sequence.depth_mm is not None
    sequence = replace(sequence, mask=masked(sequence.mask), depth_mm=masked(sequence.depth_mm))
    return replace(sequence, observed=observed_through_masks(sequence))


def foreground_objects(carried: CarriedDepth) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Pixels of training frames that show objects in front of the surface.

    A region is one that most of the frames that see its place look through, two of them clearly. What no
    other frame sees is added where its depth goes on from there without a step.

    Args:
        carried: depth of a sequence's training frames.

    Returns:
        Of each position among the training frames that has some, its pixels, of the sequence's size.
    """
    count = len(carried.cameras)
    error = relative_error([carried.ratio(pair) for pair in carried.pairs])
    if error > MOST_ERROR:
        return {}
    tried = evenly(count, CHECKED_FRAMES).tolist()
    others: dict[int, list[int]] = {position: [] for position in tried}
    for pair in carried.pairs:
        others[pair.first].append(pair.second)
    suspects = [k for k in tried if _is_suspect(_votes(carried, k, others[k], error, TRIED_PIXELS))]
    if not suspects:
        return {}
    if count > len(tried):
        suspects, others = list(range(count)), carried.sources(np.arange(count))
    found = {}
    for position in suspects:
        region = _objects(_votes(carried, position, others[position], error, PIXELS))
        if region.any() and region.mean() <= MOST_AREA:
            found[position] = _enlarged(region, (carried.sequence.height, carried.sequence.width))
    return found


def _is_suspect(votes: _Votes) -> bool:
    return bool((votes.in_front & votes.clearly_in_front).mean() >= TRIED_AREA)


def _votes(carried: CarriedDepth, position: int, others: list[int], error: float, pixels: int) -> _Votes:
    """What frames say of about so many pixels of another one."""
    cameras = carried.cameras
    every = max(1, round(np.sqrt(cameras.width * cameras.height / pixels)))
    grid = carried.known(position)
    depth = np.where(ramps(grid), 0, grid)[every // 2 :: every, every // 2 :: every]
    rows, columns = np.nonzero(depth > 0)
    found = depth_votes(
        carried,
        position,
        others,
        (every // 2 + every * rows, every // 2 + every * columns),
        max(IN_FRONT, IN_FRONT_ERRORS * error),
        max(CLEARLY, CLEARLY_ERRORS * error),
    )
    maps = np.zeros((len(found), *depth.shape), np.int64)
    maps[:, rows, columns] = found
    return _Votes(depth, *maps)


def _objects(votes: _Votes) -> Bool[np.ndarray, "h w"]:
    """Regions that are objects, and a pixel round each."""
    # Strips along folds that are a pixel or two off are no objects.
    opened = cv2.morphologyEx(votes.in_front.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(opened)
    area = np.bincount(labels.ravel(), minlength=count)
    clear = np.bincount(labels[votes.clearly_in_front], minlength=count)
    chosen = (area >= LEAST_AREA * labels.size) & (clear >= LEAST_CLEAR * area)
    chosen[0] = False
    found = np.asarray(chosen[labels])
    if not found.any():
        return found
    grown = found | _continued(votes, found)
    return np.asarray(cv2.dilate(grown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _continued(votes: _Votes, found: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where objects go on in what no other frame shows: up to the steps of depth at their edges."""
    log = np.log(np.where(votes.depth > 0, votes.depth, 1))
    across, down = np.abs(np.diff(log, axis=1)) > STEP, np.abs(np.diff(log, axis=0)) > STEP
    edge = np.zeros(found.shape, bool)
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    unsupported = (votes.depth > 0) & ((votes.supports == 0) | votes.in_front)
    count, labels = cv2.connectedComponents(((unsupported & ~edge) | found).astype(np.uint8), connectivity=4)
    area, known = (np.bincount(part.ravel(), minlength=count) for part in (labels, labels[found]))
    chosen = known >= GROWN_FROM * area
    chosen[0] = False
    return np.asarray(chosen[labels])


def _enlarged(region: Bool[np.ndarray, "h w"], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """A region of the grid in the pixels of the sequence."""
    height, width = size
    found = cv2.resize(region.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(found > 0)
