"""Estimated depth as part of a sequence: training frames alone ever have it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from extrags.depth.estimate import DepthEstimate, with_estimated_depth
from extrags.errors import ShapeError
from extrags.frame_stacks import empty_stack
from extrags.sequence import EndoscopicSequence

__all__ = ["with_training_depth"]


def with_training_depth(sequence: EndoscopicSequence, estimate: DepthEstimate) -> EndoscopicSequence:
    """A sequence with the estimated depth of its training frames, and the points it started from.

    Held-out frames get no depth, and lose what the evaluation alone may know of theirs: what is estimated
    and what is measured never stand side by side. Later stages are given the training part of a sequence;
    the whole of one is what the oracle trains on.

    Args:
        sequence: its training part, or all frames.
        estimate: the depth of its training frames, in order.

    Raises:
        ShapeError: when there are not as many depth maps as training frames.
    """
    train = sequence.train
    if len(estimate.depth) != len(train):
        raise ShapeError(
            f"{sequence.name}: {len(estimate.depth)} depth maps for {len(train)} training frames"
        )
    shape = sequence.rgb.shape[:3]
    depth, error = empty_stack(shape, np.float32), empty_stack(shape, np.float32)
    for position, frame in enumerate(train):
        depth[frame], error[frame] = estimate.depth[position], estimate.expected_error[position]
    return with_estimated_depth(sequence, replace(estimate, depth=depth, expected_error=error))
