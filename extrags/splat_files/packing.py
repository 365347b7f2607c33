"""How the compressed formats pack numbers and rotations, and in which order they store Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt32

from extrags.gaussians import Gaussians

__all__ = [
    "SCALE_LIMIT",
    "largest_component",
    "levels",
    "morton_order",
    "neighbours_together",
    "unit_quaternions",
]

SCALE_LIMIT = 20.0
"""Of logarithms of scales: one stray must not take the range that all of its chunk or codebook share."""
_MORTON_BITS = 20


def levels(shares: Float[np.ndarray, "*shape"], bits: int) -> UInt32[np.ndarray, "*shape"]:
    """Numbers in [0, 1] as whole numbers of so many bits; for others the nearer end."""
    largest = (1 << bits) - 1
    return np.asarray(np.rint(shares * largest).clip(0, largest).astype(np.uint32))


def unit_quaternions(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Rotations (w, x, y, z) of length one, float64; one of length zero is rendered as none, and is none."""
    given = quats.astype(np.float64)
    length = np.linalg.norm(given, axis=1, keepdims=True)
    return np.where(length > 0, given / np.maximum(length, 1e-300), [1.0, 0.0, 0.0, 0.0])


def largest_component(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Rotations as three numbers: the component of largest magnitude follows from the others.

    Args:
        quats: of length one, in any order of components.

    Returns:
        Which component is left out, [N], and the others in their order, in [-sqrt(1/2), sqrt(1/2)], [N, 3],
        with the sign that makes the one left out positive.
    """
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signed = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(signed, others, axis=1)


def morton_order(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Order along a space-filling curve: neighbours in space become neighbours in the file."""
    if not len(means):
        return np.zeros(0, dtype=np.int64)
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    share = (means.astype(np.float64) - low) / np.maximum(high - low, 1e-30)
    cell = (share * ((1 << _MORTON_BITS) - 1)).astype(np.uint64)
    code = np.zeros(len(means), dtype=np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def neighbours_together(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians in Morton order; on the processor."""
    return gaussians.subset(torch.from_numpy(morton_order(gaussians.means.numpy())))
