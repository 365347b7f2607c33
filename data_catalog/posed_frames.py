"""What readers hand over, and how it becomes an `EndoscopicSequence`: the one place for all readers.

A reader says which frames there are (`PosedFrame`) and what they share (`SourceFrames`). `assembled` thins
them, splits them, reads their pixels, undoes lenses, shrinks, masks, and checks what only files can show.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from data_catalog.checks import check_depth, check_intrinsics, check_pose
from data_catalog.depth_steps import DepthSteps
from data_catalog.guessed_intrinsics import fitted_to_picture
from data_catalog.image_pages import tell_about_pages
from data_catalog.images import (
    COLOR_SUFFIXES,
    UPRIGHT,
    bits_per_value,
    is_transparent,
    orientation,
    read_color,
    read_depth,
    read_mask,
    spread,
)
from data_catalog.lens_use import LensUse
from data_catalog.sampling import CameraModel, LensSampling, Sampling
from data_catalog.splits import every_nth
from data_catalog.stereo import check_one_camera
from data_catalog.unknown_depth import UnknownDepth
from extrags.cameras import Cameras, rotation_about
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.events import Progress, emit
from extrags.frame_stacks import FrameStack, frames_of, stacked
from extrags.lens import Lens
from extrags.observed_surface import observed_by_depth
from extrags.provenance import StereoCamera
from extrags.radial_lens import RadialLens
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["MaskFinder", "PosedFrame", "SourceFrames", "assembled", "chosen_frames", "planned_sampling"]

logger = logging.getLogger(__name__)

_EXACT_POSE = 1e-14
_BRIGHTEST_OF_12_BITS = 16
"""Of 255: values of 12 bits in files of 16 stay below."""
_BRIGHTEST_OF_10_BITS = 4
_BITS_OF_LARGE_VALUES = 16
_LOOKED_AT_FOR_ALPHA = 8
"""Frames, spread over the source: their alpha is decoded apart from their colours."""


@dataclass(frozen=True)
class PosedFrame:
    """One frame on disk, its pose in OpenCV axes, camera to world.

    Args:
        name: as the format calls it; the sequence drops an image's suffix.
        file: the colour image, or what it is decoded from.
        lens: for the image as it lies on disk.
        world_from_camera: as read; checked by `assembled`. None where the poses stage has to find it.
        mask_file: None where there is none.
        depth_file: None where there is none; its depth is unknown.
        recording: index of the recording.
        split: None where the format names none.
        number: names the frame in messages where a source counts its frames; None takes the name.
    """

    name: str
    file: Path
    lens: CameraModel
    world_from_camera: Float[np.ndarray, "4 4"] | None = None
    mask_file: Path | None = None
    depth_file: Path | None = None
    recording: int = 0
    split: Literal["train", "test"] | None = None
    number: int | None = None

    @property
    def label(self) -> str | int:
        """What messages call it."""
        return self.name if self.number is None else self.number


@runtime_checkable
class MaskFinder(Protocol):
    """Finds the mask of frames that have no file: one for each recording, from its images."""

    def see(
        self,
        frame: PosedFrame,
        image: UInt8[np.ndarray, "h w 3"],
        sampled: UInt8[np.ndarray, "h2 w2 3"],
    ) -> None:
        """Take note of a frame, as it lies on disk and as the sequence holds it."""

    def mask(self, frame: PosedFrame, sampling: Sampling) -> Bool[np.ndarray, "h2 w2"]:
        """The mask of a frame's recording, once all frames were seen."""


def _color_of(frame: PosedFrame) -> UInt8[np.ndarray, "h w 3"]:
    return read_color(frame.file, frame=frame.label)


def _depth_of(file: Path, label: str | int) -> Float[np.ndarray, "h w"]:
    return read_depth(file, frame=label)


