"""Reader of a DICOM multi-frame file: read like a video; poses come later.

A file with one of `DICOM_SUFFIXES`, a file without suffix that begins as DICOM files do, or a folder that
holds one such file and hardly any images, as with videos. Needs pydicom, which the extra `dicom` brings.
Beside the file, both optional: `intrinsics.json` and `mask.png`, as in `data_catalog.readers.frames_folder`.
How frames are chosen and what is masked: `data_catalog.readers.footage_frames`.

Read are uncompressed and JPEG-compressed pixels (whatever pydicom decodes with Pillow), and the streams of
MPEG-2, MPEG-4 and HEVC that video endoscopes store, which go to the reader of videos. Colours: RGB, YBR_FULL,
YBR_FULL_422, YBR_RCT and YBR_ICT (both of JPEG 2000), MONOCHROME2; of more than 8 bits the highest 8.
Timestamps: Frame Time Vector, Frame Time, Cine Rate or Recommended Display Frame Rate. Without any, and with
a vector that has not one entry for each frame, a warning says what is assumed: 25 frames a second where
nothing else tells. Pixels that are not square stay as they are; the intrinsics say so.

Nothing of a file but its pixels, their format and their timing is looked at: names and dates of patients stay
where they are. What is burnt into the picture is masked as in a video, not removed.

Format: DICOM PS3.3 (C.7.6.3, C.7.6.5) and PS3.5 (annex A).
"""

from __future__ import annotations

import logging
import struct
import tempfile
import weakref
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from data_catalog.folder_reader import FolderReader
from data_catalog.footage import DICOM_SUFFIXES, Footage, FootageFrame, TimeSpan
from data_catalog.posed_frames import SourceFrames
from data_catalog.readers.footage_frames import footage_frames, footage_outline
from data_catalog.readers.video import VideoFile, files_meant, footage_meant, with_files_beside
from extrags.array_files import MOST_PIXELS, TOO_MANY_PIXELS
from extrags.config import IngestConfig
from extrags.errors import (
    ExtragsError,
    MissingDependencyError,
    SourceError,
    SourceNotFoundError,
    installed_with,
    reason_of,
)

__all__ = ["READER", "DicomFile", "open_dicom"]

logger = logging.getLogger(__name__)

_MAGIC_AT, _MAGIC = 128, b"DICM"
_LOOKED_AT = (
    "Rows",
    "Columns",
    "NumberOfFrames",
    "PhotometricInterpretation",
    "PixelRepresentation",
    "BitsStored",
    "PixelAspectRatio",
    "FrameTimeVector",
    "FrameTime",
    "CineRate",
    "RecommendedDisplayFrameRate",
)
_COLORS = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_RCT", "YBR_ICT", "MONOCHROME2")
"""Those of JPEG 2000, RCT and ICT, become RGB where it is decoded."""
_USUAL_FRAMES_PER_S = 25.0
_PIXEL_ELEMENT_BYTES = 12
"""Tag, representation and length of the pixel data, in all compressed syntaxes."""


