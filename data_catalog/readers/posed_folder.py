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

from pathlib import Path
from typing import Any

from data_catalog.checks import check_intrinsics
from data_catalog.folder_reader import FolderReader
from data_catalog.images import colour_files, image_size
from data_catalog.inside import inside
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.frame_list import load_frame_list, matrix_of
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.lens import Lens

__all__ = ["POSES_FILE", "READER"]

POSES_FILE = "poses.json"
_DEPTH_SUFFIXES = (".npy", ".tiff", ".tif", ".png")
_LENGTH_UNITS = ("mm", "arbitrary")


def _recognises(folder: Path) -> bool:
    return (folder / POSES_FILE).is_file()


def _files(folder: Path) -> list[Path]:
    file = folder / POSES_FILE
    found = {file}
    for part in ("rgb", "depth", "mask"):
        if (folder / part).is_dir():
            found |= set((folder / part).iterdir())
    # Images may lie elsewhere below the folder.
    for entry in load_frame_list(file, "file")["frames"]:
        found.add(inside(folder, entry["file"], file=file, frame=entry["file"], field="file"))
    return sorted(item for item in found if item.is_file())


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    file = folder / POSES_FILE
    content = _load(file)
    entries = content["frames"]
    _check_count(folder, entries)
    _check_splits(entries, file)
    depth_files = _depth_files(folder, entries)
    return SourceFrames(
        frames=[
            PosedFrame(
                name=entry["file"],
                file=inside(folder, entry["file"], file=file, frame=entry["file"], field="file"),
                lens=_lens(folder, entry, content, file),
                world_from_camera=matrix_of(
                    entry, "world_from_camera", 4, file=file, frame=entry["file"], error=PoseError
                ),
                mask_file=_mask_file(folder, entry["file"]),
                depth_file=depth_files[index] if depth_files else None,
                recording=int(entry.get("recording", 0)),
                split=entry.get("split"),
            )
            for index, entry in enumerate(entries)
        ],
        pose_file=file,
        metric=content.get("length_unit", "mm") == "mm",
    )


READER = FolderReader(
    name="extrags",
    version=3,
    summary=f"{POSES_FILE} with rgb/ (and depth/, mask/), described in data_catalog/readers/posed_folder.py",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="OpenCV camera axes, camera to world, pixel centres at +0.5; z-depth",
)


def _load(file: Path) -> dict[str, Any]:
    content = load_frame_list(file, "file")
    unit = content.get("length_unit", "mm")
    if unit not in _LENGTH_UNITS:
        raise SourceError(
            f"{unit!r} is no length unit known here; expected one of {', '.join(_LENGTH_UNITS)}",
            file=file,
            field="length_unit",
        )
    return content


def _check_count(folder: Path, frames: list[dict[str, Any]]) -> None:
    listed = [entry["file"] for entry in frames]
    for name in listed:
        place = inside(folder, name, file=folder / POSES_FILE, frame=name, field="file")
        if not place.is_file():
            raise SourceNotFoundError(
                f"{POSES_FILE} lists this frame, but there is no such file",
                file=place,
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


def _lens(folder: Path, entry: dict[str, Any], content: dict[str, Any], file: Path) -> Lens:
    frame = entry["file"]
    width, height = image_size(folder / frame, frame=frame)
    K = matrix_of(entry if "K" in entry else content, "K", 3, file=file, frame=frame)
    check_intrinsics(K, width, height, frame=frame, file=file)
    return Lens.pinhole(K, width, height)


def _mask_file(folder: Path, frame: str) -> Path | None:
    file = folder / "mask" / f"{Path(frame).stem}.png"
    return file if file.is_file() else None