@dataclass(frozen=True)
class SourceFrames:
    """All frames of a source, in order, and what they share.

    Args:
        frames: before any thinning.
        pose_file: named in errors about poses and the split.
        metric: whether lengths are millimetres.
        intrinsics_file: says for images of which size the lenses hold; None where they were made for the
            images there are.
        read_color: a frame's image; asked for once, in order.
        read_depth: file and frame's label to z-depth in the sequence's unit, 0 where unknown.
        white_is_tissue: polarity of mask files.
        masks: finds masks of frames without a file; None leaves such frames whole.
        sampling: a frame's lens, the settings and the first lens's sampling (None for the first) to its own.
        observed: cameras, masks, depth and split to the pixels of held-out frames whose surface was seen by
            training frames, or None where nothing tells.
        split_name: of the split, where frames name theirs.
        split_version: of the rule behind it.
        points: sparse points of the source.
        points_rgb: their colours.
        truth: what else is known, for `EndoscopicSequence.truth`.
        intrinsics: whether the lenses are stated by the source, or guessed because nothing states them; then
            all frames have one.
        angle_alone: whether the lenses are made of a stated field of view and nothing else: it belongs to the
            picture inside the frame, as a guessed one does.
        looked_at: pictures that the frames were chosen among, each of which was a step of progress before the
            first frame is read.
        passed_over: pictures before these, which are decoded and not looked at.
        lens_stays: why no calibration file may take the place of the lenses that are stated, as a sentence;
            None where one may.
        stereo_camera: whose frames these are; None where nothing tells of two cameras.
        upright: whether `read_color` turns images as viewers do (EXIF orientation); lenses and masks are then
            those of the turned ones.
    """

    frames: Sequence[PosedFrame]
    pose_file: Path
    metric: bool
    intrinsics_file: Path | None = None
    read_color: Callable[[PosedFrame], UInt8[np.ndarray, "h w 3"]] = _color_of
    read_depth: Callable[[Path, str | int], Float[np.ndarray, "h w"]] = _depth_of
    white_is_tissue: bool = True
    masks: MaskFinder | None = None
    sampling: Callable[[Any, IngestConfig, Sampling | None], Sampling] = LensSampling.planned
    observed: Callable[
        [Cameras, Bool[np.ndarray, "f h w"], Float[np.ndarray, "f h w"] | None, Split],
        Bool[np.ndarray, "f h w"] | None,
    ] = observed_by_depth
    split_name: str = "manifest"
    split_version: int = 1
    points: Float[np.ndarray, "p 3"] | None = None
    points_rgb: UInt8[np.ndarray, "p 3"] | None = None
    truth: Callable[[EndoscopicSequence], dict[str, Any]] | None = None
    intrinsics: Literal["given", "guessed"] = "given"
    angle_alone: bool = False
    looked_at: int = 0
    passed_over: int = 0
    lens_stays: str | None = None
    stereo_camera: StereoCamera | None = None
    upright: bool = False


