"""Which points of estimated depth are worth starting from: those of which no other frame knows better."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.sequence import EndoscopicSequence

__all__ = ["surest_points"]

SURER_FACTOR = 1.5
"""A point is left out where another frame that sees its place expects an error so many times smaller."""

HIDDEN_ERRORS = 3.0
"""A point farther behind what a frame sees, in expected errors of both together, is hidden from it."""


def surest_points(
    points: Float[np.ndarray, "n 3"],
    error: Float[np.ndarray, "n"],
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
) -> Bool[np.ndarray, "n"]:
    """Points of frames' estimated depth of whose place no other frame knows much better.

    Frames see the same surface from near and from far, and are wrong about it in different ways. Together
    their points fill a shell around it, and thinned out in voxels, most of what is left are the few that lie
    far off, each in a voxel of its own. So a point is left out where a frame that expects less than
    `1 / SURER_FACTOR` of its error has the same surface there, or looks through the point. What all much
    surer frames have hidden or outside their images stays, however unsure it is.

    Args:
        points: back-projected pixels of the frames, in world units.
        error: expected error of the depth of each, in world units.
        sequence: posed frames with estimated depth.
        frames: those that may be looked at.

    Returns:
        False for points to leave out; the surest of all is never among them.
    """
    assert sequence.depth_mm is not None
    assert sequence.depth_error is not None
    least = np.array(error)
    for frame in frames.tolist():
        (pixels,), (z,) = sequence.cameras[frame].project(points)
        inside = np.flatnonzero(sequence.cameras.contains(pixels))
        column, row = pixels[inside].astype(np.int64).T
        depth = np.where(sequence.mask[frame], sequence.depth_mm[frame], 0)[row, column].astype(np.float64)
        own = sequence.depth_error[frame][row, column] * depth
        hidden = z[inside] - depth > HIDDEN_ERRORS * np.hypot(own, error[inside])
        speaks = (depth > 0) & ~hidden
        least[inside[speaks]] = np.minimum(least[inside[speaks]], own[speaks])
    return np.asarray(error <= SURER_FACTOR * least)
