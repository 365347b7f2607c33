"""Reader of a video file: picks frames by motion and sharpness, masks what is not tissue; poses come later.

A file with one of `VIDEO_SUFFIXES`, or a folder that holds one such file and no images. Beside the file, both
optional: `intrinsics.json` and `mask.png`, as in `data_catalog.readers.frames_folder`; without the first a
field of view of 90 degrees is assumed and said so until the poses stage estimates it, without the second
the round picture, the dark frame and burnt-in text are found (`data_catalog.content`).

The video is decoded twice. First, all frames at a small size: how far the picture has moved (median of a
dense optical flow from a reference frame, as a share of the image width; the reference follows only when the
move is plain, so that noise and trembling do not add up) and how sharp each frame is. The path is cut into
steps of equal motion, and of each step the sharpest frame is taken; where the scope stands still nothing is
taken twice. Then the chosen frames at full size. Steps are 3 % of the width; they grow where there would be
more than `MAX_FRAMES` (or `ingest.max_frames`) and shrink where there would be fewer than 24, down to what
the flow can tell. Frame names are the frames' numbers in the video.

Source: sharpness as the mean absolute Laplacian over the mean brightness, after Pertuz et al., "Analysis of
focus measure operators for shape-from-focus", Pattern Recognition 2013; flow: Kroeger et al., "Fast optical
flow using dense inverse search", ECCV 2016 (OpenCV's DIS).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from data_catalog.content import content_mask
from data_catalog.folder_reader import FolderReader
from data_catalog.images import colour_files
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.frames_folder import INTRINSICS_FILE, read_intrinsics
from data_catalog.sampling import Sampling
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from extrags.events import Progress, emit
from extrags.lens import Lens

__all__ = ["MAX_FRAMES", "READER", "VIDEO_SUFFIXES", "VideoSurvey", "choose_frames", "survey", "video_file"]

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".wmv")
MAX_FRAMES = 200
STEP_SHARE = 0.03
"""Usual motion between two chosen frames, as a share of the image width."""
_SMALLEST_STEP = 0.0015
_MIN_MOTION = 0.01
_FEW_FRAMES = 24
_PLAIN_MOVE = 0.01
"""From here on the flow's reference follows."""
_SURVEY_WIDTH = 192
_SAMPLE_WIDTH = 640
_MAX_SAMPLES = 32
_MIN_DECODED = 0.9
_PROGRESS_EVERY = 20


@dataclass(frozen=True)
class VideoSurvey:
    """What the first pass over a video finds.

    Args:
        width: of the video.
        height: of the video.
        path: share of the width that the picture has moved since the first frame, never falling, [F].
        sharpness: comparable between neighbouring frames, [F].
        samples: some frames, at most 640 pixels wide, [S, h, w, 3].
    """

    width: int
    height: int
    path: Float[np.ndarray, "f"]
    sharpness: Float[np.ndarray, "f"]
    samples: UInt8[np.ndarray, "s h w 3"]


def video_file(place: Path) -> Path | None:
    """The video that a path means: itself, or the only one in a folder without images; else None."""
    if place.is_file():
        return place if place.suffix.lower() in VIDEO_SUFFIXES else None
    if not place.is_dir():
        return None
    found = [file for file in place.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES and file.is_file()]
    images = [file for file in colour_files(place) if file.name != "mask.png"]
    return found[0] if len(found) == 1 and not images else None


def _recognises(place: Path) -> bool:
    return video_file(place) is not None


def _files(place: Path) -> list[Path]:
    file = video_file(place)
    if file is None:
        return []
    beside = [file.parent / name for name in (INTRINSICS_FILE, "mask.png")]
    return sorted([file, *(other for other in beside if other.is_file())])


def _frames(place: Path, config: IngestConfig) -> SourceFrames:
    file = video_file(place)
    if file is None:
        raise SourceNotFoundError("no video here", file=place)
    found = survey(file)
    chosen = choose_frames(found.path, found.sharpness, config.max_frames or MAX_FRAMES, file=file)
    logger.info("%s: %d of %d frames chosen", file.name, len(chosen), len(found.path))
    guess_is_used = config.calibration is None
    K = read_intrinsics(file.parent, found.width, found.height, guess_is_used=guess_is_used)
    lens = Lens.pinhole(K, found.width, found.height)
    mask_file = file.parent / "mask.png"
    images = _decoded(file, chosen)
    return SourceFrames(
        frames=[
            PosedFrame(
                name=f"{index:06d}",
                file=file,
                lens=lens,
                mask_file=mask_file if mask_file.is_file() else None,
                number=index,
            )
            for index in chosen.tolist()
        ],
        pose_file=file,
        metric=False,
        # No more frames were chosen than may be kept, so that each is asked for, in order.
        read_colour=lambda frame: _next_image(images, frame),
        masks=_SurveyedMask(found),
        intrinsics="given" if (file.parent / INTRINSICS_FILE).is_file() else "guessed",
        looked_at=len(found.path),
    )


class _SurveyedMask:
    """What is tissue, found from the samples of the first pass."""

    def __init__(self, found: VideoSurvey) -> None:
        self._found = found

    def see(
        self, frame: PosedFrame, image: UInt8[np.ndarray, "h w 3"], sampled: UInt8[np.ndarray, "h2 w2 3"]
    ) -> None:
        """Nothing new: the first pass saw all frames."""

    def mask(self, frame: PosedFrame, sampling: Sampling) -> Bool[np.ndarray, "h2 w2"]:
        """The picture inside its dark frame, less burnt-in text."""
        return sampling.mask(_enlarged(self._found), file=frame.file)


