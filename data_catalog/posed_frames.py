"""From frames with lens and pose to an `EndoscopicSequence`: what readers of posed formats share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.checks import check_depth, check_intrinsics, check_pose
from data_catalog.images import Resampling, read_colour, read_mask, spread
from data_catalog.lens import Lens, Undistortion
from data_catalog.splits import every_nth
from data_catalog.visibility import observed_from_depth
from extrags.cameras import Cameras
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.events import Progress, emit
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["PosedFrame", "assembled", "save_images"]


@dataclass(frozen=True)
class PosedFrame:
    """One frame on disk, its pose in OpenCV axes, camera to world.

    Args:
        name: as the format calls it, for messages.
        file: the colour image.
        lens: for the image as it lies on disk.
        world_from_camera: as read; checked by `assembled`.
        mask_file: None where there is none.
        depth_file: None where there is none.
        recording: index of the recording.
        split: None where the format names none.
    """

    name: str
    file: Path
    lens: Lens
    world_from_camera: Float[np.ndarray, "4 4"]
    mask_file: Path | None = None
    depth_file: Path | None = None
    recording: int = 0
    split: Literal["train", "test"] | None = None


def assembled(
    frames: Sequence[PosedFrame],
    config: IngestConfig,
    *,
    name: str,
    pose_file: Path,
    metric: bool,
    read_depth: Callable[[Path, str], Float[np.ndarray, "h w"]],
    white_is_tissue: bool = True,
    points: Float[np.ndarray, "p 3"] | None = None,
    points_rgb: UInt8[np.ndarray, "p 3"] | None = None,
) -> EndoscopicSequence:
    """Read images, undo lenses, shrink, and put everything into one sequence.

    Args:
        frames: all frames of the source, in order.
        config: size, frames and split.
        name: of the sequence.
        pose_file: named in errors about poses, intrinsics and the split.
        metric: whether lengths are millimetres.
        read_depth: file and frame name to z-depth in the sequence's unit, 0 where unknown.
        white_is_tissue: polarity of mask files.
        points: sparse points of the source.
        points_rgb: their colours.

    Raises:
        SourceError: a file is wrong or of another size than its camera; names file, frame and field.
        PoseError: a pose that is no rigid motion.
    """
    with_depth = [frame for frame in frames if frame.depth_file is not None]
    if with_depth and len(with_depth) != len(frames):
        lacking = next(frame for frame in frames if frame.depth_file is None)
        raise SourceError(
            f"no depth for this frame, but for {len(with_depth)} of {len(frames)}; "
            "expected it for all frames or for none",
            file=pose_file,
            frame=lacking.name,
            field="depth",
        )
    kept = [frames[index] for index in spread(len(frames), config.max_frames)]
    split = _split(kept, config, pose_file)
    plans: dict[Lens, tuple[Undistortion | None, Float[np.ndarray, "3 3"]]] = {}
    resampling: Resampling | None = None
    colours, masks, depths, intrinsics, poses = [], [], [], [], []
    for index, frame in enumerate(kept):
        poses.append(check_pose(frame.world_from_camera, frame=frame.name, file=pose_file))
        if frame.lens not in plans:
            check_intrinsics(
                frame.lens.K, frame.lens.width, frame.lens.height, frame=frame.name, file=pose_file
            )
            plan = (
                None if frame.lens.is_pinhole else Undistortion.planned(frame.lens, config.field_of_view_deg)
            )
            plans[frame.lens] = (plan, frame.lens.K if plan is None else plan.K)
        plan, K = plans[frame.lens]
        colour = read_colour(frame.file, frame=frame.name)
        _check_size(colour, frame, frame.file, "rgb", pose_file)
        if resampling is None:
            resampling = Resampling.planned(colour.shape[1], colour.shape[0], config)
        mask = np.ones(colour.shape[:2], dtype=bool)
        if frame.mask_file is not None:
            mask = read_mask(frame.mask_file, frame=frame.name) == white_is_tissue
            _check_size(mask, frame, frame.mask_file, "mask", pose_file)
        depth = None
        if frame.depth_file is not None:
            depth = read_depth(frame.depth_file, frame.name)
            check_depth(depth, frame=frame.name, file=frame.depth_file)
            _check_size(depth, frame, frame.depth_file, "depth", pose_file)
        if plan is not None:
            colour, mask = plan.colour(colour), plan.mask(mask)
            depth = None if depth is None else plan.depth(depth)
        colours.append(resampling.colour(colour, file=frame.file, frame=frame.name))
        masks.append(resampling.mask(mask, file=frame.mask_file, frame=frame.name))
        intrinsics.append(resampling.intrinsics(K))
        if depth is not None:
            depths.append(resampling.depth(depth, file=frame.depth_file, frame=frame.name))
        emit(Progress("ingest", index + 1, len(kept)))
    if resampling is None:
        raise SourceError("there is no frame", file=pose_file, field="frames")
    cameras = Cameras(np.stack(intrinsics), np.stack(poses), resampling.width, resampling.height)
    depth_mm = np.stack(depths) if depths else None
    return EndoscopicSequence(
        name=name,
        rgb=np.stack(colours),
        K=cameras.K,
        mask=np.stack(masks),
        split=split,
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth_mm,
        recording=np.array([frame.recording for frame in kept], dtype=np.int64),
        frame_names=_frame_names(kept),
        metric=metric,
        observed=(
            None if depth_mm is None else observed_from_depth(cameras, depth_mm, split.train, split.test)
        ),
        points=points,
        points_rgb=points_rgb,
    )


def save_images(sequence: EndoscopicSequence, folder: Path) -> list[str]:
    """Write colour images and masks of a sequence, as exporters do.

    Args:
        sequence: frames of several recordings go to folders of their own, unless their names say folders.
        folder: gets `images/NAME.png`, and `masks/NAME.png.png` (COLMAP's naming; white is tissue) where a
            mask leaves anything out.

    Returns:
        The names of the images below `images/`, one per frame.
    """
    from PIL import Image

    several = sequence.recording is not None and len(np.unique(sequence.recording)) > 1
    names = []
    for index in range(len(sequence)):
        name = sequence.frame_name(index)
        if several and sequence.recording is not None and "/" not in name:
            name = f"recording_{int(sequence.recording[index])}/{name}"
        names.append(f"{name}.png")
    masked = not sequence.mask.all()
    for index, name in enumerate(names):
        places = [(folder / "images" / name, Image.fromarray(sequence.rgb[index]))]
        if masked:
            white = (sequence.mask[index] * 255).astype(np.uint8)
            places.append((folder / "masks" / f"{name}.png", Image.fromarray(white)))
        for place, picture in places:
            place.parent.mkdir(parents=True, exist_ok=True)
            picture.save(place)
        emit(Progress("export", index + 1, len(names)))
    return names


def _frame_names(frames: Sequence[PosedFrame]) -> tuple[str, ...]:
    """Names without their suffix; the folder stays where names would otherwise meet."""
    short = tuple(Path(frame.name).stem for frame in frames)
    if len(set(short)) == len(short):
        return short
    return tuple(Path(frame.name).with_suffix("").as_posix() for frame in frames)


def _check_size(
    array: UInt8[np.ndarray, "h w 3"] | Bool[np.ndarray, "h w"] | Float[np.ndarray, "h w"],
    frame: PosedFrame,
    file: Path,
    field: str,
    pose_file: Path,
) -> None:
    height, width = array.shape[:2]
    if (width, height) == (frame.lens.width, frame.lens.height):
        return
    if field != "rgb":
        problem = f"{width} x {height} pixels; expected {frame.lens.width} x {frame.lens.height} as the image"
        raise SourceError(problem, file=file, frame=frame.name, field=field)
    ratio = width / frame.lens.width
    hint = (
        f"the intrinsics belong to images {1 / ratio:.3g} times as large; scale them or use those images"
        if abs(height / frame.lens.height - ratio) < 0.01
        else "the proportions differ too: these intrinsics are of another camera or of an uncropped image"
    )
    raise SourceError(
        f"the image has {width} x {height} pixels, but {pose_file.name} describes a camera of "
        f"{frame.lens.width} x {frame.lens.height}; {hint}",
        file=file,
        frame=frame.name,
        field="K",
    )


def _split(frames: Sequence[PosedFrame], config: IngestConfig, file: Path) -> Split:
    if all(frame.split is None for frame in frames):
        return every_nth(len(frames), config.holdout_every, file=file)
    index = np.arange(len(frames))
    is_test = np.array([frame.split == "test" for frame in frames])
    return Split("manifest", index[~is_test], index[is_test])
