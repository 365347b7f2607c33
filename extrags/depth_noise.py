"""Measured depth whose single pixels are off: speckles, and noise."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float

from extrags.carried_depth import evenly
from extrags.sequence import EndoscopicSequence

__all__ = ["noise_level", "smoothed", "speckles", "with_clean_depth"]

_log = logging.getLogger(__name__)

_TOPIC = {"topic": "depth", "field": "depth_mm"}

ALIKE = 0.15
"""Log-ratio of depths up to which neighbouring pixels support each other."""

SUPPORT = 3
"""Of the eight neighbours of a pixel, so many at least support it where it is no speckle."""

LEAST_SPECKLES = 0.02
"""Share of known pixels from which on speckles are taken out; edges of folds in small pictures have 0.016."""

LEAST_NOISE = 0.02
"""Relative standard deviation from which on depth is smoothed. Rendered depth has 0.0005 at most, in pictures
of 60 pixels, whose surfaces bend from pixel to pixel, 0.013."""

MOST_SPECKLES = 0.3
"""Share beyond which there is no surface that they would stand out from, and depth is left alone."""

LOOKED_AT = 40
"""Training frames at most that tell whether depth has speckles and noise, spread over the recording."""

WITHIN = 4.0
"""Noise levels that a pixel may differ by from the median round another, to count in its mean."""

REACH = 3
"""Pixels to each side that the mean is taken over."""

SPREAD = 2.0
"""Standard deviation of its Gaussian weights, in pixels."""


def with_clean_depth(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The sequence without speckles in its depth, and with depth smoothed that is noisy.

    Gaussians start at every pixel of measured depth; those that lie off the surface hang in the air, each in
    a voxel of its own when starting points are thinned out. Depth that is clean is returned as it is; a
    warning tells what is changed. What the evaluation compares with is changed alike.

    Args:
        sequence: with measured depth.
    """
    if sequence.depth_mm is None or sequence.depth_error is not None or not sequence.training_depth_known:
        return sequence
    counts = np.zeros(2, dtype=np.int64)
    looked_at = sequence.train[evenly(len(sequence.train), LOOKED_AT)].tolist()
    for frame in looked_at:
        depth = sequence.depth_mm[frame]
        counts += np.array([np.count_nonzero(speckles(depth)), np.count_nonzero(depth > 0)])
    share = counts[0] / max(1, counts[1])
    if share > MOST_SPECKLES:
        _log.warning(
            "%s: %.0f %% of the depths of training frames are like too few of their neighbours, more than "
            "speckles can be; depth is left as it is. Is it of these frames?",
            sequence.name,
            100 * share,
            extra=_TOPIC,
        )
        return sequence
    if share >= LEAST_SPECKLES:
        _log.warning(
            "%s: %.1f %% of the depths of training frames are like too few of their neighbours; they are "
            "taken to be unknown",
            sequence.name,
            100 * share,
            extra=_TOPIC,
        )
        sequence = sequence.with_changed_depth(lambda _, depth: np.where(speckles(depth), 0, depth))
    assert sequence.depth_mm is not None
    depths = sequence.depth_mm
    noise = float(np.median([noise_level(depths[frame]) for frame in looked_at]))
    if noise < LEAST_NOISE:
        return sequence
    _log.warning(
        "%s: depth has noise of %.1f %% from pixel to pixel; it is smoothed over %d pixels",
        sequence.name,
        100 * noise,
        2 * REACH + 1,
        extra=_TOPIC,
    )
    return sequence.with_changed_depth(lambda _, depth: smoothed(depth, noise))


def speckles(depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Known pixels whose depth is like that of too few of their neighbours.

    Too few are less than `SUPPORT` of eight, and at the rim of what is known less than half.

    Args:
        depth: 0 where unknown.
    """
    known = depth > 0
    log = np.log(np.where(known, depth, 1)).astype(np.float32)
    alike, neighbours = np.zeros(depth.shape, np.int8), np.zeros(depth.shape, np.int8)
    for _, (known_there, log_there) in _around(1, known, log):
        neighbours += known_there
        alike += known_there & (np.abs(log_there - log) < ALIKE)
    return np.asarray(known & (alike < np.minimum(SUPPORT, (neighbours + 1) // 2)))


def noise_level(depth: Float[np.ndarray, "h w"]) -> float:
    """Relative standard deviation of white noise in a depth map, 0 where too little is known.

    Over a plane the inverse of depth is linear: second differences along rows are noise alone. Their median
    is hardly changed by edges and curved surfaces.

    Args:
        depth: 0 where unknown.
    """
    known = depth > 0
    inverse = np.divide(1, depth, out=np.zeros(depth.shape), where=known)
    left, middle, right = inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:]
    three = known[:, :-2] & known[:, 1:-1] & known[:, 2:]
    if not three.any():
        return 0.0
    bend = np.abs(left - 2 * middle + right)[three] / middle[three]
    return float(1.4826 * np.median(bend) / np.sqrt(6))


def smoothed(depth: Float[np.ndarray, "h w"], noise: float) -> Float[np.ndarray, "h w"]:
    """A depth map as local means of its inverse, over pixels of the same surface.

    Args:
        depth: 0 where unknown, which stays.
        noise: relative, as `noise_level` finds it.
    """
    known = depth > 0
    inverse = np.divide(1, depth, out=np.zeros(depth.shape), where=known).astype(np.float32)
    middle = cv2.medianBlur(inverse, 5)
    # Beside much that is unknown the median is 0: the pixel itself serves.
    middle = np.where(middle > 0, middle, inverse)
    total, weights = inverse.copy(), known.astype(np.float32)
    for distance, (known_there, value) in _around(REACH, known, inverse):
        near = known_there & (np.abs(value - middle) < WITHIN * noise * middle)
        weight = np.float32(np.exp(-0.5 * (distance / SPREAD) ** 2)) * near
        total += weight * value
        weights += weight
    # A pixel that is off itself counts as little as others that are.
    own = known & (np.abs(inverse - middle) >= WITHIN * noise * middle) & (weights > 1)
    total, weights = np.where(own, total - inverse, total), np.where(own, weights - 1, weights)
    mean = np.divide(total, weights, out=np.ones(depth.shape, np.float32), where=known)
    return np.where(known, 1 / mean, 0).astype(depth.dtype)


def _around(reach: int, *images: np.ndarray) -> Iterator[tuple[float, list[np.ndarray]]]:
    """Images as seen from each offset but none, with its length; zero beyond the rim."""
    height, width = images[0].shape
    padded = [np.pad(image, reach) for image in images]
    for row in range(2 * reach + 1):
        for column in range(2 * reach + 1):
            if (row, column) != (reach, reach):
                there = slice(row, row + height), slice(column, column + width)
                yield float(np.hypot(row - reach, column - reach)), [image[there] for image in padded]