READER = FolderReader(
    name="video",
    version=2,
    summary="a video file (mp4, avi, mov, mkv, ...), optionally with intrinsics.json and mask.png beside it",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="no poses and no depth; the poses stage finds them, in an arbitrary unit",
)


def survey(file: Path) -> VideoSurvey:
    """Decode all frames at a small size and measure motion and sharpness.

    Raises:
        SourceError: no video, or one that ends before its end.
    """
    import cv2

    path: list[float] = []
    sharpness: list[float] = []
    samples: list[tuple[int, np.ndarray]] = []
    sample_every = 1
    reference: np.ndarray | None = None
    behind = 0.0
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    with _opened(file) as video:
        announced = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        width, height = (int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        while True:
            there, image = video.read()
            if not there:
                break
            index = len(sharpness)
            height, width = image.shape[:2]
            size = (_SURVEY_WIDTH, max(16, round(_SURVEY_WIDTH * height / width)))
            grey = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
            sharpness.append(_sharpness(grey))
            if reference is None:
                reference = grey
            moved = _moved(flow.calc(reference, grey, None), reference, grey)
            path.append(max(behind + moved, path[-1] if path else 0.0))
            if moved >= _PLAIN_MOVE:
                reference, behind = grey, path[-1]
            if index % sample_every == 0:
                samples.append((index, _sample(image)))
                if len(samples) > 2 * _MAX_SAMPLES:
                    sample_every *= 2
                    samples = [(number, kept) for number, kept in samples if number % sample_every == 0]
            if index % _PROGRESS_EVERY == 0 and announced > 0:
                emit(Progress("ingest", index, 2 * announced))
    if not sharpness:
        raise SourceError("not a single frame can be decoded; is it a video, and whole?", file=file)
    if announced > 0 and len(sharpness) < _MIN_DECODED * announced:
        raise SourceError(
            f"{announced} frames announced, {len(sharpness)} decoded: the video is truncated or damaged",
            file=file,
            frame=len(sharpness),
        )
    kept = samples[:: max(1, -(-len(samples) // _MAX_SAMPLES))]
    return VideoSurvey(
        width=width,
        height=height,
        path=np.array(path),
        sharpness=np.array(sharpness),
        samples=np.stack([image for _, image in kept]),
    )


def choose_frames(
    path: Float[np.ndarray, "f"],
    sharpness: Float[np.ndarray, "f"],
    at_most: int,
    *,
    file: object = None,
) -> Int[np.ndarray, "n"]:
    """The sharpest frame of each step of equal motion.

    Args:
        path: share of the width moved since the first frame, never falling.
        sharpness: larger is sharper.
        at_most: the steps grow until there are no more than so many.
        file: named in errors.

    Returns:
        Indices of frames, ascending.

    Raises:
        SourceError: the picture hardly moves.
    """
    total = float(path[-1])
    if total < _MIN_MOTION:
        raise SourceError(
            f"the picture moves by {total:.1%} of its width in {len(path)} frames; expected at least "
            f"{_MIN_MOTION:.0%} in all: nothing can be reconstructed from a scope that stands still",
            file=file,
            field="motion",
        )
    step = float(np.clip(total / _FEW_FRAMES, _SMALLEST_STEP, STEP_SHARE))
    step = max(step, total / at_most * (1 + 1e-9))
    window = np.minimum((path / step).astype(np.int64), at_most - 1)
    return np.array(
        [
            members[int(np.argmax(sharpness[members]))]
            for members in (np.flatnonzero(window == number) for number in np.unique(window))
        ],
        dtype=np.int64,
    )


def _sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    import cv2

    # Smoothed first, so that compression noise is not taken for detail.
    calm = cv2.GaussianBlur(grey, (0, 0), 0.8)
    return float(np.abs(cv2.Laplacian(calm, cv2.CV_32F)).mean() / (float(grey.mean()) + 1))


def _moved(
    flow: Float[np.ndarray, "h w 2"], before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]
) -> float:
    """Median length of the flow over lit pixels, as a share of the width."""
    lit = (before > 14) & (after > 14)
    if lit.sum() < 0.02 * lit.size:
        return 0.0
    return float(np.median(np.linalg.norm(flow[lit], axis=1)) / before.shape[1])


def _sample(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    import cv2

    height, width = image.shape[:2]
    if width > _SAMPLE_WIDTH:
        size = (_SAMPLE_WIDTH, round(_SAMPLE_WIDTH * height / width))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _enlarged(found: VideoSurvey) -> Bool[np.ndarray, "h w"]:
    """The content mask of the samples at the video's size."""
    import cv2

    small = content_mask(found.samples).astype(np.float32)
    size = (found.width, found.height)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR) > 0.999, dtype=bool)


def _decoded(file: Path, chosen: Int[np.ndarray, "n"]) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"]]]:
    """The chosen frames at full size, in order."""
    import cv2

    wanted = set(chosen.tolist())
    with _opened(file) as video:
        for index in range(int(chosen[-1]) + 1):
            # Decoding cannot jump: between key frames all are needed.
            if not video.grab():
                return
            if index in wanted:
                there, image = video.retrieve()
                if not there:
                    return
                yield index, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _next_image(
    images: Iterator[tuple[int, UInt8[np.ndarray, "h w 3"]]], frame: PosedFrame
) -> UInt8[np.ndarray, "h w 3"]:
    for index, image in images:
        if index == frame.number:
            return image
    raise SourceError(
        "the frame was chosen, but could not be decoded the second time", file=frame.file, frame=frame.label
    )


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    import cv2

    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file)
    video = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise SourceError(
                f"cannot be opened as a video ({file.stat().st_size} bytes); is it whole?", file=file
            )
        yield video
    finally:
        video.release()
