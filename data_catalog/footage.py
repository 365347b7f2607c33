"""Recordings that are decoded frame by frame: what readers of moving pictures hand over."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from extrags.frame_names import natural_key

__all__ = ["DICOM_SUFFIXES", "VIDEO_SUFFIXES", "Footage", "FootageFrame", "TimeSpan", "files_of_kind"]

DICOM_SUFFIXES = (".dcm", ".dicom")
VIDEO_SUFFIXES = (
    *(".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".wmv", ".mxf", ".y4m"),
    # Transport streams and discs of recorders, and what telephones and older programs write.
    *(".ts", ".m2ts", ".mts", ".m2t", ".vob", ".m2v", ".3gp", ".3g2", ".asf", ".flv", ".ogv"),
)


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
    def size(self) -> tuple[int, int]:
        """Width and height of an upright frame in pixels."""

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height, of upright frames."""

    def counted_until(self, end_s: float) -> int:
        """About how many frames are shown before a moment, by the header alone; 0 where it does not say.

        Args:
            end_s: the moment, in the recording's own time.
        """

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


def files_of_kind(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files with one of the suffixes directly in a folder, in natural order; hidden ones are none.

    Args:
        folder: that may hold them.
        suffixes: of the kind, in small letters.
    """
    found = [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in suffixes and not file.name.startswith(".") and file.is_file()
    ]
    return sorted(found, key=lambda file: natural_key(file.name))