class DicomFile:
    """Frames of a DICOM file, each compressed on its own or not at all, as `data_catalog.footage.Footage`.

    Args:
        file: a multi-frame file.
        header: its elements before the pixels.

    Raises:
        SourceError: one frame only, or colours that are not understood.
    """

    def __init__(self, file: Path, header: Any) -> None:
        self._file = file
        self._announced = int(header.get("NumberOfFrames") or 1)
        if self._announced > file.stat().st_size:
            raise SourceError(
                f"{self._announced} frames announced, in {file.stat().st_size} bytes: the file is damaged",
                file=file,
                field="NumberOfFrames",
            )
        if self._announced < 2:
            raise SourceError(
                "a single frame; expected a multi-frame file. A series of such files is read as a folder of "
                "pictures (PNG, TIFF, ...), one of each",
                file=file,
                field="NumberOfFrames",
            )
        colors = str(header.get("PhotometricInterpretation"))
        if colors not in _COLORS:
            raise SourceError(
                f"{colors} is not understood; expected one of {', '.join(_COLORS)}",
                file=file,
                field="PhotometricInterpretation",
            )
        if header.get("PixelRepresentation"):
            raise SourceError(
                "signed values are no colours; expected 0", file=file, field="PixelRepresentation"
            )
        self._is_compressed = bool(header.file_meta.TransferSyntaxUID.is_encapsulated)
        self._surplus_bits = max(0, int(header.get("BitsStored") or 8) - 8)
        self._times_s: list[float] = _times_s(header, self._announced, file).tolist()
        self._pixel_aspect = _pixel_aspect(header)
        self._size = int(header.Columns), int(header.Rows)
        self._check_size()

    @property
    def file(self) -> Path:
        """Named in messages."""
        return self._file

    @property
    def announced(self) -> int:
        """Number of frames according to the header."""
        return self._announced

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame in pixels."""
        return self._size

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height."""
        return self._pixel_aspect

    def counted_until(self, end_s: float) -> int:
        """How many frames are shown before a moment."""
        return bisect_left(self._times_s, end_s)

    def frames(self, span: TimeSpan, numbers: Collection[int] | None = None) -> Iterator[FootageFrame]:
        """Decode from the beginning; frames that are not asked for are passed over.

        Args:
            span: frames outside are not given.
            numbers: of the frames to give; None gives all.

        Yields:
            Frames in order.

        Raises:
            SourceError: damaged, or a compression that pydicom does not decode.
        """
        wanted = [
            number
            for number in range(self._announced)
            if self._times_s[number] in span and (numbers is None or number in numbers)
        ]
        decoded = self._compressed(wanted, numbers is None) if self._is_compressed else self._plain(wanted)
        for number in wanted:
            with _dicom_errors(self._file, number):
                pixels = next(decoded, None)
            if pixels is None:
                raise SourceError(
                    f"{self._announced} frames announced, {number} there: the file is truncated",
                    file=self._file,
                    frame=number,
                )
            yield FootageFrame(number, self._times_s[number], self._rgb(pixels))

    def _check_size(self) -> None:
        """Refuse what the file cannot hold, and what would fill the memory, before anything is decoded."""
        (columns, rows), there = self._size, self._file.stat().st_size
        if columns * rows > MOST_PIXELS:
            raise SourceError(
                f"frames of {columns} x {rows} pixels, {TOO_MANY_PIXELS}", file=self._file, field="Rows"
            )
        # A pixel takes a bit at least.
        if not self._is_compressed and columns * rows > 8 * there:
            raise SourceError(
                f"frames of {columns} x {rows} pixels, not compressed, in {there} bytes: the file is damaged "
                "or truncated",
                file=self._file,
                field="Rows",
            )

    def _plain(self, wanted: Sequence[int]) -> Iterator[np.ndarray]:
        from pydicom.pixels.utils import pixel_array

        # pydicom 3.0's iterator misreads YBR_FULL_422 from the second frame on: having converted the first,
        # it takes the rest for RGB, which is longer. Each frame lies at a known place, so nothing is lost.
        yield from (pixel_array(self._file, index=number) for number in wanted)

    def _compressed(self, wanted: Sequence[int], one_after_another: bool) -> Iterator[np.ndarray]:
        from pydicom.pixels.utils import iter_pixels

        if not wanted:
            return
        if one_after_another:
            # Given indices, each frame is looked for from the beginning of the file.
            yield from islice(iter_pixels(self._file), wanted[0], wanted[-1] + 1)
        else:
            yield from iter_pixels(self._file, indices=wanted)

    def _rgb(self, pixels: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
        eight_bit = (pixels >> self._surplus_bits).astype(np.uint8)
        return eight_bit if eight_bit.ndim == 3 else np.repeat(eight_bit[..., None], 3, axis=2)


class _DicomVideo(VideoFile):
    """A video stream inside a DICOM file. FFmpeg reads files only, so the stream is copied to one."""

    def __init__(self, file: Path, header: Any) -> None:
        folder = tempfile.TemporaryDirectory(prefix="extrags-")
        weakref.finalize(self, folder.cleanup)
        stream = Path(folder.name) / "stream"
        with _dicom_errors(file, None):
            _copy_stream(file, stream)
        super().__init__(stream, named=file)
        with _dicom_errors(file, None):
            if "PixelAspectRatio" in header:
                self._pixel_aspect = _pixel_aspect(header)


def open_dicom(file: Path) -> Footage:
    """A DICOM file as footage.

    Raises:
        MissingDependencyError: without pydicom.
        SourceNotFoundError: no such file.
        SourceError: no DICOM file, no pixels in it, or pixels that are not understood.
    """
    if find_spec("pydicom") is None:
        raise MissingDependencyError(
            f"{file.name}: DICOM files need pydicom: not installed. Install with: {installed_with('dicom')}"
        )
    from pydicom import dcmread
    from pydicom.filereader import read_file_meta_info
    from pydicom.uid import (
        HEVCM10P51,
        HEVCMP51,
        DeflatedExplicitVRLittleEndian,
        MPEGTransferSyntaxes,
    )

    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file)
    with _dicom_errors(file, None):
        # pydicom would unpack the whole file to read its header: to whatever size it unpacks to. Its decoders
        # find no pixels in one anyway.
        if read_file_meta_info(file).get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian:
            raise SourceError(
                "a deflated file, which is not read; dcmconv +te of DCMTK, for one, writes it without",
                file=file,
                field="TransferSyntaxUID",
            )
        header = dcmread(file, stop_before_pixels=True, specific_tags=list(_LOOKED_AT))
        syntax = header.file_meta.TransferSyntaxUID
    with _dicom_errors(file, None):
        pixels = header.get("Rows") is not None and header.get("Columns") is not None
    if not pixels:
        raise SourceError("the file holds no pixels", file=file, field="Rows")
    if syntax in (*MPEGTransferSyntaxes, HEVCMP51, HEVCM10P51):
        return _DicomVideo(file, header)
    with _dicom_errors(file, None):
        return DicomFile(file, header)


