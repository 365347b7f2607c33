"""What a video tells of itself beside its pictures: how long they are shown, and which way up."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

__all__ = ["Orientation", "duration_of_pictures_s"]

_DURATION_TAG = re.compile(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)")
_NO_TIME = ("attachment",)
"""Kinds of streams that are not played."""


def duration_of_pictures_s(container: Any, stream: Any, start_s: float) -> float:
    """For how long the pictures of a video are shown according to its header, in seconds.

    Where a container has one duration for all of its streams, this may be that of its sound.

    Args:
        container: opened by PyAV.
        stream: of pictures in it.
        start_s: timestamp of the stream's beginning.

    Returns:
        Seconds from the first picture on, or fewer: some durations hold the time before it, which is not
        taken off twice. 0 where nothing tells.
    """
    if stream.duration:
        return max(0.0, float(stream.duration * stream.time_base))
    # Of Matroska, whose durations count from 0 on. Programs that cut a file may leave the tags of the whole.
    told = [_seconds(value) for name, value in stream.metadata.items() if _is_duration(name)]
    ends_s = [end_s for end_s in told if end_s is not None]
    is_alone = not any(
        other.type not in _NO_TIME for other in container.streams if other.index != stream.index
    )
    if container.duration and (ends_s or is_alone):
        ends_s.append(container.duration / 1e6)
    return max(0.0, min(ends_s) - start_s) if ends_s else 0.0


def _is_duration(name: str) -> bool:
    # Of a program that names the language of what it writes: DURATION-eng.
    return name.upper().partition("-")[0] == "DURATION"


def _seconds(value: str) -> float | None:
    found = _DURATION_TAG.fullmatch(value.strip())
    if found is None:
        return None
    hours, minutes, seconds = found.groups()
    return 3600 * int(hours) + 60 * int(minutes) + float(seconds)


@dataclass(frozen=True)
class Orientation:
    """How stored pictures are turned and mirrored to stand upright, as players do.

    Args:
        swaps_axes: whether rows become columns, before anything else.
        mirrors_columns: whether the picture is mirrored left to right.
        mirrors_rows: whether it is mirrored top to bottom.
    """

    swaps_axes: bool = False
    mirrors_columns: bool = False
    mirrors_rows: bool = False

    @classmethod
    def of_frame(cls, frame: Any) -> Orientation:
        """What the display matrix of a decoded frame asks for, to the nearest quarter turn.

        A pixel at (x, y) is shown at (a x + c y, b x + d y), from its first entries a, b and its fourth and
        fifth, c, d.
        """
        matrix = next((bytes(data) for data in frame.side_data if data.type.name == "DISPLAYMATRIX"), None)
        if matrix is None:
            return cls()
        a, b, _, c, d = np.frombuffer(matrix, dtype=np.int32)[:5].astype(float).tolist()
        if abs(b) + abs(c) > abs(a) + abs(d):
            return cls(True, c < 0, b < 0)
        return cls(False, a < 0, d < 0)

    @property
    def is_mirror_image(self) -> bool:
        """Whether left and right hands change places, which no turning does."""
        return (self.swaps_axes + self.mirrors_columns + self.mirrors_rows) % 2 == 1

    def upright(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """A stored picture as it is shown."""
        shown = image.swapaxes(0, 1) if self.swaps_axes else image
        shown = shown[:, ::-1] if self.mirrors_columns else shown
        return shown[::-1] if self.mirrors_rows else shown

    def __str__(self) -> str:
        if self.is_mirror_image:
            sides = "left and right" if self.mirrors_columns else "top and bottom"
            return "mirrored, with rows as columns" if self.swaps_axes else f"mirrored, {sides} exchanged"
        clockwise_deg = 90 if self.mirrors_columns else 270
        return f"turned by {clockwise_deg if self.swaps_axes else 180} degrees"