def assembled(source: SourceFrames, config: IngestConfig, name: str) -> EndoscopicSequence:
    """Read images, undo lenses, shrink, and put everything into one sequence.

    Args:
        source: what a reader found.
        config: size, frames and split.
        name: of the sequence.

    Raises:
        SourceError: a file is wrong or of another size than its camera, all pictures are black, or the masks
            of too many frames leave no pixel; names file, frame and field.
        PoseError: a pose that is no rigid motion.
        ConfigError: a size that the source cannot give.
    """
    kept, split, world_from_camera = chosen_frames(source, config)
    # Before a size is refused that this explains.
    _tell_about_orientation(kept, upright=source.upright)
    pixels = _Pixels(source, config, kept)
    for index, frame in enumerate(kept, start=source.looked_at + 1):
        pixels.read(frame)
        emit(Progress("ingest", index, source.looked_at + len(kept)))
    pixels.tell(kept)
    tell_about_pages(kept[0].file)
    _tell_about_transparency(kept)
    rgb, mask = pixels.colors.array, pixels.masks(kept)
    depth_mm = pixels.depths.array if len(pixels.depths) else None
    shown = _not_masked_throughout(kept, mask, config)
    if len(shown) < len(kept):
        kept = [kept[index] for index in shown]
        split, world_from_camera = _split(kept, source, config), _poses(kept, source)
        rgb, mask = frames_of(rgb, shown), frames_of(mask, shown)
        depth_mm = None if depth_mm is None else frames_of(depth_mm, shown)
    K = np.stack([pixels.samplings[frame.lens].K for frame in kept])
    if source.intrinsics == "guessed" or source.angle_alone:
        K = fitted_to_picture(K, mask, rgb)
    lens = pixels.lens(kept, source.pose_file)
    if world_from_camera is not None:
        world_from_camera = _rolled(world_from_camera, [pixels.samplings[f.lens].roll_rad for f in kept])
    observed = None
    if world_from_camera is not None:
        cameras = Cameras(K, world_from_camera, rgb.shape[2], rgb.shape[1], lens)
        observed = source.observed(cameras, mask, depth_mm, split)
    used = np.mean(
        [(pixels.samplings[f.lens].source_share * m).sum() for f, m in zip(kept, mask, strict=True)]
    )
    logger.info("%s: %.1f %% of the source's pixels are used, in the mean over its frames", name, 100 * used)
    sequence = EndoscopicSequence(
        name=name,
        rgb=rgb,
        K=K,
        mask=mask,
        split=split,
        world_from_camera=world_from_camera,
        depth_mm=depth_mm,
        recording=np.array([frame.recording for frame in kept], dtype=np.int64),
        frame_names=_frame_names(kept),
        metric=source.metric,
        observed=observed,
        points=source.points,
        points_rgb=source.points_rgb,
        intrinsics=source.intrinsics,
        lens=lens,
        stereo_camera=source.stereo_camera,
    )
    return sequence if source.truth is None else replace(sequence, truth=source.truth(sequence))


def chosen_frames(
    source: SourceFrames, config: IngestConfig
) -> tuple[list[PosedFrame], Split, Float[np.ndarray, "f 4 4"] | None]:
    """The frames that are read, their split, and their checked poses; None where there are none.

    Args:
        source: what a reader found.
        config: number of frames, and the split of sources that name none.

    Raises:
        SourceError: no frame or a single one, or poses or a split for some frames alone.
        PoseError: a pose that is no rigid motion.
        ConfigError: the right camera is asked for, and nothing tells of two.
    """
    if source.stereo_camera is None:
        check_one_camera(config, str(source.pose_file))
    if not source.frames:
        raise SourceError("there is no frame", file=source.pose_file, field="frames")
    _check_poses_of_all_or_none(source)
    kept = [source.frames[index] for index in spread(len(source.frames), config.max_frames)]
    return kept, _split(kept, source, config), _poses(kept, source)


def planned_sampling(
    source: SourceFrames, frame: PosedFrame, config: IngestConfig, first: Sampling | None = None
) -> Sampling:
    """How a frame is brought to the sequence's pinhole.

    Args:
        source: the frame's.
        frame: of a lens that may be shared.
        config: size and field of view.
        first: sampling of the sequence's first lens; None for that lens itself.

    Raises:
        SourceError: intrinsics that are none.
        ConfigError: a size that the source cannot give.
    """
    lens = frame.lens
    if isinstance(lens, Lens):
        named = source.intrinsics_file or source.pose_file
        check_intrinsics(lens.K, lens.width, lens.height, frame=frame.label, file=named)
    return source.sampling(lens, config, first)


