"""Footage of both cameras of a stereo endoscope: that of one is read.

It lies in two files of one folder, which are called after the left and the right camera, or in one file whose
pictures hold both views (`data_catalog.stereo` says how they are told). Some of the first frames of the part
that is read have to agree.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from data_catalog.footage import Footage, FootageFrame, TimeSpan
from data_catalog.stereo import AGREES, BothViews, agreeing_share, possible_views, tell_camera
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError

__all__ = ["OneCamera", "of_one_camera", "of_two_files", "time_span"]

_LOOKED_AT = range(0, 128, 16)
"""Frames of the part that is read; those that show nothing yet do not count."""
_COUNTS_ALIKE = 0.02


class OneCamera:
    """Footage of one camera of a stereo endoscope, as `data_catalog.footage.Footage`.

    Args:
        footage: that holds it.
        views: where it lies in each picture; None for the whole of it.
    """

    def __init__(self, footage: Footage, views: BothViews | None = None) -> None:
        self._footage = footage
        self._views = views

    @property
    def file(self) -> Path:
        """Named in messages."""
        return self._footage.file

    @property
    def announced(self) -> int:
        """Number of frames according to the header; 0 where it does not say."""
        return self._footage.announced

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of an upright view in pixels."""
        size = self._footage.size
        return size if self._views is None else self._views.size(*size)

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height, of upright views."""
        aspect = self._footage.pixel_aspect
        return aspect if self._views is None else aspect * self._views.pixel_aspect(*self._footage.size)

    def counted_until(self, end_s: float) -> int:
        """About how many pictures are shown before a moment, by the header; 0 where it does not say."""
        return self._footage.counted_until(end_s)

    def frames(self, span: TimeSpan, numbers: Collection[int] | None = None) -> Iterator[FootageFrame]:
        """Decode from the beginning, the view of one camera alone.

        Args:
            span: frames outside are not given.
            numbers: of the frames to give; None gives all.

        Yields:
            Frames in order.

        Raises:
            SourceError: as of the footage that holds them.
        """
        for frame in self._footage.frames(span, numbers):
            rgb = frame.rgb if self._views is None else np.ascontiguousarray(self._views.view(frame.rgb))
            yield FootageFrame(frame.number, frame.time_s, rgb)


def time_span(config: IngestConfig) -> TimeSpan:
    """The part of a footage that the settings ask for.

    Raises:
        ConfigError: it ends before it begins.
    """
    if config.end_s is not None and config.end_s <= config.start_s:
        raise ConfigError(f"ingest.end_s = {config.end_s:g} is not after ingest.start_s = {config.start_s:g}")
    return TimeSpan(config.start_s, np.inf if config.end_s is None else config.end_s)


def of_one_camera(footage: Footage, config: IngestConfig) -> Footage:
    """The view of one camera, where pictures hold those of both; the footage itself where they do not.

    Args:
        footage: as it lies on disk.
        config: the camera, and the part.
    """
    if isinstance(footage, OneCamera) or not all(footage.size):
        return footage
    views = possible_views(footage.file.stem, *footage.size, config.stereo_camera)
    if views is None:
        return footage
    share = agreeing_share(views.both(_some_pictures(footage, time_span(config))))
    return OneCamera(footage, views) if views.is_told(footage.file, share) else footage


def of_two_files(footage: Footage, other: Footage, config: IngestConfig) -> Footage:
    """The footage of one camera, whose file lies beside that of the other.

    Args:
        footage: of the camera that is read.
        other: of the other one.
        config: the camera, and the part.

    Raises:
        SourceError: the two differ in size or length, or do not show the same: they are two recordings.
    """
    problem = ""
    if footage.size != other.size:
        problem = f"{_in_pixels(footage)} and {_in_pixels(other)} pixels"
    elif abs(footage.announced - other.announced) > max(2, _COUNTS_ALIKE * footage.announced):
        problem = f"{footage.announced} and {other.announced} frames"
    else:
        span = time_span(config)
        share = agreeing_share(zip(_some_pictures(footage, span), _some_pictures(other, span), strict=False))
        if share < AGREES:
            problem = f"{share:.0%} of the frames that were looked at show the same place"
    if problem:
        raise SourceError(
            f"{footage.file.name} and {other.file.name} are by their names of both cameras of a stereo "
            f"endoscope, but they do not agree: {problem}; give the path of the one to read",
            file=footage.file.parent,
        )
    told = "told by the names of the files"
    tell_camera(footage.file.parent, told, config.stereo_camera, footage.file.name)
    return OneCamera(footage)


def _in_pixels(footage: Footage) -> str:
    return "{} x {}".format(*footage.size)


def _some_pictures(footage: Footage, span: TimeSpan) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for frame in islice(footage.frames(span), _LOOKED_AT.start, _LOOKED_AT.stop, _LOOKED_AT.step):
        yield frame.rgb
