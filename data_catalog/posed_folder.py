"""Reader of extrags' own folder format: the simplest way to bring frames with poses.

::

    my_sequence/
        poses.json
        rgb/0000.png ...          8-bit colour (PNG, JPEG, ...)
        depth/0000.npy ...        optional: z-depth in the length unit, float `.npy`, or TIFF; 0 = unknown
        mask/0000.png ...         optional: white is tissue

`poses.json`::

    {
      "length_unit": "mm",                     or "arbitrary"
      "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],   for all frames, or "K" in each frame
      "frames": [
        {"file": "rgb/0000.png",
         "world_from_camera": [[...4], [...4], [...4], [0, 0, 0, 1]],
         "split": "train",                     optional: "train" or "test"
         "recording": 0},                      optional
        ...
      ]
    }

Camera axes are OpenCV's (x right, y down, z forward), matrices map camera to world, row by row; K is in
pixels of the files with pixel centres at +0.5. Every image in `rgb/` needs an entry, every entry an image.
Depth is looked for as `depth/<stem>.npy|.tiff|.tif|.png`, for all frames or for none. Frames without `split`
are split by holding out every n-th. Nothing is turned or scaled; where depth shows that the poses are in
other axes, the sequence is refused and the axes that fit are named.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from data_catalog.checks import check_depth, check_intrinsics, check_pose
from data_catalog.formats import FolderFormat
from data_catalog.images import Resampling, colour_files, read_colour, read_depth, read_mask, spread
from data_catalog.splits import every_nth
from data_catalog.visibility import observed_from_depth
from extrags.cameras import Cameras
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["FORMAT", "POSES_FILE"]

POSES_FILE = "poses.json"
_DEPTH_SUFFIXES = (".npy", ".tiff", ".tif", ".png")
_LENGTH_UNITS = ("mm", "arbitrary")


def _recognises(folder: Path) -> bool:
    return (folder / POSES_FILE).is_file()


def _files(folder: Path) -> list[Path]:
    inside = [
        file
        for part in ("rgb", "depth", "mask")
        if (folder / part).is_dir()
        for file in (folder / part).iterdir()
    ]
    return sorted(file for file in [folder / POSES_FILE, *inside] if file.is_file())


def _read(folder: Path, config: IngestConfig, name: str) -> EndoscopicSequence:
    file = folder / POSES_FILE
    content = _load(file)
    frames = content["frames"]
    _check_count(folder, frames)
    metric = content.get("length_unit", "mm") == "mm"
    depth_files = _depth_files(folder, frames)
    kept = spread(len(frames), config.max_frames)

    colours, intrinsics, poses, masks, depths = [], [], [], [], []
    resampling: Resampling | None = None
    for index in kept:
        entry = frames[index]
        frame = entry["file"]
        poses.append(
            check_pose(_matrix(entry, "world_from_camera", (4, 4), file, frame), frame=frame, file=file)
        )
        K = _matrix(entry if "K" in entry else content, "K", (3, 3), file, frame)
        colour = read_colour(folder / frame, frame=frame)
        if resampling is None:
            resampling = Resampling.planned(colour.shape[1], colour.shape[0], config)
        check_intrinsics(K, resampling.source_width, resampling.source_height, frame=frame, file=file)
        colours.append(resampling.colour(colour, file=folder / frame, frame=frame))
        intrinsics.append(resampling.intrinsics(K))
        mask_file = folder / "mask" / f"{Path(frame).stem}.png"
        mask = read_mask(mask_file, frame=frame) if mask_file.is_file() else np.ones(colour.shape[:2], bool)
        masks.append(resampling.mask(mask, file=mask_file, frame=frame))
        if depth_files:
            depth = read_depth(depth_files[index], frame=frame)
            # Before shrinking, so that row, column and count are those of the file.
            check_depth(depth, frame=frame, file=depth_files[index])
            depths.append(resampling.depth(depth, file=depth_files[index], frame=frame))
    if resampling is None:
        raise SourceError("the list of frames is empty", file=file, field="frames")
    cameras = Cameras(np.stack(intrinsics), np.stack(poses), resampling.width, resampling.height)
    depth_mm = np.stack(depths) if depths else None
    split = _split([frames[index] for index in kept], config, file)
    return EndoscopicSequence(
        name=name,
        rgb=np.stack(colours),
        K=cameras.K,
        mask=np.stack(masks),
        split=split,
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth_mm,
        recording=np.array([int(frames[index].get("recording", 0)) for index in kept], dtype=np.int64),
        frame_names=tuple(Path(frames[index]["file"]).stem for index in kept),
        metric=metric,
        observed=(
            None if depth_mm is None else observed_from_depth(cameras, depth_mm, split.train, split.test)
        ),
    )


FORMAT = FolderFormat(
    name="extrags",
    version=1,
    summary=f"{POSES_FILE} with rgb/ (and depth/, mask/), described in data_catalog/posed_folder.py",
    recognises=_recognises,
    files=_files,
    read=_read,
    conventions="OpenCV camera axes, camera to world, pixel centres at +0.5; z-depth",
)


def _load(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SourceError(f"not readable as JSON: {error}", file=file) from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise SourceError("expected an object with a list `frames`", file=file, field="frames")
    if not content["frames"]:
        raise SourceError("the list of frames is empty", file=file, field="frames")
    unit = content.get("length_unit", "mm")
    if unit not in _LENGTH_UNITS:
        raise SourceError(
            f"{unit!r} is no length unit known here; expected one of {', '.join(_LENGTH_UNITS)}",
            file=file,
            field="length_unit",
        )
    for index, entry in enumerate(content["frames"]):
        if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
            raise SourceError("expected an object with `file`", file=file, frame=index, field="file")
    return content


def _check_count(folder: Path, frames: list[dict[str, Any]]) -> None:
    listed = [entry["file"] for entry in frames]
    if len(set(listed)) != len(listed):
        twice = next(name for name in listed if listed.count(name) > 1)
        raise SourceError("the frame is listed twice", file=folder / POSES_FILE, frame=twice, field="file")
    for name in listed:
        if not (folder / name).is_file():
            raise SourceNotFoundError(
                f"{POSES_FILE} lists this frame, but there is no such file",
                file=folder / name,
                frame=name,
                field="file",
            )
    images = folder / "rgb"
    present = [f"rgb/{file.name}" for file in colour_files(images)] if images.is_dir() else []
    extra = [name for name in present if name not in set(listed)]
    if extra:
        raise PoseError(
            f"{len(listed)} poses for {len(present)} images in rgb/: this image has none",
            file=folder / POSES_FILE,
            frame=extra[0],
            field="world_from_camera",
        )


def _matrix(
    owner: dict[str, Any], field: str, shape: tuple[int, int], file: Path, frame: str
) -> Float[np.ndarray, "r c"]:
    kind = PoseError if field == "world_from_camera" else SourceError
    if field not in owner:
        raise kind(
            f"no {field}; expected {shape[0]} x {shape[1]} numbers", file=file, frame=frame, field=field
        )
    try:
        matrix = np.asarray(owner[field], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise kind(f"not a matrix of numbers: {error}", file=file, frame=frame, field=field) from error
    if matrix.shape != shape:
        raise kind(
            f"found shape {matrix.shape}; expected {shape[0]} rows of {shape[1]} numbers",
            file=file,
            frame=frame,
            field=field,
        )
    return matrix


def _depth_files(folder: Path, frames: list[dict[str, Any]]) -> list[Path]:
    if not (folder / "depth").is_dir():
        return []
    found = []
    for entry in frames:
        stem = Path(entry["file"]).stem
        candidates = [folder / "depth" / f"{stem}{suffix}" for suffix in _DEPTH_SUFFIXES]
        existing = next((file for file in candidates if file.is_file()), None)
        if existing is None:
            raise SourceNotFoundError(
                "no depth for this frame; expected it for all frames, or no folder depth/ at all",
                file=candidates[0],
                frame=entry["file"],
                field="depth",
            )
        found.append(existing)
    return found


def _split(frames: list[dict[str, Any]], config: IngestConfig, file: Path) -> Split:
    named = [entry.get("split") for entry in frames]
    if all(value is None for value in named):
        return every_nth(len(frames), config.holdout_every, file=file)
    for entry, value in zip(frames, named, strict=True):
        if value not in ("train", "test"):
            raise SourceError(
                f"found {value!r}; expected 'train' or 'test', in all frames or in none",
                file=file,
                frame=entry["file"],
                field="split",
            )
    index = np.arange(len(frames))
    is_test = np.array([value == "test" for value in named])
    return Split("manifest", index[~is_test], index[is_test])
