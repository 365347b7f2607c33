"""Which pixels of held-out frames show surface that training frames saw."""

from __future__ import annotations

import logging

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.cameras import Cameras, pixel_rays
from extrags.events import Progress, emit
from extrags.frame_stacks import empty_stack
from extrags.sequence import EndoscopicSequence
from extrags.splits import Split

__all__ = [
    "never_observed",
    "observed_by_depth",
    "observed_by_those_left",
    "observed_from_depth",
    "observed_through_masks",
]

_LOG = logging.getLogger(__name__)

_ROUNDING = 1e-6
"""Share by which a depth may differ between two ways to compute it."""


def never_observed(
    sequence: EndoscopicSequence, frames: int | Int[np.ndarray, "n"]
) -> Bool[np.ndarray, "*n h w"]:
    """Valid pixels of held-out frames that show surface which no training frame saw.

    Pixels without true depth are left out where the sequence has any: nothing tells what they show.

    Args:
        sequence: with its truth.
        frames: index of one frame, or indices of several.

    Returns:
        [H, W] for one frame, [N, H, W] for several; false in training frames, and where the sequence
        does not know what was observed.
    """
    held_out = np.isin(frames, sequence.test)[..., None, None]
    unseen = np.asarray(sequence.mask[frames] & held_out)
    if sequence.observed is None:
        return np.zeros_like(unseen)
    unseen &= ~sequence.observed[frames]
    if sequence.true_depth_mm is not None:
        unseen &= sequence.true_depth_mm[frames] > 0
    return unseen


def observed_from_depth(
    cameras: Cameras,
    mask: Bool[np.ndarray, "f h w"],
    depth_mm: Float[np.ndarray, "f h w"],
    train: Int[np.ndarray, "n_train"],
    test: Int[np.ndarray, "n_test"],
    *,
    tolerance_share: float = 0.03,
    tolerance_mm: float = 0.0,
    stage: str = "ingest",
) -> Bool[np.ndarray, "f h w"]:
    """A depth test against every training frame.

    A point of a held-out frame is observed when it falls into a training image, inside its mask, and lies no
    farther than that image's depth (the farthest of the four pixels round it that are inside the mask, so
    that rounding at slanted walls does not hide it). After each held-out frame it emits progress: there are
    as many tests as pairs of frames.

    Args:
        cameras: all frames.
        mask: valid pixels, [F, H, W]. A training frame sees nothing outside its own, whatever depth is known
            there; those of held-out frames are not looked at.
        depth_mm: z-depth, 0 where unknown, [F, H, W].
        train: indices of training frames.
        test: indices of held-out frames.
        tolerance_share: how much farther still counts, as a share of the depth.
        tolerance_mm: the same as a length: the step of the depth's encoding.
        stage: whose progress it is.

    Returns:
        True where observed, [F, H, W]; false in training frames and where depth is unknown.
    """
    observed = empty_stack(depth_mm.shape, bool)
    viewmats = cameras.viewmats
    # What a frame can see at all: most pairs of a long recording are told apart by this.
    reach = {int(frame): float(np.where(mask[frame], depth_mm[frame], 0).max(initial=0)) for frame in train}
    for done, index in enumerate(test, start=1):
        known = depth_mm[index] > 0
        rays = pixel_rays(cameras[int(index)])[0][known]
        points = cameras.centers[index] + rays * depth_mm[index][known][:, None].astype(np.float64)
        seen = np.zeros(len(points), dtype=bool)
        # The nearest frames see most; only what they leave is looked for in the others.
        nearest = np.argsort(np.linalg.norm(cameras.centers[train] - cameras.centers[index], axis=1))
        for other in np.asarray(train)[nearest]:
            left = np.flatnonzero(~seen)
            if not left.size:
                break
            z = points[left] @ viewmats[other, 2, :3] + viewmats[other, 2, 3]
            farthest = reach[int(other)] * (1 + tolerance_share) + tolerance_mm
            left = left[(z > 0) & (z <= farthest * (1 + _ROUNDING))]
            if not left.size:
                continue
            seen[left] = _in_front(
                points[left],
                cameras[int(other)],
                mask[other],
                depth_mm[other],
                tolerance_share,
                tolerance_mm,
            )
        observed[index][known] = seen
        emit(Progress(stage, done, len(test)))
    return observed


