"""What held-out frames have observed surface of, once training frames have left for want of a pose."""

from __future__ import annotations

import logging

import numpy as np
from jaxtyping import Bool

from extrags.observed_surface import observed_from_depth
from extrags.sequence import EndoscopicSequence

__all__ = ["observed_by_those_left"]

_LOG = logging.getLogger(__name__)


def observed_by_those_left(
    sequence: EndoscopicSequence, registered: Bool[np.ndarray, "f"]
) -> Bool[np.ndarray, "f h w"] | None:
    """What is observed in held-out frames once training frames without a pose have left.

    By true depth and the source's own poses; what no training frame saw before stays unobserved. Where these
    are not known nothing tells what the others saw, and nothing is said.

    Args:
        sequence: as it came.
        registered: true for frames that stay, [F].

    Returns:
        True where observed, [F, H, W]; None where nothing tells.
    """
    left = sequence.train[registered[sequence.train]]
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
    seen = observed_from_depth(sequence.cameras, sequence.mask, depth, left, sequence.test, stage="poses")
    return np.asarray(seen & sequence.observed)