class _Pixels:
    """Images, masks and depth of the frames that are kept, brought to the sequence's pinhole."""

    def __init__(self, source: SourceFrames, config: IngestConfig, frames: Sequence[PosedFrame]) -> None:
        count = len(frames)
        self._has_depth = any(frame.depth_file is not None for frame in frames)
        self.source = source
        self.config = config
        self.samplings: dict[CameraModel, Sampling] = {}
        self.colors = FrameStack(count)
        self.depths = FrameStack(count)
        self.brightest = 0
        self._unknown_depth = UnknownDepth()
        self._depth_steps = DepthSteps()
        # A field of view that was asked for is meant to leave out what is beyond it.
        self._use = LensUse(count) if config.field_of_view_deg is None else None
        # Many frames share one file: it is read again only when another one, or another lens, comes.
        self._last_mask: tuple[Path | None, CameraModel, Bool[np.ndarray, "h w"]] | None = None
        self._masks: list[Bool[np.ndarray, "h w"] | None] = []

    def read(self, frame: PosedFrame) -> None:
        """Take in the next frame."""
        source = self.source
        image = source.read_color(frame)
        _check_size(image, frame, frame.file, "rgb", source.intrinsics_file)
        sampling = self._sampling(frame)
        if self._use is not None:
            self._use.see(len(self.colors), frame.lens, sampling, image)
        sampled = sampling.color(image, file=frame.file, frame=frame.label)
        sampled = self.colors.append(sampled)
        self.brightest = max(self.brightest, int(sampled.max()))
        if frame.mask_file is None and source.masks is not None:
            source.masks.see(frame, image, sampled)
            self._masks.append(None)
        else:
            self._masks.append(self._mask(frame, sampling))
        if frame.depth_file is not None:
            depth = self._unknown_depth.zeroed(
                source.read_depth(frame.depth_file, frame.label), frame.depth_file
            )
            # Before shrinking, so that row, column and count are those of the file.
            check_depth(depth, frame=frame.label, file=frame.depth_file)
            _check_size(depth, frame, frame.depth_file, "depth", None)
            self._depth_steps.see(depth, frame.depth_file)
            self.depths.append(sampling.depth(depth, file=frame.depth_file, frame=frame.label))
        elif self._has_depth:
            self._unknown_depth.see_absent(frame.label)
            self.depths.append(np.zeros((sampling.height, sampling.width), dtype=np.float32))

    def tell(self, frames: Sequence[PosedFrame]) -> None:
        """Say what reading found out about the frames as a whole.

        Raises:
            SourceError: when nothing is brighter than what 12 bits reach in files of 16.
        """
        if self.brightest < _BRIGHTEST_OF_12_BITS:
            bits = 10 if 0 < self.brightest < _BRIGHTEST_OF_10_BITS else 12
            factor = 2 ** (_BITS_OF_LARGE_VALUES - bits)
            likely = (
                f"expected pictures that use the whole range. Those of {bits} bits in files of 16 look like "
                f"that: multiply them by {factor}, so that {2**bits - 1} becomes {(2**bits - 1) * factor}"
                if bits_per_value(frames[0].file) == _BITS_OF_LARGE_VALUES
                else "all frames are black"
            )
            raise SourceError(
                f"no pixel of any frame is brighter than {self.brightest} of 255: {likely}",
                file=frames[0].file,
                frame=frames[0].label,
                field="rgb",
            )
        self._unknown_depth.tell(len(frames), self.source.pose_file)
        if self._use is not None:
            self._use.tell()

    def lens(self, frames: Sequence[PosedFrame], file: Path) -> RadialLens | None:
        """The lens of all frames that were read; None for pinholes.

        Raises:
            SourceError: when frames have several.
        """
        found = {self.samplings[frame.lens].radial_lens for frame in frames}
        if len(found) != 1:
            raise SourceError(
                f"the frames have {len(found)} lenses, and sequences that keep their pixels have one; take "
                "ingest.lens=pinhole",
                file=file,
                field="lens",
            )
        return found.pop()

    def masks(self, frames: Sequence[PosedFrame]) -> Bool[np.ndarray, "f h w"]:
        """Masks of all frames, once they were read."""
        finder = self.source.masks
        found: dict[int, Bool[np.ndarray, "h w"]] = {}
        if finder is not None:
            one_of_each = {frame.recording: frame for frame in frames if frame.mask_file is None}
            found = {
                recording: finder.mask(frame, self.samplings[frame.lens])
                for recording, frame in one_of_each.items()
            }
        masks = (
            found[frame.recording] if mask is None else mask
            for frame, mask in zip(frames, self._masks, strict=True)
        )
        return stacked(masks, len(frames))

    def _sampling(self, frame: PosedFrame) -> Sampling:
        lens = frame.lens
        if lens not in self.samplings:
            first = next(iter(self.samplings.values()), None)
            self.samplings[lens] = planned_sampling(self.source, frame, self.config, first)
        return self.samplings[lens]

    def _mask(self, frame: PosedFrame, sampling: Sampling) -> Bool[np.ndarray, "h w"]:
        file, lens = frame.mask_file, frame.lens
        if self._last_mask is None or self._last_mask[:2] != (file, lens):
            mask = np.ones((lens.height, lens.width), dtype=bool)
            if file is not None:
                mask = read_mask(file, frame=frame.label) == self.source.white_is_tissue
                _check_size(mask, frame, file, "mask", None)
                if self._use is not None:
                    self._use.see_mask(len(self.colors) - 1, lens, mask)
            self._last_mask = (file, lens, sampling.mask(mask, file=file, frame=frame.label))
        return self._last_mask[2]


