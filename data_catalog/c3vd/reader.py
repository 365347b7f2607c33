"""C3VD and C3VDv2 as an `EndoscopicSequence`: one video, or two of a scene under a split manifest.

Two videos each have a world of their own. The training video's is kept; the other's poses are carried into it
by the motion between the coverage meshes. Every frame is resampled to one ideal pinhole (square pixels,
centred); lengths are millimetres, axes OpenCV's. Pixels count as valid where all of their footprint lies
inside the picture: inside the image, and off a dark frame round it where there is one (dark in every frame).

Vignetting and the difference in exposure between videos are left as they are.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.c3vd.coverage import Alignment, CoverageMesh, Surface, align, read_coverage_mesh
from data_catalog.c3vd.pinhole import PinholeResampling, own_pixels
from data_catalog.c3vd.published import PublishedSet, Recording, RecordingPair, find_recording, published_sets
from data_catalog.c3vd.scaramuzza import ScaramuzzaCamera
from data_catalog.c3vd.video import CALIBRATION_FILE, POSE_FILE, Video, is_video, read_depth_mm
from data_catalog.content import view_mask
from data_catalog.folder_reader import FolderReader
from data_catalog.images import image_size, spread
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.sampling import Sampling
from extrags.cameras import Cameras
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from extrags.observed_surface import observed_by_depth
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["READER", "open_recording", "pair_files", "pair_frames"]

logger = logging.getLogger(__name__)

EVALUATES, TRAINS = 0, 1
_FRAME_MARGIN_PX = 2
"""Of a dark frame, beside it: its edge is blurred."""


@dataclass(frozen=True)
class _Part:
    """Some frames of one video, in the world of the sequence."""

    video: Video
    chosen: Sequence[int]
    world_from_own: Float[np.ndarray, "4 4"]
    role: int
    split: Literal["train", "test"] | None = None

    def frames(self) -> list[PosedFrame]:
        """The frames, of a lens for images as large as the first."""
        video, folder = self.video, self.video.folder.resolve().name
        first = video.color_files[self.chosen[0]]
        camera = video.camera.scaled(*image_size(first, frame=video.numbers[self.chosen[0]]), file=first)
        return [
            PosedFrame(
                name=f"{folder}_{video.numbers[index]:04d}",
                file=video.color_files[index],
                lens=camera,
                world_from_camera=self.world_from_own @ video.world_from_camera[index],
                depth_file=video.depth_files[index] if video.depth_files else None,
                recording=self.role,
                split=self.split,
                number=video.numbers[index],
            )
            for index in self.chosen
        ]


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    video = Video.open(folder)
    mesh = None if video.mesh_file is None else read_coverage_mesh(video.mesh_file)
    return _source_frames([_Part(video, range(len(video)), np.eye(4), EVALUATES)], mesh, {})


def _outline(folder: Path, config: IngestConfig) -> SourceFrames:
    """The same without the mesh, which takes a second or more to read."""
    video = Video.open(folder)
    return _source_frames([_Part(video, range(len(video)), np.eye(4), EVALUATES)], None, {})


def _notes(folder: Path) -> tuple[str, ...]:
    video = Video.open(folder)
    depth = "with" if video.depth_files else "without"
    mesh = "no coverage_mesh.obj: observed surface from depth alone"
    if video.mesh_file is not None:
        share = read_coverage_mesh(video.mesh_file).observed_share
        mesh = f"{share:.0%} of the surface's faces seen by the video"
    return (
        f"camera: {video.calibration}, for {video.camera.width} x {video.camera.height} pixels",
        f"poses: {video.layout}",
        f"frames: {video.numbers[0]} to {video.numbers[-1]}, {depth} depth",
        mesh,
    )


def _known_name(folder: Path) -> str | None:
    video = find_recording(folder.name)
    return None if video is None else video.name


def _chosen(folder: Path) -> dict[str, Any]:
    """The published camera, which may go by the folder's name; one of the video's own is among its files."""
    calibration = Video.open(folder).calibration
    return {} if calibration == CALIBRATION_FILE else {"calibration": calibration}


READER = FolderReader(
    name="c3vd",
    version=1,
    summary="pose.txt with rgb/ and depth/ of C3VDv2, or with NNNN_color.png of C3VD",
    recognises=is_video,
    files=lambda folder: Video.open(folder).files(),
    frames=_frames,
    conventions="OpenCV camera axes, camera-to-world, mm; the world is the video's own. pose.txt is "
    "column-major as published, which is checked; z-depth, 16 bit over 100 mm, 0 and 65535 unknown",
    notes=_notes,
    known_name=_known_name,
    chosen=_chosen,
    outline=_outline,
)


def open_recording(folder: Path, recording: Recording) -> Video:
    """A video whose number of frames is known.

    Of an unregistered one the camera is `calibration.json`'s, else C3VDv2's (said in a warning), and depth
    may be lacking.

    Raises:
        SourceError: another number of frames, so that a split manifest would mean other frames; and what
            `Video.open` raises.
    """
    dataset: PublishedSet | None = published_sets().get(recording.dataset)
    if dataset is None:
        video = Video.open(folder)
        if video.calibration != CALIBRATION_FILE:
            logger.warning("%s: no %s, taken for the camera %s", folder, CALIBRATION_FILE, video.calibration)
    else:
        video = Video.open(folder, calibration=dataset.calibration, depth_range_mm=dataset.depth_range_mm)
    if len(video) != recording.frames:
        raise SourceError(
            f"{len(video)} frames (numbers {video.numbers[0]} to {video.numbers[-1]}); expected "
            f"{recording.frames} in {recording.name}. Is the download complete?",
            file=folder,
            field="rgb",
        )
    if not video.depth_files and dataset is not None:
        raise SourceNotFoundError(
            f"no depth; {recording.name} is published with it", file=folder / "depth", field="depth"
        )
    if video.mesh_file is None:
        raise SourceNotFoundError(
            "no such file, and only it tells how the worlds of two videos lie to each other",
            file=folder / "coverage_mesh.obj",
            field="coverage",
        )
    return video


def pair_files(train_folder: Path, test_folder: Path, pair: RecordingPair) -> list[tuple[str, Path]]:
    """Every file that `pair_frames` looks at, each with a name that does not depend on where it lies.

    Raises:
        SourceError: see `open_recording`.
    """
    train = open_recording(train_folder, pair.train)
    test = open_recording(test_folder, pair.test)
    listed = [("train", train, file) for file in train.files(pair.train_frames)]
    listed += [("test", test, file) for file in test.files()]
    return [(f"{role}/{file.relative_to(video.folder).as_posix()}", file) for role, video, file in listed]


def pair_frames(
    train_folder: Path, test_folder: Path, pair: RecordingPair, config: IngestConfig
) -> SourceFrames:
    """Two videos of one scene in one world: the training video's frames first, then the others.

    Args:
        train_folder: of the video that trains.
        test_folder: of the video that evaluates.
        pair: which frames of each.
        config: number of frames.

    Raises:
        SourceError: a file is wrong; names file, frame and field.
    """
    train = open_recording(train_folder, pair.train)
    test = open_recording(test_folder, pair.test)
    train_mesh = read_coverage_mesh(_mesh_file(train))
    test_mesh = read_coverage_mesh(_mesh_file(test))
    alignment = align(test_mesh, train_mesh, source_file=test.mesh_file, target_file=train.mesh_file)
    logger.info(
        "%s: %s aligned to %s by %d vertices, residual %.4f mm (largest %.4f mm)",
        pair.name,
        pair.test.stem,
        pair.train.stem,
        len(train_mesh.vertices),
        alignment.residual_mm,
        alignment.largest_residual_mm,
    )
    train_chosen, test_chosen = _thinned(list(pair.train_frames), list(range(len(test))), config.max_frames)
    parts = [
        _Part(train, train_chosen, np.eye(4), TRAINS, "train"),
        _Part(test, test_chosen, alignment.target_from_source, EVALUATES, "test"),
    ]
    frames = _source_frames(parts, train_mesh, {"alignment": _alignment_json(alignment, pair)})
    return replace(frames, split_name=pair.setting, split_version=pair.version)


def _mesh_file(video: Video) -> Path:
    return video.mesh_file or video.folder / "coverage_mesh.obj"


def _thinned(train: list[int], test: list[int], at_most: int | None) -> tuple[list[int], list[int]]:
    """At most so many frames, spread evenly; both videos keep their share, at least one frame each."""
    total = len(train) + len(test)
    if at_most is None or total <= at_most:
        return train, test
    n_train = int(np.clip(round(at_most * len(train) / total), 1, at_most - 1))
    n_test = min(at_most - n_train, len(test))
    return [train[k] for k in spread(len(train), n_train)], [test[k] for k in spread(len(test), n_test)]


def _source_frames(parts: list[_Part], mesh: CoverageMesh | None, truth: dict[str, Any]) -> SourceFrames:
    """The frames of all parts; `mesh` stands in the world of the sequence."""
    depth_range_mm = parts[0].video.depth_range_mm
    frames = [frame for part in parts for frame in part.frames()]
    return SourceFrames(
        frames=frames,
        pose_file=parts[0].video.folder / POSE_FILE,
        metric=True,
        read_depth=lambda file, frame: read_depth_mm(file, frame, depth_range_mm),
        masks=_DarkFrameMask(),
        sampling=_sampling,
        observed=observed_by_depth if mesh is None else partial(_observed_on, Surface(mesh)),
        lens_stays="State the camera of scenes of your own in a calibration.json beside the frames",
        truth=lambda sequence: {"c3vd": {**truth, "recordings": _reports(parts, sequence)}},
    )


def _sampling(camera: ScaramuzzaCamera, config: IngestConfig, first: Sampling | None) -> Sampling:
    """The grid of a video; to the pinhole of the first where there is one already."""
    if config.lens == "native":
        return own_pixels(camera, config, first)
    if first is None:
        return PinholeResampling.planned(camera, config)
    return PinholeResampling.to_pinhole(camera, first.K, first.width, first.height)


class _DarkFrameMask:
    """False in the dark frame round a video's picture, and a margin of it."""

    def __init__(self) -> None:
        self._brightest: dict[int, UInt8[np.ndarray, "h w 3"]] = {}

    def see(
        self, frame: PosedFrame, image: UInt8[np.ndarray, "h w 3"], sampled: UInt8[np.ndarray, "h2 w2 3"]
    ) -> None:
        """Keep the brightest value that each pixel of a recording took."""
        brightest = self._brightest.setdefault(frame.recording, np.zeros_like(image))
        np.maximum(brightest, image, out=brightest)

    def mask(self, frame: PosedFrame, sampling: Sampling) -> Bool[np.ndarray, "h2 w2"]:
        """The mask of a frame's recording."""
        import cv2

        inside = view_mask(self._brightest[frame.recording][None])
        if not isinstance(sampling, PinholeResampling):
            # A pinhole's grid keeps as far from the frame by itself: interpolation reaches into it.
            size = 2 * _FRAME_MARGIN_PX + 1
            inside = np.asarray(cv2.erode(inside.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
        return sampling.mask(inside)


def _observed_on(
    surface: Surface,
    cameras: Cameras,
    mask: Bool[np.ndarray, "f h w"],
    depth_mm: Float[np.ndarray, "f h w"] | None,
    split: Split,
) -> Bool[np.ndarray, "f h w"]:
    """Exact: by rays onto the surface that comes with the video."""
    return surface.observed(cameras, mask, split.train, split.test)


def _reports(parts: list[_Part], sequence: EndoscopicSequence) -> dict[str, Any]:
    """What was found out about each video."""
    reports = {}
    for part in parts:
        ours = sequence.mask if sequence.recording is None else sequence.mask[sequence.recording == part.role]
        reports[part.video.folder.resolve().name] = {
            "camera": part.video.calibration,
            "pose_layout": part.video.layout,
            # One mask for all frames of a video.
            "masked_share": float(1 - ours[0].mean()),
        }
    return reports


def _alignment_json(alignment: Alignment, pair: RecordingPair) -> dict[str, Any]:
    return {
        "world": pair.train.stem,
        "moved": pair.test.stem,
        "residual_mm": alignment.residual_mm,
        "largest_residual_mm": alignment.largest_residual_mm,
    }
