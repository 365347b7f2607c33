"""The files that list frames in the format of nerfstudio and instant-ngp: one, or one for each split.

`transforms_train.json`, `transforms_val.json` and `transforms_test.json`, as the synthetic scenes of NeRF
have them, are read where there is no `transforms.json`: the first trains and the third evaluates. The second
is left out, as in published comparisons; it evaluates where there is no third.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from data_catalog.inside import with_slashes
from data_catalog.readers.frame_list import load_frame_list
from data_catalog.readers.transforms_depth import DEPTH_KEYS
from data_catalog.readers.transforms_lens import stated_values
from extrags.errors import SourceError

__all__ = [
    "SPLIT_LISTS",
    "TRANSFORMS_FILE",
    "ListedFrames",
    "holds_transforms",
    "load_transforms",
    "tell_about_lists_above",
]

logger = logging.getLogger(__name__)

TRANSFORMS_FILE = "transforms.json"
_TRAIN, _VAL, _TEST = (f"transforms_{split}.json" for split in ("train", "val", "test"))
SPLIT_LISTS = ("train_filenames", "test_filenames", "val_filenames")
"""Keys of lists of frames by their split, in a single file."""
_OF_ALL_FILES = ("length_unit", "ply_file_path", *DEPTH_KEYS)
"""What cannot differ from frame to frame."""


@dataclass(frozen=True)
class ListedFrames:
    """What the files of a folder say.

    Args:
        parts: each file and what it holds.
        content: what holds for all frames, and the list `frames` of those of all files.
        file_of: the file that lists a frame, by the frame's `file_path`.
        splits: by `file_path`, where there is a file for each split; empty otherwise.
    """

    parts: tuple[tuple[Path, dict[str, Any]], ...]
    content: dict[str, Any]
    file_of: Mapping[str, Path]
    splits: dict[str, Literal["train", "test"]] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        """The first file, named in messages about all frames."""
        return self.parts[0][0]


def holds_transforms(folder: Path) -> bool:
    """Whether a folder holds such files."""
    return any((folder / name).is_file() for name in (TRANSFORMS_FILE, _TRAIN))


def load_transforms(folder: Path) -> ListedFrames:
    """What the files of a folder say, without keys whose value is null, and with `/` in names of frames.

    Raises:
        SourceError: no list of frames, a frame that is listed twice, or files that contradict each other.
    """
    single = folder / TRANSFORMS_FILE
    if single.is_file() or not (folder / _TRAIN).is_file():
        content = _load(single)
        return ListedFrames(((single, content),), content, dict.fromkeys(_names(content), single))
    held_out = _TEST if (folder / _TEST).is_file() else _VAL
    files = [folder / name for name in (_TRAIN, held_out) if (folder / name).is_file()]
    parts = tuple((file, _load(file)) for file in files)
    if held_out == _TEST and (folder / _VAL).is_file():
        logger.info("%s is not read: %s evaluates", folder / _VAL, _TEST)
    return _joined(parts)


def tell_about_lists_above(folder: Path) -> None:
    """Warn of plain frames in a folder below that of files which list frames with their poses."""
    above = Path(os.path.abspath(folder)).parent / _TRAIN
    if above.is_file():
        logger.warning(
            "%s is read without poses; %s lists frames with their poses: to have them read, give the path of "
            "its folder",
            folder,
            above,
            extra={"topic": "not read", "field": "files"},
        )


def _load(file: Path) -> dict[str, Any]:
    """What one file holds."""
    content = load_frame_list(file, "file_path")
    frames: dict[str, dict[str, Any]] = {}
    for entry in content["frames"]:
        name = with_slashes(file.parent, entry["file_path"], file=file)
        if name in frames:
            raise SourceError("the frame is listed twice", file=file, frame=name, field="file_path")
        frames[name] = {**_stated(entry), "file_path": name}
    return {**_stated(content), "frames": list(frames.values())}


def _joined(parts: tuple[tuple[Path, dict[str, Any]], ...]) -> ListedFrames:
    """The frames of several files, each with what its own file says of all.

    Raises:
        SourceError: two files list one frame, or differ in what cannot differ.
    """
    (first, told), *_ = parts
    frames: list[dict[str, Any]] = []
    file_of: dict[str, Path] = {}
    splits: dict[str, Literal["train", "test"]] = {}
    for file, content in parts:
        for key in _OF_ALL_FILES:
            if key in content and content[key] != told.get(key):
                raise SourceError(
                    f"{content[key]!r}, but {told.get(key)!r} in {first.name}; expected the same in both",
                    file=file,
                    field=key,
                )
        own = {
            key: value
            for key, value in content.items()
            if key not in ("frames", *_OF_ALL_FILES, *SPLIT_LISTS)
        }
        for entry in content["frames"]:
            name = entry["file_path"]
            if name in file_of:
                raise SourceError(
                    f"{file_of[name].name} lists this frame, too: it would train and evaluate",
                    file=file,
                    frame=name,
                    field="file_path",
                )
            file_of[name] = file
            splits[name] = "train" if file == first else "test"
            frames.append(stated_values(own, entry))
    of_all = {key: told[key] for key in _OF_ALL_FILES if key in told}
    # Without a file of frames to evaluate there is no split, and the usual rule makes one.
    return ListedFrames(parts, {**of_all, "frames": frames}, file_of, splits if len(parts) > 1 else {})


def _names(content: Mapping[str, Any]) -> list[str]:
    return [entry["file_path"] for entry in content["frames"]]


def _stated(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if value is not None}
