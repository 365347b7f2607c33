"""Estimated depth and measured depth that is not exact, made one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

__all__ = ["CERTAIN", "HOPELESS", "Depth", "combined"]

CERTAIN, HOPELESS = 0.005, 1.0
"""Bounds of the expected relative error."""

SURE_ERROR = 0.05
"""Expected error of an estimate up to which it corrects measured depth."""

LEAST_SURE = 50
"""Pixels of a frame with such an estimate, below which its measured depth is not corrected."""

FIELD_WIDTH = 0.12
"""Standard deviation, in widths of the image, of the window in which a smooth error is found."""

FIELD_PRIOR = 0.05
"""Weight of no smooth error, beside that of the estimate at one pixel."""

FIELD_ROUNDS = 3
"""Of weights that fall with the distance from the smooth error that was found."""

FLOOR = 0.01
"""Expected error that an estimate has at least where it corrects measured depth: neighbours share it."""

NORMAL = 1.4826
"""Standard deviation of a normal distribution, by the median of its absolute values."""


@dataclass(frozen=True)
class Depth:
    """A depth map and its expected relative error.

    Args:
        z: depth, 0 where unknown, [H, W].
        error: relative, [H, W].
    """

    z: Float[np.ndarray, "h w"]
    error: Float[np.ndarray, "h w"]


def combined(estimated: Depth, measured: Depth) -> Depth:
    """The depth of one frame, from an estimate and a measurement.

    The estimate is right in the mean over many pixels and wrong at single ones; measured depth that frames
    disagree about is mostly off as a whole, or smoothly. So first the measured one is corrected, by a factor
    and by a smooth error, as pixels with a sure estimate tell. What is left of their differences is its
    expected error, and pixel by pixel the mean of both log-depths is taken, weighted by inverse squared
    errors. Where they differ by more than they expect, the result expects as much (the ratio of [Birge1932]).

    Args:
        estimated: with an expected error above 0 where it is known.
        measured: of the same frame.
    """
    known = (measured.z > 0) & (estimated.z > 0)
    own, own_error = _log(estimated.z), np.maximum(estimated.error, CERTAIN)
    given, given_error = _log(measured.z), np.maximum(measured.error, CERTAIN)
    difference = np.where(known, own - given, 0.0)
    sure = known & (own_error <= SURE_ERROR)
    if sure.sum() >= LEAST_SURE:
        weight = 1 / (own_error[sure] ** 2 + given_error[sure] ** 2)
        difference = difference - _weighted_median(difference[sure], weight)
        spread = max(NORMAL * float(np.median(np.abs(difference[sure]))), CERTAIN)
        difference = difference - _smooth(difference, own_error, known, spread)
        left = max(NORMAL * float(np.median(np.abs(difference[sure]))), CERTAIN)
        given_error = np.minimum(given_error, left)
        given = np.where(known, own - difference, given)
    own_weight, given_weight = 1 / own_error**2, 1 / given_error**2
    total = own_weight + given_weight
    ratio = np.abs(difference) / np.hypot(own_error, given_error)
    error = np.maximum(ratio, 1) / np.sqrt(total)
    both = (own_weight * own + given_weight * given) / total
    z = np.where(known, np.exp(both), np.where(measured.z > 0, measured.z, estimated.z))
    alone = np.where(measured.z > 0, measured.error, estimated.error)
    bounded = np.clip(np.where(known, error, alone), CERTAIN, HOPELESS)
    return Depth(z.astype(np.float32), np.where(z > 0, bounded, 0).astype(np.float32))


def _log(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Its logarithm, 0 where it is unknown."""
    return np.asarray(np.log(np.where(depth > 0, depth, 1).astype(np.float64)))


def _weighted_median(values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n"]) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


def _smooth(
    difference: Float[np.ndarray, "h w"],
    error: Float[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    spread: float,
) -> Float[np.ndarray, "h w"]:
    """The smooth part of differences, robustly, and none where little is known.

    Args:
        difference: of log-depths.
        error: expected of the estimate.
        known: pixels that have both.
        spread: standard deviation of the differences.
    """
    width = FIELD_WIDTH * difference.shape[1]
    weight = np.where(known, 1 / (error**2 + FLOOR**2), 0)
    scale = np.hypot(error, 2 * FLOOR)
    found = np.zeros_like(difference)

    def blurred(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), width))

    for _ in range(FIELD_ROUNDS):
        robust = weight / (1 + ((difference - found) / (2 * scale)) ** 2)
        found = blurred(robust * difference) / (blurred(robust) + FIELD_PRIOR / spread**2)
    return found
