"""C3VD and C3VDv2 as an `EndoscopicSequence`: one video, or two of a scene under a split manifest.

Two videos each have a world of their own. The training video's is kept; the other's poses are carried into it
by the motion between the coverage meshes. Every frame is resampled to one ideal pinhole (square pixels,
centred); lengths are millimetres, axes OpenCV's. Pixels count as valid where all of their footprint lies
inside the picture: inside the image, and off a dark frame round it where there is one (dark in every frame).

Vignetting and the difference in exposure between videos are left as they are.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.c3vd.coverage import Alignment, CoverageMesh, Surface, align, read_coverage_mesh
from data_catalog.c3vd.datasets import Dataset, Recording, RecordingPair, datasets
from data_catalog.c3vd.pinhole import PinholeResampling
from data_catalog.c3vd.video import Video, is_video
from data_catalog.content import view_mask
from data_catalog.formats import FolderFormat
from data_catalog.images import spread
from data_catalog.splits import every_nth
from data_catalog.visibility import observed_from_depth
from extrags.cameras import Cameras
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from extrags.events import Progress, emit
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["FORMAT", "open_recording", "pair_files", "read_pair"]

logger = logging.getLogger(__name__)

EVALUATES, TRAINS = 0, 1
# Interpolation at the edge of a dark frame reaches this far into it.
_FRAME_MARGIN_PX = 2


@dataclass(frozen=True)
class _Part:
    """Some frames of one video, in the world of the sequence."""

    video: Video
    chosen: list[int]
    world_from_own: Float[np.ndarray, "4 4"]
    role: int


def _read(folder: Path, config: IngestConfig, name: str) -> EndoscopicSequence:
    video = Video.open(folder)
    chosen = spread(len(video), config.max_frames)
    split = every_nth(len(chosen), config.holdout_every, file=folder)
    mesh = None if video.mesh_file is None else read_coverage_mesh(video.mesh_file)
    return _assembled(name, [_Part(video, chosen, np.eye(4), EVALUATES)], split, mesh, config, {})


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


FORMAT = FolderFormat(
    name="c3vd",
    version=1,
    summary="pose.txt with rgb/ and depth/ of C3VDv2, or with NNNN_color.png of C3VD",
    recognises=is_video,
    files=lambda folder: Video.open(folder).files(),
    read=_read,
    conventions="OpenCV camera axes, camera-to-world, mm; the world is the video's own. pose.txt is "
    "column-major as published, which is checked; z-depth, 16 bit over 100 mm, 0 and 65535 unknown",
    notes=_notes,
)


def open_recording(folder: Path, recording: Recording) -> Video:
    """A video whose number of frames is known.

    Raises:
        SourceError: another number of frames, so that a split manifest would mean other frames; and what
            `Video.open` raises.
    """
    dataset: Dataset = datasets()[recording.dataset]
    video = Video.open(folder, calibration=dataset.calibration, depth_range_mm=dataset.depth_range_mm)
    if len(video) != recording.frames:
        raise SourceError(
            f"{len(video)} frames (numbers {video.numbers[0]} to {video.numbers[-1]}); expected "
            f"{recording.frames} in {recording.name}. Is the download complete?",
            file=folder,
            field="rgb",
        )
    if not video.depth_files:
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
    """Every file that `read_pair` looks at, each with a name that does not depend on where it lies.

    Raises:
        SourceError: see `open_recording`.
    """
    train = open_recording(train_folder, pair.train)
    test = open_recording(test_folder, pair.test)
    listed = [("train", train, file) for file in train.files(pair.train_frames)]
    listed += [("test", test, file) for file in test.files()]
    return [(f"{role}/{file.relative_to(video.folder).as_posix()}", file) for role, video, file in listed]


def read_pair(
    train_folder: Path, test_folder: Path, pair: RecordingPair, config: IngestConfig
) -> EndoscopicSequence:
    """Two videos of one scene in one world: the training video's frames first, then the others.

    Args:
        train_folder: of the video that trains.
        test_folder: of the video that evaluates.
        pair: which frames of each.
        config: size, field of view, number of frames.

    Raises:
        SourceError: a file is wrong; names file, frame and field.
        ConfigError: a size the source cannot give.
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
    chosen = _thinned(list(pair.train_frames), list(range(len(test))), config.max_frames)
    parts = [
        _Part(train, chosen[0], np.eye(4), TRAINS),
        _Part(test, chosen[1], alignment.target_from_source, EVALUATES),
    ]
    split = Split(
        pair.setting,
        np.arange(len(chosen[0])),
        np.arange(len(chosen[0]), len(chosen[0]) + len(chosen[1])),
        pair.version,
    )
    truth = {"alignment": _alignment_json(alignment, pair)}
    return _assembled(pair.name, parts, split, train_mesh, config, truth)


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


