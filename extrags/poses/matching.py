"""Mutual nearest neighbours among SIFT features, exact, and the same bits for any number of threads.

COLMAP's own matcher on a processor asks an approximate index (clusters found by k-means, of which it searches
some) wherever an image has 512 features or more. Of two runs on a busy machine the index may differ, and
misses up to half a percent of the matches; its exact alternative takes ten times as long.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

__all__ = ["MAX_ANGLE", "MAX_RATIO", "mutual_matches"]

MAX_RATIO = 0.8
"""A nearest neighbour counts when its angle is so much smaller than the second nearest's (Lowe: Distinctive
image features from scale-invariant keypoints, IJCV 2004, section 7.1); COLMAP's value."""
MAX_ANGLE = 0.7
"""Radians between two descriptors above which they do not match; COLMAP's value."""
UNIT = 512.0
"""Length of a descriptor of COLMAP's, in units of its bytes."""
_ROWS_AT_ONCE = 512


def mutual_matches(
    first: UInt8[np.ndarray, "n 128"], second: UInt8[np.ndarray, "m 128"]
) -> Int[np.ndarray, "k 2"]:
    """Pairs of features that are each other's nearest, and clearly so in both directions.

    Products of descriptors are sums of integers below 2^24, which float32 holds exactly: the order in which
    they are added, and so the number of threads, changes nothing.

    Args:
        first: descriptors of one image, in COLMAP's bytes.
        second: those of the other.

    Returns:
        Indices into both, by rising index of the first.
    """
    if len(first) == 0 or len(second) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    one, two = first.astype(np.float32), second.astype(np.float32)
    there = _nearest(one, two)
    found = np.flatnonzero(there >= 0)
    # The way back is asked of those alone that were found: often a few in a hundred.
    found = found[_nearest(two[there[found]], one) == found]
    return np.stack([found, there[found]], axis=1)


def _nearest(of: Float[np.ndarray, "n 128"], among: Float[np.ndarray, "m 128"]) -> Int[np.ndarray, "n"]:
    """Index of each feature's nearest; -1 where it is too far, or the second nearest too near."""
    nearest = np.full(len(of), -1, dtype=np.int64)
    for start in range(0, len(of), _ROWS_AT_ONCE):
        products = of[start : start + _ROWS_AT_ONCE] @ among.T
        rows = np.arange(len(products))
        index = products.argmax(axis=1)
        best = products[rows, index]
        # Where there is no other, it counts as being at a right angle.
        products[rows, index] = 0
        angle, next_angle = _angle(best), _angle(products.max(axis=1))
        clear = (angle <= MAX_ANGLE) & (angle < MAX_RATIO * next_angle)
        nearest[start : start + len(products)][clear] = index[clear]
    return nearest


def _angle(products: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.arccos(np.minimum(products.astype(np.float64) / UNIT**2, 1.0)))
