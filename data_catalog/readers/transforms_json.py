"""Reader and writer of `transforms.json`, the format of nerfstudio and instant-ngp.

Read: `transform_matrix` (camera to world, OpenGL axes: y up, z backward; turned to OpenCV's on reading and
nothing else), `fl_x`, `fl_y` (pixels), `x_fov`, `y_fov` (degrees) or `camera_angle_x`, `camera_angle_y`
(radians; where one axis has none of the three, it has the focal length of the other), `cx`, `cy`, `w`, `h`,
`k1` to `k4`, `p1`, `p2`, `camera_model` or `is_fisheye`, each for all frames or in a frame of its own;
`file_path` (its suffix may be missing; frames without a file are left out, with a warning), `mask_path`
(white is tissue), `depth_file_path` or `depth_path` (of frames without one, or whose file is absent, depth is
unknown, with a warning);
`train_filenames`, `test_filenames` and `val_filenames` (frames in none of them are left out); `ply_file_path`
(points that are not finite are left out, with a warning). Where there is no such file but one for each split,
as `transforms_train.json`, these are read (`data_catalog.readers.transforms_files`). A `null` is as good as
no value. Other keys are passed over; a warning names those that look misspelt or tell of distortion. Images
of distorted cameras are resampled to a pinhole; a term of distortion that the camera's model has not is
refused, unless it is 0; so are instant-ngp's other cameras (`ftheta_p0` to `ftheta_p4`, `latlong`,
`equirectangular`).

Depth is z-depth; a value times `depth_unit_scale_factor` is in the unit of the poses. Where the file does not
say, that is nerfstudio's 0.001 (or, for integers, instant-ngp's `integer_depth_scale`). Files that
`depth_path` names, instant-ngp's key, are read where instant-ngp reads them: with an `integer_depth_scale`
above 0 (or that factor), and without `enable_depth_loading: false`. 0 is unknown.

Lengths: `length_unit` (a key of ours: `mm`, `m` or `arbitrary`) says what a pose's 1 is; without it the scale
is arbitrary. instant-ngp's `scale`, `offset` and `aabb_scale` and nerfstudio's `applied_transform` say how a
scene was put into a box; poses stand in the file after or before that consistently, so they change nothing.

Source: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from data_catalog.calibration_files import LENS_OF_POSES
from data_catalog.folder_reader import FolderReader
from data_catalog.images import (
    COLOR_SUFFIXES,
    image_entries,
    read_depth,
    save_images,
)
from data_catalog.inside import inside
from data_catalog.pose_conventions import OPENGL
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.beside_frames import frames_among, listed_files, tell_about_folders
from data_catalog.readers.frame_list import listed_split, matrix_of, present_frames
from data_catalog.readers.sparse_points import read_ply_points, write_ply_points
from data_catalog.readers.transforms_depth import (
    DEPTH_FILE_KEYS,
    DEPTH_KEYS,
    DEPTH_UNIT,
    NERFSTUDIO_DEPTH_SCALE,
    depth_factor,
    depth_files,
)
from data_catalog.readers.transforms_files import (
    SPLIT_LISTS,
    TRANSFORMS_FILE,
    holds_transforms,
    load_transforms,
)
from data_catalog.readers.transforms_lens import DISTORTION_KEYS, FOCAL_KEYS, StatedLens, stated_values
from data_catalog.readers.unknown_keys import warn_of_unknown_keys
from extrags.array_files import save_npy
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.frame_names import NameOrder, natural_key, order_for_fingerprint, tell_about_order
from extrags.sequence import EndoscopicSequence
from extrags.unusable_frames import of_split

__all__ = ["READER", "TRANSFORMS_FILE", "write_transforms"]

logger = logging.getLogger(__name__)

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "arbitrary": 1.0}
_FILE_KEYS = ("file_path", "mask_path", *DEPTH_FILE_KEYS)

_KEYS = (
    *("frames", "transform_matrix", "length_unit", *DEPTH_KEYS),
    *(*SPLIT_LISTS, "ply_file_path", *_FILE_KEYS),
    *("camera_model", "is_fisheye", "cx", "cy", "w", "h", *FOCAL_KEYS, *DISTORTION_KEYS),
)
"""What is read, of all frames or of one."""
_OTHER_KEYS = (
    *("scale", "offset", "aabb_scale", "applied_transform", "applied_scale", "orientation_override"),
    # Of a rolling shutter; the matrix of the frame as a whole stands beside them.
    *("transform_matrix_start", "transform_matrix_end", "normal_file_path"),
    *("lidar_file_path", "event_file_path", "thermal_file_path", "camera_id", "n_frames", "split_filenames"),
)
"""What programs write, what changes nothing here, and is spelt like a key that does."""


def _files(folder: Path) -> list[Path]:
    listed = load_transforms(folder)
    found = {file for file, _ in listed.parts}
    for entry in listed.content["frames"]:
        name = entry["file_path"]
        for key in _FILE_KEYS:
            if isinstance(entry.get(key), str):
                place = inside(folder, entry[key], file=listed.file_of[name], frame=name, field=key)
                found.add(_with_suffix(place))
    if isinstance(listed.content.get("ply_file_path"), str):
        name = listed.content["ply_file_path"]
        found.add(inside(folder, name, file=listed.file, field="ply_file_path"))
    return sorted(file for file in found if file.is_file())


def _chosen(folder: Path) -> dict[str, Any]:
    return order_for_fingerprint(load_transforms(folder).file_of)


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    transforms = load_transforms(folder)
    content, file, file_of = transforms.content, transforms.file, transforms.file_of
    unit = content.get("length_unit", "arbitrary")
    if not isinstance(unit, str) or unit not in _MM_PER_UNIT:
        raise SourceError(
            f"{unit!r} is no length unit known here; expected one of {', '.join(_MM_PER_UNIT)}",
            file=file,
            field="length_unit",
        )
    for part, held in transforms.parts:
        warn_of_unknown_keys(
            held, known=_KEYS, known_of_frames=_KEYS, frame_name="file_path", file=part, others=_OTHER_KEYS
        )
    scale = _MM_PER_UNIT[unit]
    order = NameOrder(file_of)
    listed = sorted(content["frames"], key=lambda entry: order.key(entry["file_path"]))
    tell_about_order(file, order)
    files = {}
    for entry in listed:
        name = entry["file_path"]
        files[name] = _with_suffix(inside(folder, name, file=file_of[name], frame=name, field="file_path"))
    _check_apart(files, "file_path", "the image is listed twice, as {}", file)
    present = present_frames(files, config.max_absent_share, listing=file)
    splits = transforms.splits or _splits(content, file)
    used = present & splits.keys() if splits else present
    entries = [entry for entry in listed if entry["file_path"] in used]
    folders = sorted({str(Path(entry["file_path"]).parent) for entry in entries}, key=natural_key)
    depth_file_of = depth_files(content, entries, file)
    frames = []
    for entry in entries:
        frame = entry["file_path"]
        place, listing = files[frame], file_of[frame]
        frames.append(
            PosedFrame(
                name=str(Path(frame).relative_to("images")) if frame.startswith("images/") else frame,
                file=place,
                lens=StatedLens(stated_values(content, entry), listing, frame).lens(place),
                world_from_camera=_pose(entry, scale, listing, frame),
                mask_file=_mask_file(listing, entry, frame),
                depth_file=depth_file_of[frame],
                recording=folders.index(str(Path(frame).parent)),
                split=splits.get(frame),
            )
        )
    depths = {frame.name: frame.depth_file for frame in frames if frame.depth_file is not None}
    _check_apart(depths, "depth_file_path", "the depth of {} as well; expected one file for each frame", file)
    if not depths:
        tell_about_folders(folder, "depth", "no frame names a file in it (depth_file_path)")
    if not any(frame.mask_file for frame in frames):
        tell_about_folders(folder, "mask", "no frame names a file in it (mask_path)")
    _tell_about_unlisted(file, frames, files.values())
    points, points_rgb = _points(folder, content, file)

    def depth_of(depth_file: Path, frame: str | int) -> Float[np.ndarray, "h w"]:
        factor = depth_factor(content, depth_file, file) * scale
        return (read_depth(depth_file, frame=frame) * factor).astype(np.float32)

    return SourceFrames(
        frames,
        pose_file=file,
        metric=unit != "arbitrary",
        intrinsics_file=file,
        read_depth=depth_of,
        points=None if points is None else points * scale,
        points_rgb=points_rgb,
        lens_stays=LENS_OF_POSES,
    )


READER = FolderReader(
    name="transforms",
    version=8,
    summary=f"{TRANSFORMS_FILE} of nerfstudio or instant-ngp, or transforms_train.json and its like, "
    "described in data_catalog/readers/transforms_json.py",
    recognises=holds_transforms,
    files=_files,
    frames=_frames,
    conventions="OpenGL camera axes (y up, z backward, turned on reading), camera to world; "
    "depth in thousandths of the pose unit unless it says otherwise",
    chosen=_chosen,
    poses=OPENGL,
    depth_unit=DEPTH_UNIT,
)


def write_transforms(
    sequence: EndoscopicSequence,
    folder: Path,
    *,
    points: Float[np.ndarray, "p 3"] | None = None,
    points_rgb: UInt8[np.ndarray, "p 3"] | None = None,
) -> None:
    """Write a posed sequence as `transforms.json` with its images, masks, depth and points.

    Numbers keep all their digits. Depth is written as float `.npy` in thousandths of the pose unit, which is
    what nerfstudio expects; `length_unit` says what that unit is. Held-out frames are those of `test` and of
    `val`; where there are none, no list is written. Frames of neither part of the split are not written.

    Args:
        sequence: with poses.
        folder: made if need be.
        points: sparse points in world coordinates; None takes the sequence's own.
        points_rgb: their colours.

    Raises:
        ShapeError: while the sequence has no poses.
    """
    sequence = of_split(sequence)
    cameras = sequence.cameras
    if points is None:
        points, points_rgb = sequence.points, sequence.points_rgb
    names = save_images(sequence, folder)
    masked = not sequence.mask.all()
    frames = []
    for index, image in enumerate(names):
        K = cameras.K[index]
        pose = cameras.world_from_camera[index] @ _OPENCV_FROM_OPENGL
        entry: dict[str, Any] = {"file_path": f"images/{image}"}
        entry |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        entry |= {"w": sequence.width, "h": sequence.height}
        if masked:
            entry["mask_path"] = f"masks/{image}.png"
        if sequence.depth_mm is not None:
            entry["depth_file_path"] = f"depth/{Path(image).with_suffix('.npy').as_posix()}"
            place = folder / entry["depth_file_path"]
            place.parent.mkdir(parents=True, exist_ok=True)
            # In double precision, so that only the reader rounds.
            save_npy(place, sequence.depth_mm[index].astype(np.float64) / NERFSTUDIO_DEPTH_SCALE)
        frames.append({**entry, "transform_matrix": pose.tolist()})
    content: dict[str, Any] = {
        "camera_model": "PINHOLE" if sequence.lens is None else "OPENCV_FISHEYE",
        "length_unit": "mm" if sequence.metric else "arbitrary",
        "frames": frames,
    }
    if sequence.lens is not None:
        # nerfstudio goes by `camera_model`, and instant-ngp by this.
        content["is_fisheye"] = True
        content |= dict(zip(("k1", "k2", "k3", "k4"), sequence.lens.coefficients, strict=True))
    if len(sequence.test):
        # nerfstudio evaluates on `val` while it trains and on `test` afterwards, and fails where a list is
        # empty; without any list it makes a split of its own.
        for name, indices in (("train", sequence.train), ("val", sequence.test), ("test", sequence.test)):
            content[f"{name}_filenames"] = [frames[int(index)]["file_path"] for index in indices]
    if points is not None:
        content["ply_file_path"] = "points.ply"
        write_ply_points(folder / "points.ply", points, points_rgb)
    (folder / TRANSFORMS_FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _with_suffix(file: Path) -> Path:
    """The image a path means: the synthetic NeRF scenes leave `.png` out."""
    if file.is_file() or file.suffix.lower() in COLOR_SUFFIXES:
        return file
    candidates = (file.with_name(file.name + suffix) for suffix in COLOR_SUFFIXES)
    return next((candidate for candidate in candidates if candidate.is_file()), file)


def _check_apart(files: Mapping[str, Path], field: str, problem: str, file: Path) -> None:
    """Refuse a file that two frames name, by whatever path.

    Raises:
        SourceError: names the second frame.
    """
    owner: dict[Path, str] = {}
    for frame, place in files.items():
        first = owner.setdefault(place, frame)
        if first != frame:
            raise SourceError(problem.format(first), file=file, frame=frame, field=field)


def _tell_about_unlisted(file: Path, frames: list[PosedFrame], listed: Collection[Path]) -> None:
    """Warn of images beside those of the frames that the file does not list."""
    known = {*listed, *(place for frame in frames for place in (frame.mask_file, frame.depth_file) if place)}
    places = sorted({frame.file.parent for frame in frames})
    beside = [image for place in places for image in frames_among(image_entries(place))[0]]
    unlisted = [image for image in beside if image not in known]
    if unlisted:
        logger.warning(
            "%s: %d of %d images beside those of its frames are not listed, and left out: %s",
            file,
            len(unlisted),
            len(beside),
            listed_files(unlisted),
        )


def _mask_file(listing: Path, entry: dict[str, Any], frame: str) -> Path | None:
    if "mask_path" not in entry:
        return None
    file = inside(listing.parent, str(entry["mask_path"]), file=listing, frame=frame, field="mask_path")
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file, frame=frame, field="mask_path")
    return file


def _pose(entry: dict[str, Any], scale: float, file: Path, frame: str) -> Float[np.ndarray, "4 4"]:
    rows = entry.get("transform_matrix")
    if isinstance(rows, list) and len(rows) == 3:
        entry = {**entry, "transform_matrix": [*rows, [0, 0, 0, 1.0]]}
    matrix = matrix_of(entry, "transform_matrix", 4, file=file, frame=frame, error=PoseError)
    # Turned to other axes, one entry becomes several, of another matrix.
    wrong = int((~np.isfinite(matrix)).sum())
    if wrong:
        raise PoseError(
            f"{wrong} of {matrix.size} entries are NaN or infinite",
            file=file,
            frame=frame,
            field="transform_matrix",
        )
    pose = matrix @ _OPENCV_FROM_OPENGL
    pose[:3, 3] *= scale
    return pose


def _splits(content: dict[str, Any], file: Path) -> dict[str, Literal["train", "test"]]:
    """Splits by `file_path`; empty where the file names none. Validation frames are held out too."""
    known = {entry["file_path"] for entry in content["frames"]}
    listed: dict[str, list[str]] = {}
    for key in SPLIT_LISTS:
        named = content.get(key) or []
        if not isinstance(named, list) or not all(isinstance(name, str) for name in named):
            raise SourceError("expected a list of file names", file=file, field=key)
        listed[key] = [name if name in known else name.replace("\\", "/") for name in named]
    held_out = [name for key in ("test_filenames", "val_filenames") for name in listed[key] if name]
    training = listed["train_filenames"]
    for name in [*held_out, *sorted(training, key=natural_key)]:
        if name not in known:
            raise SourceError(
                "the split names this frame, but `frames` does not", file=file, frame=name, field="split"
            )
    return listed_split(known, training or None, held_out or None, file=file)


def _points(
    folder: Path, content: dict[str, Any], file: Path
) -> tuple[Float[np.ndarray, "p 3"] | None, UInt8[np.ndarray, "p 3"] | None]:
    if "ply_file_path" not in content:
        return None, None
    place = inside(folder, str(content["ply_file_path"]), file=file, field="ply_file_path")
    if not place.is_file():
        raise SourceNotFoundError("no such file", file=place, field="ply_file_path")
    return read_ply_points(place, field="ply_file_path")