def _dicom_files(place: Path) -> tuple[Path, ...]:
    found = files_meant(place, DICOM_SUFFIXES)
    if not found and place.is_file() and not place.suffix:
        # As scanners and archives export them: no suffix, but a signature.
        with place.open("rb") as stream:
            stream.seek(_MAGIC_AT)
            return (place,) if stream.read(len(_MAGIC)) == _MAGIC else ()
    return found


def _recognises(place: Path) -> bool:
    return bool(_dicom_files(place))


def _files(place: Path) -> list[Path]:
    return with_files_beside(_dicom_files(place))


def _frames(place: Path, config: IngestConfig) -> SourceFrames:
    return footage_frames(_footage(place, config), config)


def _outline(place: Path, config: IngestConfig) -> SourceFrames:
    return footage_outline(_footage(place, config), config)


def _footage(place: Path, config: IngestConfig) -> Footage:
    return footage_meant(place, _dicom_files(place), open_dicom, config)


READER = FolderReader(
    name="dicom",
    version=9,
    summary="a DICOM multi-frame file (dcm), optionally with intrinsics.json and mask.png beside it",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    outline=_outline,
    is_footage=True,
    conventions="no poses and no depth; the poses stage finds them, in an arbitrary unit",
)


def _times_s(header: Any, count: int, file: Path) -> Float[np.ndarray, "f"]:
    """When each frame is shown. An element that is 0 is as good as absent.

    Raises:
        SourceError: a duration or a rate that is none.
    """
    vector_ms = header.get("FrameTimeVector") or None
    if vector_ms is not None and np.size(vector_ms) != count:
        logger.warning(
            "%s: its FrameTimeVector has %d entries for %d frames, and is not read",
            file.name,
            np.size(vector_ms),
            count,
        )
    elif vector_ms is not None:
        steps_ms = np.asarray(vector_ms, dtype=np.float64)
        wrong = np.flatnonzero(~((steps_ms >= 0) & np.isfinite(steps_ms)))
        if wrong.size:
            raise SourceError(
                f"{steps_ms[wrong[0]]:g} ms since the frame before; expected 0 or more",
                file=file,
                frame=int(wrong[0]),
                field="FrameTimeVector",
            )
        return np.cumsum(steps_ms) / 1000
    for name in ("FrameTime", "CineRate", "RecommendedDisplayFrameRate"):
        value = float(header.get(name) or 0)
        if not 0 <= value < np.inf:
            unit = "ms for a frame" if name == "FrameTime" else "frames a second"
            raise SourceError(f"{value:g} {unit}; expected a positive number", file=file, field=name)
        if value:
            return np.arange(count) * (value if name == "FrameTime" else 1000 / value) / 1000
    logger.warning(
        "%s has no timing: assuming %g frames a second, by which ingest.start_s, ingest.end_s and the "
        "lengths of shots go",
        file.name,
        _USUAL_FRAMES_PER_S,
    )
    return np.arange(count) / _USUAL_FRAMES_PER_S


def _pixel_aspect(header: Any) -> float:
    """Width over height; the file gives height and width."""
    ratio = header.get("PixelAspectRatio")
    if ratio is None or len(ratio) != 2 or min(float(value) for value in ratio) <= 0:
        return 1.0
    return float(ratio[1]) / float(ratio[0])


def _copy_stream(file: Path, place: Path) -> None:
    """Copy the fragments of the encapsulated pixel data."""
    from pydicom import dcmread
    from pydicom.encaps import generate_fragments, parse_basic_offsets

    with file.open("rb") as source, place.open("wb") as copy:
        dcmread(source, stop_before_pixels=True)
        source.seek(_PIXEL_ELEMENT_BYTES, 1)
        parse_basic_offsets(source)
        for fragment in generate_fragments(source):
            copy.write(fragment)


@contextmanager
def _dicom_errors(file: Path, frame: int | None) -> Iterator[None]:
    """What pydicom and Pillow raise for a file, as the errors of a source."""
    from pydicom.errors import BytesLengthException, InvalidDicomError

    try:
        yield
    except ExtragsError:
        raise
    except InvalidDicomError as error:
        raise SourceError("no DICOM file, or damaged from its first bytes", file=file) from error
    except NotImplementedError as error:
        raise SourceError(f"cannot be decoded: {error}", file=file, field="TransferSyntaxUID") from error
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        BytesLengthException,
        EOFError,
        LookupError,
        MemoryError,
        OSError,
        RuntimeError,
        TypeError,
        ValueError,
        struct.error,
    ) as error:
        raise SourceError(
            f"damaged, truncated, or of an unknown compression: {reason_of(error)}", file=file, frame=frame
        ) from error