def observed_by_those_left(
    sequence: EndoscopicSequence, left: Int[np.ndarray, "n"], *, stage: str = "ingest"
) -> Bool[np.ndarray, "f h w"] | None:
    """What is observed in held-out frames once some training frames have left.

    By true depth and the source's own poses; what no training frame saw before stays unobserved. Where these
    are not known nothing tells what the others saw, and nothing is said.

    Args:
        sequence: as it came.
        left: training frames that stay.
        stage: whose progress it is.

    Returns:
        True where observed, [F, H, W]; None where nothing tells.
    """
    if sequence.observed is None or len(left) == len(sequence.train):
        return sequence.observed
    depth = sequence.true_depth_mm
    if depth is None or sequence.world_from_camera is None or sequence.intrinsics == "guessed":
        _LOG.warning(
            "%s: %d training frames are dropped, and without true depth and poses nothing tells what the "
            "others observed: observed and unobserved pixels are not told apart",
            sequence.name,
            len(sequence.train) - len(left),
        )
        return None
    return _seen_again(sequence, sequence.observed, depth, left, stage)


def observed_through_masks(
    sequence: EndoscopicSequence, *, stage: str = "ingest"
) -> Bool[np.ndarray, "f h w"] | None:
    """What is observed in held-out frames once masks of training frames have become smaller.

    What was not observed before stays so; as it was where true depth or poses are not known.

    Args:
        sequence: with the new masks, and what was observed with the old ones.
        stage: whose progress it is.

    Returns:
        True where observed, [F, H, W]; None where the sequence does not know.
    """
    depth = sequence.true_depth_mm
    if sequence.observed is None or depth is None or sequence.world_from_camera is None:
        return sequence.observed
    return _seen_again(sequence, sequence.observed, depth, sequence.train, stage)


def _seen_again(
    sequence: EndoscopicSequence,
    before: Bool[np.ndarray, "f h w"],
    depth: Float[np.ndarray, "f h w"],
    train: Int[np.ndarray, "n"],
    stage: str,
) -> Bool[np.ndarray, "f h w"]:
    seen = observed_from_depth(sequence.cameras, sequence.mask, depth, train, sequence.test, stage=stage)
    return np.asarray(seen & before)


def observed_by_depth(
    cameras: Cameras,
    mask: Bool[np.ndarray, "f h w"],
    depth_mm: Float[np.ndarray, "f h w"] | None,
    split: Split,
    *,
    tolerance_mm: float = 0.0,
) -> Bool[np.ndarray, "f h w"] | None:
    """`observed_from_depth` for the frames of a split; None where there is no depth.

    One of the functions that a reader of posed frames may be given: others look at a mesh.

    Args:
        cameras: all frames.
        mask: valid pixels of all frames, [F, H, W].
        depth_mm: z-depth, 0 where unknown, [F, H, W].
        split: which frames train, and which are held out.
        tolerance_mm: the step of the depth's encoding.

    Returns:
        True where observed, [F, H, W].
    """
    if depth_mm is None:
        return None
    return observed_from_depth(cameras, mask, depth_mm, split.train, split.test, tolerance_mm=tolerance_mm)


def _in_front(
    points: Float[np.ndarray, "p 3"],
    camera: Cameras,
    mask: Bool[np.ndarray, "h w"],
    depth_mm: Float[np.ndarray, "h w"],
    tolerance_share: float,
    tolerance_mm: float,
) -> Bool[np.ndarray, "p"]:
    (pixels,), (z,) = camera.project(points)
    inside = camera.contains(pixels)
    column, row = pixels[inside].astype(np.int64).T
    inside[inside] = mask[row, column]
    u, v = pixels[inside].T
    farthest = np.zeros(len(u))
    for dy in (-0.5, 0.5):
        for dx in (-0.5, 0.5):
            row = np.clip(np.floor(v + dy).astype(int), 0, camera.height - 1)
            column = np.clip(np.floor(u + dx).astype(int), 0, camera.width - 1)
            farthest = np.maximum(farthest, np.where(mask[row, column], depth_mm[row, column], 0))
    result = np.zeros(len(points), dtype=bool)
    result[inside] = z[inside] <= farthest * (1 + tolerance_share) + tolerance_mm * (farthest > 0)
    return result
