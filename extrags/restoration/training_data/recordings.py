"""Recordings to pretrain on: a posed sequence whose held-out frames are clips of views to restore."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.sequence import EndoscopicSequence

__all__ = ["PretrainingRecording"]


@dataclass(frozen=True)
class PretrainingRecording:
    """A recording and its clips.

    Args:
        sequence: training frames as a camera shows them; the held-out frames are the views to restore,
            without noise and at the mean exposure. Poses and depth are exact.
        clip: which clip each held-out frame belongs to, in the order of `sequence.test`; the views of a
            clip follow each other.
        kind: what was recorded.
        z_depth_mm: the true z-depth of any view of what was recorded, at pixel centres; infinite where a ray
            meets nothing.

    Raises:
        ShapeError: when there is not one clip number for each held-out frame.
    """

    sequence: EndoscopicSequence
    clip: Int[np.ndarray, "t"]
    kind: str
    z_depth_mm: Callable[[Cameras], Float[np.ndarray, "h w"]]

    def __post_init__(self) -> None:
        if len(self.clip) != len(self.sequence.test):
            raise ShapeError(
                f"{self.sequence.name}: {len(self.clip)} clip numbers for {len(self.sequence.test)} views"
            )
