"""Recordings that are decoded frame by frame: what readers of moving pictures hand over."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

__all__ = ["Footage", "FootageFrame", "TimeSpan"]


@dataclass(frozen=True, eq=False)
class FootageFrame:
    """One decoded frame.

    Args:
        number: in the file, from 0.
        time_s: when it is shown, by the file's own timestamps; they may be uneven.
        rgb: upright, [h, w, 3].
    """

    number: int
    time_s: float
    rgb: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class TimeSpan:
    """A part of a recording.

    Args:
        start_s: its first moment.
        end_s: the first moment after it.
    """

    start_s: float = 0.0
    end_s: float = math.inf

    def __contains__(self, time_s: float) -> bool:
        """Whether a moment lies inside."""
        return self.start_s <= time_s < self.end_s


@runtime_checkable
class Footage(Protocol):
    """A file of moving pictures, decoded frame by frame: a long one does not fit into memory."""

    @property
    def file(self) -> Path:
        """Named in messages."""

    @property
    def announced(self) -> int:
        """Number of frames according to the file's header; 0 where it does not say."""

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height, of upright frames."""

    def frames(self, span: TimeSpan, numbers: Collection[int] | None = None) -> Iterator[FootageFrame]:
        """Decode from the beginning.

        Args:
            span: frames outside are not given.
            numbers: of the frames to give; None gives all.

        Yields:
            Frames in the order in which they are shown; no reference to them is kept.

        Raises:
            SourceError: nothing can be decoded, or less than the header announces.
        """