def _assembled(
    name: str,
    parts: list[_Part],
    split: Split,
    mesh: CoverageMesh | None,
    config: IngestConfig,
    truth: dict[str, Any],
) -> EndoscopicSequence:
    """Read, resample and join; `mesh` stands in the world of the sequence."""
    total = sum(len(part.chosen) for part in parts)
    plan = _planned(parts[0], None, config)
    colours, depths, masks, poses, names, recording = [], [], [], [], [], []
    has_depth = all(part.video.depth_files for part in parts)
    reports = {}
    for part in parts:
        video, own_plan = part.video, _planned(part, plan, config)
        brightest = np.zeros((own_plan.camera.height, own_plan.camera.width, 3), dtype=np.uint8)
        for index in part.chosen:
            file, frame = video.colour_files[index], video.numbers[index]
            colour = video.colour(index)
            colours.append(own_plan.colour(colour, file=file, frame=frame))
            np.maximum(brightest, colour, out=brightest)
            if has_depth:
                depths.append(
                    own_plan.depth(video.depth_mm(index), file=video.depth_files[index], frame=frame)
                )
            poses.append(part.world_from_own @ video.world_from_camera[index])
            names.append(f"{video.folder.resolve().name}_{frame:04d}")
            emit(Progress("ingest", len(colours), total))
        mask = own_plan.mask(_inside_picture(brightest))
        masks += [mask] * len(part.chosen)
        recording += [part.role] * len(part.chosen)
        reports[video.folder.resolve().name] = {
            "camera": video.calibration,
            "pose_layout": video.layout,
            "masked_share": float(1 - mask.mean()),
        }
    cameras = Cameras(np.repeat(plan.K[None], total, axis=0), np.stack(poses), plan.width, plan.height)
    mask_stack = np.stack(masks)
    depth_mm = np.stack(depths) if has_depth else None
    return EndoscopicSequence(
        name=name,
        rgb=np.stack(colours),
        K=cameras.K,
        mask=mask_stack,
        split=split,
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth_mm,
        recording=np.asarray(recording, dtype=np.int64),
        frame_names=tuple(names),
        metric=True,
        observed=_observed(cameras, mask_stack, depth_mm, split, mesh),
        truth={"c3vd": {**truth, "recordings": reports}},
    )


def _planned(part: _Part, other: PinholeResampling | None, config: IngestConfig) -> PinholeResampling:
    """The grid of a video; to the pinhole of another where there is one already."""
    file = part.video.colour_files[part.chosen[0]]
    height, width = part.video.colour(part.chosen[0]).shape[:2]
    camera = part.video.camera.scaled(width, height, file=file)
    if other is None:
        return PinholeResampling.planned(camera, config)
    if other.camera == camera:
        return other
    return PinholeResampling.to_pinhole(camera, other.K, other.width, other.height)


def _observed(
    cameras: Cameras,
    mask: Bool[np.ndarray, "f h w"],
    depth_mm: Float[np.ndarray, "f h w"] | None,
    split: Split,
    mesh: CoverageMesh | None,
) -> Bool[np.ndarray, "f h w"] | None:
    """Exact where there is a surface, else from depth, else unknown."""
    if mesh is not None:
        return Surface(mesh).observed(cameras, mask, split.train, split.test)
    if depth_mm is not None:
        return observed_from_depth(cameras, depth_mm, split.train, split.test)
    return None


def _inside_picture(brightest: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """False in the dark frame round the picture and a margin of it."""
    import cv2

    inside = view_mask(brightest[None]).astype(np.uint8)
    size = 2 * _FRAME_MARGIN_PX + 1
    return np.asarray(cv2.erode(inside, np.ones((size, size), np.uint8))) > 0


def _alignment_json(alignment: Alignment, pair: RecordingPair) -> dict[str, Any]:
    return {
        "world": pair.train.stem,
        "moved": pair.test.stem,
        "residual_mm": alignment.residual_mm,
        "largest_residual_mm": alignment.largest_residual_mm,
    }
