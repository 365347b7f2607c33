"""Depth that so few training frames have that estimating it for all of them is better."""

from __future__ import annotations

import logging
from dataclasses import replace

from extrags.sequence import EndoscopicSequence

__all__ = ["LEAST_SHARE", "without_scarce_depth"]

LEAST_SHARE = 0.5
"""Of the training frames. Where one in four has depth, a reconstruction starts on a fragment of the surface
and reaches less than with estimated depth alone (docs/algorithms/depth.md)."""

_log = logging.getLogger(__name__)


def without_scarce_depth(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The sequence, without the depth of its training frames where less than half of them have any.

    The depth stage then estimates that of all; the evaluation still compares with what was given. A single
    training frame keeps its depth: nothing could be estimated.

    Args:
        sequence: in the unit of its poses; before poses are known, few depths tell their scale.
    """
    if sequence.depth_mm is None or len(sequence.train) < 2:
        return sequence
    count = sum(bool((sequence.depth_mm[frame] > 0).any()) for frame in sequence.train)
    if count == 0 or count >= LEAST_SHARE * len(sequence.train):
        return sequence
    _log.warning(
        "%s: %d of %d training frames have depth, too few to start from: depth is estimated for all of them, "
        "and what was given serves the evaluation alone. Depth of half of them or more is used",
        sequence.name,
        count,
        len(sequence.train),
    )
    hidden = sequence.without_training_depth()
    return replace(hidden, points=sequence.points, points_rgb=sequence.points_rgb)