def _tell_about_orientation(frames: Sequence[PosedFrame], *, upright: bool) -> None:
    turned = [frame for frame in frames if orientation(frame.file) != UPRIGHT]
    if turned:
        done = (
            "and are read upright, as viewers show them; a mask, intrinsics and a calibration have to belong "
            "to upright pixels"
            if upright
            else "which turns them in viewers, and are read as they are stored, as by COLMAP; masks, depth, "
            "intrinsics and poses have to belong to stored pixels"
        )
        logger.warning(
            "%s: %d of %d images, this one first, have an EXIF orientation, %s",
            turned[0].file,
            len(turned),
            len(frames),
            done,
        )


def _tell_about_transparency(frames: Sequence[PosedFrame]) -> None:
    """Say where frames are transparent in parts that no mask file leaves out: alpha masks nothing."""
    unmasked = [frame for frame in frames if frame.mask_file is None]
    looked_at = [unmasked[k] for k in spread(len(unmasked), _LOOKED_AT_FOR_ALPHA)]
    found = next((frame for frame in looked_at if is_transparent(frame.file)), None)
    if found is not None:
        logger.warning(
            "%s has transparent pixels; alpha is not read, and the colours stored there count as tissue "
            "unless a mask leaves them out",
            found.file,
            extra={"topic": "not read", "field": "rgb"},
        )


def _not_masked_throughout(
    frames: Sequence[PosedFrame], masks: Bool[np.ndarray, "f h w"], config: IngestConfig
) -> Int[np.ndarray, "n"]:
    """Indices of the frames of which something is seen; others are left out with a warning.

    An instrument or a smear covers single frames of many recordings.

    Raises:
        SourceError: when there are more of these than may be absent, or nothing else.
    """
    empty = [
        index
        for index, (frame, mask) in enumerate(zip(frames, masks, strict=True))
        if frame.mask_file is not None and not mask.any()
    ]
    if empty:
        first = frames[empty[0]]
        if len(empty) == len(frames) or len(empty) > config.max_absent_share * len(frames):
            raise SourceError(
                f"the masks of {len(empty)} of {len(frames)} frames, this one first, leave no pixel; at most "
                f"{config.max_absent_share:.0%} may do so (ingest.max_absent_share)",
                file=first.mask_file,
                frame=first.label,
                field="mask",
            )
        logger.warning(
            "%s: the masks of %d of %d frames, this one first, leave no pixel; these frames are left out",
            first.mask_file,
            len(empty),
            len(frames),
        )
    return np.setdiff1d(np.arange(len(frames)), empty)


