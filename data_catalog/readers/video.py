"""Reader of a video file: picks frames by motion and sharpness, masks what is not tissue; poses come later.

A file with one of `VIDEO_SUFFIXES`, or a folder that holds one such file and fewer than four images, which a
warning names (with more images in `images/` or `rgb/` it is refused). Of a stereo endoscope the frames of one
camera are read (`data_catalog.readers.stereo_footage`). Beside the file, both optional: `intrinsics.json` and
`mask.png`, as in `data_catalog.readers.frames_folder`; without the first a field of view of 90 degrees is
assumed and said so until the poses stage estimates it, without the second the picture's outline and burnt-in
text are found. How frames are chosen: `data_catalog.readers.footage_frames`.

Frames are decoded by FFmpeg through PyAV: upright (turned and mirrored as the file says), 8 bit a channel
whatever the depth of the file, at the timestamps of the container, which may be uneven. Where these go back,
or jump by more than an hour, as where recordings were joined byte by byte, times count on. Pixels that are
not square (standard definition) stay as they are; the intrinsics say so. Colours of a file that does not name
its matrix are BT.709 in high definition and BT.601 otherwise, as in players. OpenCV's own FFmpeg would not
do: of every video whose header says that it is interlaced, OpenCV 5.0 gives empty pictures, without an error.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from data_catalog.folder_reader import FolderReader
from data_catalog.footage import VIDEO_SUFFIXES, Footage, FootageFrame, TimeSpan, files_of_kind
from data_catalog.images import image_entries
from data_catalog.posed_frames import SourceFrames
from data_catalog.readers.beside_frames import listed_files, tell_what_is_not_read
from data_catalog.readers.footage_frames import footage_frames, footage_outline
from data_catalog.readers.frames_folder import (
    FEWEST_FRAMES,
    INTRINSICS_FILE,
    MASK_FILE,
    is_mask,
    places_with_frames,
)
from data_catalog.readers.stereo_footage import of_two_files
from data_catalog.readers.video_header import Orientation, duration_of_pictures_s
from data_catalog.stereo import pairs_by_name
from extrags.array_files import MOST_PIXELS, TOO_MANY_PIXELS
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError

__all__ = ["READER", "VideoFile", "files_meant", "footage_meant", "with_files_beside"]

logger = logging.getLogger(__name__)

_MIN_DECODED = 0.9
_USUAL_FRAMES_PER_S = 25.0
_COUNTS_WHAT_IS_HIDDEN = "mp4"
"""Of the containers, this family alone: it counts frames that an edit list leaves out, as those between the
last key frame and the beginning of a part that was cut out without coding it anew. Its durations are those of
what is shown, and of a header that a truncated file has whole or not at all."""
_TRANSPORT_STREAM, _ITS_PACKET_BYTES = "mpegts", 188
"""In this container each frame begins a packet of its own."""
_OUT_OF_ORDER_S = 0.5
"""Timestamps that go back by less are those of frames out of order, and not of another recording."""
_LONGEST_PAUSE_S = 3600.0
"""Timestamps that jump by more are those of another clock: where those of a transport stream go back, FFmpeg
takes them to have gone beyond their largest value, and adds 26.5 hours."""
_CAMERAS = 2
_UNSPECIFIED_COLOR = 2
"""What FFmpeg says of a matrix of colours that the file does not name."""
_HIGH_DEFINITION_PX = (1280, 577)
"""From so many columns, or rows, players take such a matrix for BT.709, below for BT.601."""


class VideoFile:
    """A video as `data_catalog.footage.Footage`.

    Args:
        file: in any format that FFmpeg knows.
        named: the file that messages name, and beside which others are looked for; None for `file`.

    Raises:
        SourceNotFoundError: no such file.
        SourceError: no video.
    """

    def __init__(self, file: Path, *, named: Path | None = None) -> None:
        self._stream = file
        self._file = named or file
        self._is_break_told = False
        with _opened(self._stream, self._file) as (container, stream):
            others = [other for other in container.streams.video if other != stream and not _is_cover(other)]
            if others:
                logger.warning(
                    "%s: %d streams of pictures, as of two cameras; the first is read. To read another, "
                    "give it in a file of its own",
                    self._file,
                    1 + len(others),
                    extra={"topic": "not read", "field": "streams"},
                )
            self._frames_per_s = float(stream.average_rate or stream.guessed_rate or 0)
            self._start_s = float(stream.start_time * stream.time_base) if stream.start_time else 0.0
            # Where the container does not count its frames, what a steady rate would give.
            expected = duration_of_pictures_s(container, stream, self._start_s) * self._frames_per_s
            self._announced = stream.frames or round(expected)
            if _COUNTS_WHAT_IS_HIDDEN in container.format.name and stream.duration:
                shown_s = float(stream.duration * stream.time_base)
                self._announced = min(self._announced, round(shown_s * self._frames_per_s))
            if container.format.name == _TRANSPORT_STREAM:
                # Between joined recordings its duration may hold hours that nobody recorded.
                self._announced = min(self._announced, file.stat().st_size // _ITS_PACKET_BYTES)
            aspect = float(stream.sample_aspect_ratio or 1)
            _check_size(stream, self._file)
            first = next(_decoded(container, stream), None)
            self._orientation = Orientation() if first is None else Orientation.of_frame(first)
            stored = stream if first is None else first
            _check_size(stored, self._file)
            self._size = int(stored.width), int(stored.height)
        self._pixel_aspect = aspect
        if self._orientation.swaps_axes:
            self._pixel_aspect, self._size = 1 / aspect, (self._size[1], self._size[0])
        if self._orientation != Orientation():
            logger.info("%s: %s, as the file says", self._file.name, self._orientation)

    @property
    def file(self) -> Path:
        """Named in messages."""
        return self._file

    @property
    def announced(self) -> int:
        """Number of frames according to the header; 0 where it does not say."""
        return self._announced

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of an upright frame in pixels."""
        return self._size

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height, of upright frames."""
        return self._pixel_aspect

    def counted_until(self, end_s: float) -> int:
        """About how many frames are shown before a moment, at a steady rate; 0 where the header is silent."""
        rate = self._frames_per_s or _USUAL_FRAMES_PER_S
        return round(min(self._announced, max(0.0, end_s) * rate))

    def frames(self, span: TimeSpan, numbers: Collection[int] | None = None) -> Iterator[FootageFrame]:
        """Decode from the beginning: between key frames all are needed, so that jumping gains nothing.

        Args:
            span: frames outside are not given.
            numbers: of the frames to give; None gives all.

        Yields:
            Frames in order.

        Raises:
            SourceError: the video ends before its end.
        """
        last = None if numbers is None else max(numbers, default=-1)
        count, clock = 0, _Clock(self._start_s, self._frames_per_s or _USUAL_FRAMES_PER_S)
        with _opened(self._stream, self._file) as (container, stream):
            for frame in _decoded(container, stream):
                number, count = count, count + 1
                time_s = clock.time_s(number, frame.time)
                if clock.is_broken and not self._is_break_told:
                    self._is_break_told = True
                    logger.warning(
                        "%s: the timestamps of frame %d do not continue from those before, as where "
                        "recordings were joined; times (ingest.start_s, ingest.end_s) count on, frame by "
                        "frame",
                        self._file,
                        number,
                    )
                if time_s >= span.end_s or (last is not None and number > last):
                    return
                if time_s in span and (numbers is None or number in numbers):
                    rgb = self._orientation.upright(_colors(frame))
                    yield FootageFrame(number, time_s, np.ascontiguousarray(rgb))
        if numbers is None:
            self._check_whole(count, clock.farthest_s)

    def _check_whole(self, count: int, time_s: float) -> None:
        """Compare with the header, in frames and in seconds.

        Where the frame rate varies, the number of frames may be that of a steady rate.

        Args:
            count: of the frames that were decoded.
            time_s: the last of their timestamps, as the container has them.

        Raises:
            SourceError: too few, and too early.
        """
        if count == 0 or count >= _MIN_DECODED * self._announced:
            return
        step_s = 1 / self._frames_per_s if self._frames_per_s else 0.0
        # Not the container's duration: of some truncated files it is estimated from what is left.
        if step_s == 0 or time_s + step_s < _MIN_DECODED * self._announced * step_s:
            raise SourceError(
                f"{self._announced} frames announced, {count} decoded: the video is truncated or damaged",
                file=self._file,
                frame=count,
            )


class _Clock:
    """Times of frames that never fall, from timestamps of the container, which may.

    Args:
        start_s: timestamp of the beginning.
        frames_per_s: at which frames follow that have no timestamp, or one of another clock.
    """

    def __init__(self, start_s: float, frames_per_s: float) -> None:
        self._start_s = start_s
        self._frames_per_s = frames_per_s
        self._added_s = 0.0
        self._last_s: float | None = None
        self.is_broken = False
        """Whether timestamps of another clock were met."""
        self.farthest_s = 0.0
        """The last time, by timestamps as they are."""

    def time_s(self, number: int, told_s: float | None) -> float:
        """When the next frame is shown.

        Args:
            number: of the frame.
            told_s: its timestamp; where it has none, frames follow evenly.
        """
        plain_s = number / self._frames_per_s if told_s is None else told_s - self._start_s
        self.farthest_s = max(self.farthest_s, plain_s)
        time_s = plain_s + self._added_s
        if self._last_s is not None:
            if not -_OUT_OF_ORDER_S <= time_s - self._last_s <= _LONGEST_PAUSE_S:
                self.is_broken = True
                time_s = self._last_s + 1 / self._frames_per_s
                self._added_s = time_s - plain_s
            time_s = max(time_s, self._last_s)
        self._last_s = time_s
        return time_s


def files_meant(place: Path, suffixes: tuple[str, ...]) -> tuple[Path, ...]:
    """The file that a path means: itself, or the only one of its kind in a folder without frames.

    Args:
        place: a file or a folder.
        suffixes: of the kind, in small letters.

    Returns:
        Nothing where no file is meant; two files, where a folder holds those of a left and a right camera by
        their names, the left one first.
    """
    if place.is_file():
        return (place,) if place.suffix.lower() in suffixes else ()
    if not place.is_dir():
        return ()
    found = files_of_kind(place, suffixes)
    stills = [file for file in image_entries(place) if not is_mask(file)]
    if len(stills) >= FEWEST_FRAMES:
        return ()
    stereo = pairs_by_name(found) if len(found) == _CAMERAS else None
    if stereo is not None:
        return stereo.pairs[0]
    return tuple(found) if len(found) == 1 else ()


def _tell_about_stills(place: Path, file: Path) -> None:
    """Warn of the few pictures, and of poses, depth and masks, that lie beside a footage and are not read.

    Args:
        place: the folder that was given, or the footage itself, beside which nothing is looked for.
        file: the footage in it.

    Raises:
        SourceError: there are so many in a folder below that these may be the frames that are meant.
    """
    if place == file:
        return
    tell_what_is_not_read(place)
    for folder, stills in places_with_frames(place).items():
        if len(stills) >= FEWEST_FRAMES:
            raise SourceError(
                f"{file.name}, and {len(stills)} images in {folder.name}/; give the path of the one to read",
                file=place,
            )
        logger.warning(
            "%s: %s is read, and not the pictures beside it: %s", place, file.name, listed_files(stills)
        )


def with_files_beside(files: Sequence[Path]) -> list[Path]:
    """A footage, of one camera or of two, and what belongs to it, sorted."""
    if not files:
        return []
    beside = [files[0].parent / name for name in (INTRINSICS_FILE, MASK_FILE)]
    return sorted([*files, *(other for other in beside if other.is_file())])


def footage_meant(
    place: Path, files: Sequence[Path], opened: Callable[[Path], Footage], config: IngestConfig
) -> Footage:
    """What is read of a path: the only file, or of two cameras' files that of one.

    Args:
        place: that was given.
        files: of `files_meant`.
        opened: opens a file.
        config: the camera, and the part.

    Raises:
        SourceNotFoundError: there is no file.
        SourceError: of two files, that do not agree.
    """
    if not files:
        raise SourceNotFoundError("no video or DICOM file here", file=place)
    file = files[0] if config.stereo_camera == "left" else files[-1]
    _tell_about_stills(place, file)
    footage = opened(file)
    if len(files) == 1:
        return footage
    return of_two_files(footage, opened(next(other for other in files if other != file)), config)


def _recognises(place: Path) -> bool:
    return bool(files_meant(place, VIDEO_SUFFIXES))


def _files(place: Path) -> list[Path]:
    return with_files_beside(files_meant(place, VIDEO_SUFFIXES))


def _frames(place: Path, config: IngestConfig) -> SourceFrames:
    return footage_frames(_footage(place, config), config)


def _outline(place: Path, config: IngestConfig) -> SourceFrames:
    return footage_outline(_footage(place, config), config)


def _footage(place: Path, config: IngestConfig) -> Footage:
    return footage_meant(place, files_meant(place, VIDEO_SUFFIXES), VideoFile, config)


READER = FolderReader(
    name="video",
    version=10,
    summary="a video file (mp4, avi, mov, mkv, ...), optionally with intrinsics.json and mask.png beside it",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    outline=_outline,
    is_footage=True,
    conventions="no poses and no depth; the poses stage finds them, in an arbitrary unit",
)


@contextmanager
def _opened(file: Path, named: Path) -> Iterator[tuple[Any, Any]]:
    """A container and the first stream of pictures in it."""
    import av

    if not file.is_file():
        raise SourceNotFoundError("no such file", file=named)
    problem = f"cannot be opened as a video ({file.stat().st_size} bytes); is it whole?"
    try:
        container = av.open(str(file))
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        # Metadata that are no text fail in the binding.
        raise SourceError(problem, file=named) from error
    with container:
        # A cover is a stream of a single picture.
        moving = [stream for stream in container.streams.video if not _is_cover(stream)]
        if not moving:
            raise SourceError("no stream of pictures in it, only sound?", file=named)
        stream = moving[0]
        stream.thread_type = "AUTO"
        yield container, stream


def _check_size(pictures: Any, file: Path) -> None:
    """Refuse a stream, or a frame of it, that would fill the memory: FFmpeg takes any size it can address."""
    if pictures.width * pictures.height > MOST_PIXELS:
        raise SourceError(
            f"frames of {pictures.width} x {pictures.height} pixels, {TOO_MANY_PIXELS}", file=file
        )


def _is_cover(stream: Any) -> bool:
    from av.stream import Disposition

    return bool(stream.disposition & Disposition.attached_pic)


def _colors(frame: Any) -> UInt8[np.ndarray, "h w 3"]:
    """A decoded frame as RGB, by the matrix that the file names, else by the one that players take."""
    from av.video.reformatter import Colorspace, Interpolation

    large = frame.width >= _HIGH_DEFINITION_PX[0] or frame.height >= _HIGH_DEFINITION_PX[1]
    guessed = Colorspace.ITU709 if large and frame.colorspace == _UNSPECIFIED_COLOR else None
    # Of most sizes FFmpeg otherwise takes tables that round down and repeat each chrominance twice, and what
    # they give is up to 1.5/255 too dark on average, of 10 bits 2/255. Rounding without interpolating
    # chrominance makes it worse.
    exact = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
    found = frame.reformat(format="rgb24", src_colorspace=guessed, interpolation=exact)
    return np.asarray(found.to_ndarray())


def _decoded(container: Any, stream: Any) -> Iterator[Any]:
    """Frames one after another; what is damaged is passed over, as players do."""
    from av.error import FFmpegError

    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, FFmpegError):
            return
        try:
            frames = packet.decode()
        except FFmpegError:
            continue
        yield from frames
