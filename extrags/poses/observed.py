"""What held-out frames have observed surface of, once training frames have left for want of a pose."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from extrags.observed_surface import observed_by_those_left as of_those_left
from extrags.sequence import EndoscopicSequence

__all__ = ["observed_by_those_left"]


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
    return of_those_left(sequence, left, stage="poses")