def _check_poses_of_all_or_none(source: SourceFrames) -> None:
    without = [frame for frame in source.frames if frame.world_from_camera is None]
    if 0 < len(without) < len(source.frames):
        there = len(source.frames) - len(without)
        raise SourceError(
            f"no world_from_camera for this frame, but for {there} of {len(source.frames)}; expected it for "
            "all frames or for none",
            file=source.pose_file,
            frame=without[0].label,
            field="world_from_camera",
        )


def _poses(frames: Sequence[PosedFrame], source: SourceFrames) -> Float[np.ndarray, "f 4 4"] | None:
    found = []
    for frame in frames:
        if frame.world_from_camera is not None:
            rigid = check_pose(frame.world_from_camera, frame=frame.label, file=source.pose_file)
            # What is rigid already stays as it is: projecting again would only turn its last digits.
            exact = np.allclose(rigid, frame.world_from_camera, rtol=0, atol=_EXACT_POSE)
            found.append(frame.world_from_camera if exact else rigid)
    return np.stack(found) if found else None


def _rolled(poses: Float[np.ndarray, "f 4 4"], rolls_rad: Sequence[float]) -> Float[np.ndarray, "f 4 4"]:
    """The poses of cameras whose images are turned about their axes."""
    if not any(rolls_rad):
        return poses
    turned = poses.copy()
    for pose, roll in zip(turned, rolls_rad, strict=True):
        pose[:3, :3] = pose[:3, :3] @ rotation_about(np.array([0.0, 0.0, 1.0]), roll).T
    return turned


def _frame_names(frames: Sequence[PosedFrame]) -> tuple[str, ...]:
    """Names without an image's suffix; folder, then suffix stay where names would otherwise meet."""
    named = [Path(frame.name) for frame in frames]
    bare = [name.with_suffix("") if name.suffix.lower() in COLOR_SUFFIXES else name for name in named]
    short = tuple(name.name for name in bare)
    if len(set(short)) == len(short):
        return short
    long = tuple(name.as_posix() for name in bare)
    return long if len(set(long)) == len(long) else tuple(name.as_posix() for name in named)


def _check_size(
    array: UInt8[np.ndarray, "h w 3"] | Bool[np.ndarray, "h w"] | Float[np.ndarray, "h w"],
    frame: PosedFrame,
    file: Path,
    field: str,
    intrinsics_file: Path | None,
) -> None:
    height, width = array.shape[:2]
    lens = frame.lens
    if (width, height) == (lens.width, lens.height):
        return
    if intrinsics_file is None:
        where = "in the first frame" if field == "rgb" else "the image"
        problem = f"{width} x {height} pixels; expected {lens.width} x {lens.height} as {where}"
        raise SourceError(problem, file=file, frame=frame.label, field=field)
    ratio = width / lens.width
    hint = (
        f"the intrinsics belong to images {1 / ratio:.3g} times as large; scale them or use those images"
        if abs(height / lens.height - ratio) < 0.01
        else "the proportions differ too: these intrinsics are of another camera or of an uncropped image"
    )
    raise SourceError(
        f"the image has {width} x {height} pixels, but {intrinsics_file.name} describes a camera of "
        f"{lens.width} x {lens.height}; {hint}",
        file=file,
        frame=frame.label,
        field="K",
    )


def _split(frames: Sequence[PosedFrame], source: SourceFrames, config: IngestConfig) -> Split:
    if all(frame.split is None for frame in frames):
        return every_nth(len(frames), config.holdout_every, file=source.pose_file)
    for frame in frames:
        if frame.split is None:
            raise SourceError(
                "found None; expected 'train' or 'test', in all frames or in none",
                file=source.pose_file,
                frame=frame.label,
                field="split",
            )
    index = np.arange(len(frames))
    is_test = np.array([frame.split == "test" for frame in frames])
    return Split(source.split_name, index[~is_test], index[is_test], source.split_version)
