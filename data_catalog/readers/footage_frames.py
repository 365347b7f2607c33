"""What readers of videos and of DICOM files share: from footage to the frames of a sequence.

The footage is decoded twice, frame by frame, so that memory does not grow with its length. The first pass
(`data_catalog.survey`) measures; the frames are chosen; the second pass decodes them at full size, undoes
interlacing, and takes samples for the mask along the way: the round picture, the dark frame and burnt-in text
(`data_catalog.content`). Of a footage with cuts the longest shot is read; `ingest.start_s` and `ingest.end_s`
take another part. Frame names are the frames' numbers in the file.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int, UInt8

from data_catalog.content import content_mask
from data_catalog.footage import Footage, FootageFrame, TimeSpan
from data_catalog.images import spread
from data_catalog.interlacing import deinterlaced
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.frames_folder import (
    mask_beside,
    read_intrinsics,
    stated_intrinsics,
    states_angle_alone,
)
from data_catalog.readers.stereo_footage import OneCamera, of_one_camera, time_span
from data_catalog.sampling import Sampling
from data_catalog.survey import NOTHING_DECODED, Shot, Survey, choose_frames, survey
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.lens import Lens

__all__ = ["MAX_FRAMES", "footage_frames", "footage_outline"]

logger = logging.getLogger(__name__)

MAX_FRAMES = 200
"""So many are chosen at most, unless `ingest.max_frames` says otherwise."""
_SURELY_THERE = 0.9
"""A file with a smaller share of the frames that its header announces is not read."""
_SAMPLE_WIDTH = 640
_MAX_SAMPLES = 32
_NAMED_SHOTS = 5


def footage_frames(footage: Footage, config: IngestConfig) -> SourceFrames:
    """Survey a footage, choose frames, and hand over how they are decoded.

    `intrinsics.json` and `mask.png` beside the file are taken where they are there; without the first the
    intrinsics are a guess.

    Args:
        footage: of one recording.
        config: number of frames, and the part in seconds.

    Raises:
        ConfigError: a part that ends before it begins.
        SourceError: damaged, empty in that part, or a picture that hardly moves.
    """
    footage = of_one_camera(footage, config)
    file, span = footage.file, time_span(config)
    found = survey(_frames_of(footage, span), file=file, announced=footage.announced)
    shot = found.longest_shot()
    _report(found, shot, footage)
    here = slice(shot.first, shot.last + 1)
    chosen = choose_frames(
        found.path[here], found.sharpness[here], config.max_frames or MAX_FRAMES, file=file
    )
    numbers = found.numbers[here][chosen]
    logger.info("%s: %d of %d frames chosen", file.name, len(chosen), len(found))
    second = _SecondPass(footage, span, numbers, found.numbers[here], interlaced=shot.interlaced)
    unread = _unread(footage, config, numbers, found.width, found.height)
    # No more frames were chosen than may be kept, so that each is asked for, in order.
    return replace(unread, read_color=second.image, masks=second, looked_at=len(found))


def footage_outline(footage: Footage, config: IngestConfig) -> SourceFrames:
    """About the frames that `footage_frames` will choose, from the header alone: their pixels are not read.

    There are as many as may be chosen, or as the header announces of the part that is asked for; fewer will
    be where the picture hardly moves, or where there are cuts.

    Args:
        footage: of one recording.
        config: number of frames, and the part in seconds.

    Raises:
        ConfigError: a part that ends before it begins.
        SourceError: no frame can be decoded, or intrinsics beside the file are damaged.
    """
    span = time_span(config)
    if not all(footage.size):
        raise SourceError(NOTHING_DECODED, file=footage.file)
    footage = of_one_camera(footage, config)
    most = config.max_frames or MAX_FRAMES
    passed_over = footage.counted_until(span.start_s)
    looked_at = max(0, footage.counted_until(span.end_s) - passed_over)
    unread = _unread(footage, config, np.array(spread(looked_at or most, most)), *footage.size)
    return replace(unread, looked_at=looked_at, passed_over=passed_over)


def _unread(
    footage: Footage, config: IngestConfig, numbers: Int[np.ndarray, "n"], width: int, height: int
) -> SourceFrames:
    """Frames by their numbers, with what lies beside the file."""
    file = footage.file
    K = read_intrinsics(
        file.parent,
        width,
        height,
        pixel_aspect=footage.pixel_aspect,
        is_used=config.calibration is None,
    )
    lens, mask_file = Lens.pinhole(K, width, height), mask_beside(file.parent)
    return SourceFrames(
        frames=[
            PosedFrame(name=f"{number:06d}", file=file, lens=lens, mask_file=mask_file, number=number)
            for number in numbers.tolist()
        ],
        pose_file=file,
        metric=False,
        intrinsics=stated_intrinsics(file.parent, config),
        angle_alone=states_angle_alone(file.parent, config),
        stereo_camera=config.stereo_camera if isinstance(footage, OneCamera) else None,
    )


def _frames_of(footage: Footage, span: TimeSpan) -> Iterator[FootageFrame]:
    """The frames of a part.

    Raises:
        SourceError: there are none.
    """
    is_empty = True
    for frame in footage.frames(span):
        is_empty = False
        yield frame
    if is_empty and span != TimeSpan():
        until = "s on" if span.end_s == np.inf else f"to {span.end_s:g} s"
        raise SourceError(
            f"no frame from {span.start_s:g} {until} (ingest.start_s, ingest.end_s){_end_in_words(footage)}",
            file=footage.file,
        )


def _end_in_words(footage: Footage) -> str:
    """When the last frame is shown; empty where the frames that the header announces are not there."""
    # Headers are off by a few frames. Those before are decoded, but not turned into pictures.
    numbers = range(int(_SURELY_THERE * footage.announced), 2 * footage.announced)
    last_s = max((frame.time_s for frame in footage.frames(TimeSpan(), numbers)), default=None)
    return "" if last_s is None else f"; the last frame is at {last_s:.4g} s"


def _report(found: Survey, shot: Shot, footage: Footage) -> None:
    """Say what a user should know about a footage before poses are looked for."""
    name = footage.file.name
    shots = found.all_shots()
    if len(shots) > 1:
        others = sorted((other for other in shots if other != shot), key=lambda other: -other.duration_s)
        listed = ", ".join(_seconds(found, other) for other in others[:_NAMED_SHOTS])
        more = f" and {len(others) - _NAMED_SHOTS} more" if len(others) > _NAMED_SHOTS else ""
        logger.warning(
            "%s: cut into %d shots; the longest that moves is read, %s, and these are not: %s%s. "
            "ingest.start_s and ingest.end_s take another part",
            name,
            len(shots),
            _seconds(found, shot),
            listed,
            more,
        )
    if shot.interlaced:
        logger.warning(
            "%s: interlaced; every second line is interpolated, so that each frame shows one moment", name
        )
    if abs(footage.pixel_aspect - 1) > 1e-3:
        logger.info("%s: pixels are %.4g times as wide as high", name, footage.pixel_aspect)
    steps = np.diff(found.times_s)
    if len(steps) and steps.max() > 1.5 * np.median(steps) + 1e-3:
        logger.info("%s: the frame rate varies, from %.3g to %.3g s a frame", name, steps.min(), steps.max())


def _seconds(found: Survey, shot: Shot) -> str:
    start_s = found.times_s[shot.first]
    return f"{start_s:.1f} to {start_s + shot.duration_s:.1f} s"


class _SecondPass:
    """Decodes the chosen frames in order; what is tissue is found from samples of the same shot."""

    def __init__(
        self,
        footage: Footage,
        span: TimeSpan,
        numbers: Int[np.ndarray, "n"],
        of_shot: Int[np.ndarray, "f"],
        *,
        interlaced: bool,
    ) -> None:
        self._footage = footage
        self._interlaced = interlaced
        self._samples: list[UInt8[np.ndarray, "h w 3"]] = []
        self._chosen = set(numbers.tolist())
        # Decoding ends with the last chosen frame.
        reached = of_shot[of_shot <= numbers[-1]]
        self._sampled = {int(reached[k]) for k in spread(len(reached), _MAX_SAMPLES)}
        self._frames = self._decoded(span)

    def _decoded(self, span: TimeSpan) -> Iterator[FootageFrame]:
        for frame in self._footage.frames(span, self._chosen | self._sampled):
            rgb = deinterlaced(frame.rgb) if self._interlaced else frame.rgb
            if frame.number in self._sampled:
                self._samples.append(_sample(rgb))
            if frame.number in self._chosen:
                yield FootageFrame(frame.number, frame.time_s, rgb)

    def image(self, frame: PosedFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image of the next frame.

        Raises:
            SourceError: it cannot be decoded a second time.
        """
        for decoded in self._frames:
            if decoded.number == frame.number:
                return decoded.rgb
        raise SourceError(
            "the frame was chosen, but could not be decoded the second time",
            file=frame.file,
            frame=frame.label,
        )

    def see(
        self, frame: PosedFrame, image: UInt8[np.ndarray, "h w 3"], sampled: UInt8[np.ndarray, "h2 w2 3"]
    ) -> None:
        """Nothing new: samples are taken while decoding."""

    def mask(self, frame: PosedFrame, sampling: Sampling) -> Bool[np.ndarray, "h2 w2"]:
        """The picture inside its dark frame, less burnt-in text."""
        import cv2

        small = content_mask(np.stack(self._samples)).astype(np.float32)
        size = (frame.lens.width, frame.lens.height)
        whole = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR) > 0.999
        return sampling.mask(np.asarray(whole, dtype=bool), file=frame.file)


def _sample(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    import cv2

    height, width = rgb.shape[:2]
    if width <= _SAMPLE_WIDTH:
        return rgb.copy()
    size = (_SAMPLE_WIDTH, round(_SAMPLE_WIDTH * height / width))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
