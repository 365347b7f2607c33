"""Reader of extrags' own folder format: the simplest way to bring frames with poses.

::

    my_sequence/
        poses.json
        rgb/0000.png ...          8-bit colour (PNG, JPEG, ...)
        depth/0000.npy ...        optional: z-depth in the length unit, `.npy`, TIFF or PNG; 0 = unknown
        mask/0000.png ...         optional: white is tissue

`poses.json`::

    {
      "length_unit": "mm",                     or "arbitrary"; "mm" where it is absent, which the log says
      "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],   for all frames, or "K" in each frame
      "frames": [
        {"file": "rgb/0000.png",
         "world_from_camera": [[...4], [...4], [...4], [0, 0, 0, 1]],
         "split": "train",                     optional: "train" or "test"
         "recording": 0},                      optional
        ...
      ]
    }

Other keys are passed over with a warning, except those that begin with `_` or `/`, which are remarks. Keys
that tell of distortion are refused where it is not zero.

Camera axes are OpenCV's (x right, y down, z forward), matrices map camera to world, row by row; K is in
pixels of the files with pixel centres at +0.5. Every image in `rgb/` needs an entry, every entry an image.
Numbers of depth files are lengths as they are: a level of integers, as in a PNG, is one whole unit, which is
coarse beside the few centimetres that an endoscope sees.
Depth is looked for as `depth/<name>.npy|.tiff|.tif|.png`, and masks as `mask/<name>` with the suffix of any
image, in upper or lower case; <name> is the path below `rgb/`, else its last part, without suffix. No two
frames share a file. Frames without a mask are tissue throughout, and depth of frames without a file is
unknown, which the log says. A frame's `file` may be absolute, or go through `..`, where it leads to a file
below the folder. Frames without `split` are split by holding out every n-th. Nothing is turned or scaled;
where depth shows that the poses are in other axes, the sequence is refused and the axes that fit are named.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from data_catalog.checks import check_intrinsics
from data_catalog.folder_reader import FolderReader
from data_catalog.images import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    color_files,
    depth_suffixes_in_words,
    image_size,
)
from data_catalog.inside import inside
from data_catalog.lens_entries import check_pinhole
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.beside_frames import tell_about_folders
from data_catalog.readers.frame_list import FilesBeside, load_frame_list, matrix_of, warn_of_unmasked
from data_catalog.readers.unknown_keys import warn_of_unknown_keys
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.lens import Lens

__all__ = ["POSES_FILE", "READER"]

logger = logging.getLogger(__name__)

POSES_FILE = "poses.json"
_LENGTH_UNITS = ("mm", "arbitrary")
_KEYS = ("frames", "K", "length_unit")
_KEYS_OF_FRAMES = ("file", "world_from_camera", "K", "split", "recording")
_OTHER_LENSES = (
    "Undistort the images, or give frames and poses as a transforms.json or a COLMAP model, which describe "
    "lenses with distortion"
)
_LARGEST_RECORDING = 1_000_000


def _recognises(folder: Path) -> bool:
    return (folder / POSES_FILE).is_file()


def _files(folder: Path) -> list[Path]:
    content = _load(folder)
    # Absent images are refused on reading; nothing is read beside them.
    names = [entry["file"] for entry in content["frames"] if (folder / entry["file"]).is_file()]
    beside = _beside(folder, "depth", names, DEPTH_SUFFIXES) + _beside(folder, "mask", names, COLOR_SUFFIXES)
    found = {folder / POSES_FILE, *(folder / name for name in names), *(file for file in beside if file)}
    return sorted(found)


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    file = folder / POSES_FILE
    content = _load(folder)
    entries = content["frames"]
    _check_count(folder, entries)
    _check_splits(entries, file)
    for frame, described in ((None, content), *((entry["file"], entry) for entry in entries)):
        further = {name: described[name] for name in described if name not in (*_KEYS, *_KEYS_OF_FRAMES)}
        check_pinhole(further, _OTHER_LENSES, file=file, frame=frame)
    warn_of_unknown_keys(content, known=_KEYS, known_of_frames=_KEYS_OF_FRAMES, frame_name="file", file=file)
    if "length_unit" not in content:
        logger.warning(
            "%s has no length_unit: lengths are taken for millimetres; state mm, or arbitrary", file
        )
    names = [entry["file"] for entry in entries]
    depth_files, mask_files = _depth_files(folder, names), _mask_files(folder, names)
    return SourceFrames(
        frames=[
            PosedFrame(
                name=entry["file"],
                file=folder / entry["file"],
                lens=_lens(folder, entry, content, file),
                world_from_camera=matrix_of(
                    entry, "world_from_camera", 4, file=file, frame=entry["file"], error=PoseError
                ),
                mask_file=mask_files[index],
                depth_file=depth_files[index],
                recording=_recording(entry, file),
                split=entry.get("split"),
            )
            for index, entry in enumerate(entries)
        ],
        pose_file=file,
        metric=content.get("length_unit", "mm") == "mm",
    )


READER = FolderReader(
    name="extrags",
    version=7,
    summary=f"{POSES_FILE} with rgb/ (and depth/, mask/), described in data_catalog/readers/posed_folder.py",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="OpenCV camera axes, camera to world, pixel centres at +0.5; z-depth",
)


def _load(folder: Path) -> dict[str, Any]:
    """What `poses.json` holds, with the file of each frame as its path below the folder."""
    file = folder / POSES_FILE
    content = load_frame_list(file, "file")
    unit = content.get("length_unit", "mm")
    if unit not in _LENGTH_UNITS:
        raise SourceError(
            f"{unit!r} is no length unit known here; expected one of {', '.join(_LENGTH_UNITS)}",
            file=file,
            field="length_unit",
        )
    # By one spelling: joined to another folder, an absolute path would lead back to the image itself.
    frames: dict[str, dict[str, Any]] = {}
    for entry in content["frames"]:
        place = inside(folder, entry["file"], file=file, frame=entry["file"], field="file")
        name = place.relative_to(folder).as_posix()
        if name in frames:
            raise SourceError("the frame is listed twice", file=file, frame=name, field="file")
        frames[name] = {**entry, "file": name}
    return {**content, "frames": list(frames.values())}


def _check_count(folder: Path, frames: list[dict[str, Any]]) -> None:
    listed = [entry["file"] for entry in frames]
    for name in listed:
        if not (folder / name).is_file():
            raise SourceNotFoundError(
                f"{POSES_FILE} lists this frame, but there is no such file",
                file=folder / name,
                frame=name,
                field="file",
            )
    images = folder / "rgb"
    present = [f"rgb/{file.name}" for file in color_files(images)] if images.is_dir() else []
    extra = [name for name in present if name not in set(listed)]
    if extra:
        raise PoseError(
            f"{len(listed)} poses for {len(present)} images in rgb/: this image has none",
            file=folder / POSES_FILE,
            frame=extra[0],
            field="world_from_camera",
        )


def _beside(folder: Path, part: str, names: list[str], suffixes: tuple[str, ...]) -> list[Path | None]:
    """The file of each frame below `part`: at the same path as below rgb/, else with the same last part.

    Raises:
        SourceError: two frames would share a file.
    """
    found: list[Path | None] = []
    owner: dict[Path, str] = {}
    files = FilesBeside(folder / part)
    for name in names:
        inner = _below_rgb(name)
        file = files.find(_stems(inner), suffixes)
        if file is not None and owner.setdefault(file, name) != name:
            raise SourceError(
                f"this file would belong to {owner[file]} as well; expected one for each at the path of its "
                f"frame, as {part}/{inner.with_suffix(file.suffix).as_posix()}",
                file=file,
                frame=name,
                field=part,
            )
        found.append(file)
    return found


def _below_rgb(name: str) -> Path:
    return Path(name).relative_to("rgb") if Path(name).is_relative_to("rgb") else Path(name)


def _stems(inner: Path) -> list[Path]:
    return list(dict.fromkeys((inner.with_suffix(""), Path(inner.stem))))


def _depth_files(folder: Path, names: list[str]) -> list[Path | None]:
    if not (folder / "depth").is_dir():
        tell_about_folders(folder, "depth", "depth is looked for in depth/")
        return [None] * len(names)
    found = _beside(folder, "depth", names, DEPTH_SUFFIXES)
    for name, file in zip(names, found, strict=True):
        if file is None:
            other = FilesBeside(folder / "depth").of_any_format(_stems(_below_rgb(name)))
            if other is not None:
                raise SourceError(
                    f"depth of this format is not read; expected {depth_suffixes_in_words()}",
                    file=other,
                    frame=name,
                    field="depth",
                )
    if names and not any(found):
        raise SourceNotFoundError(
            "no depth for this frame, nor for any other; expected files named after frames, or no folder "
            "depth/ at all",
            file=folder / "depth" / f"{Path(names[0]).stem}{DEPTH_SUFFIXES[0]}",
            frame=names[0],
            field="depth",
        )
    return found


def _mask_files(folder: Path, names: list[str]) -> list[Path | None]:
    if not (folder / "mask").is_dir():
        tell_about_folders(folder, "mask", "masks are looked for in mask/")
        return [None] * len(names)
    found = _beside(folder, "mask", names, COLOR_SUFFIXES)
    warn_of_unmasked(folder / "mask", dict(zip(names, found, strict=True)))
    return found


def _check_splits(frames: list[dict[str, Any]], file: Path) -> None:
    named = [entry.get("split") for entry in frames]
    if all(value is None for value in named):
        return
    for entry, value in zip(frames, named, strict=True):
        if value not in ("train", "test"):
            raise SourceError(
                f"found {value!r}; expected 'train' or 'test', in all frames or in none",
                file=file,
                frame=entry["file"],
                field="split",
            )


def _recording(entry: dict[str, Any], file: Path) -> int:
    number = entry.get("recording", 0)
    whole = isinstance(number, int) or (isinstance(number, float) and number.is_integer())
    if not whole or abs(number) > _LARGEST_RECORDING:
        raise SourceError(
            f"found {str(number)[:40]!r}; expected the number of a recording",
            file=file,
            frame=entry["file"],
            field="recording",
        )
    return int(number)


def _lens(folder: Path, entry: dict[str, Any], content: dict[str, Any], file: Path) -> Lens:
    frame = entry["file"]
    width, height = image_size(folder / frame, frame=frame)
    K = matrix_of(entry if "K" in entry else content, "K", 3, file=file, frame=frame)
    check_intrinsics(K, width, height, frame=frame, file=file)
    return Lens.pinhole(K, width, height)
