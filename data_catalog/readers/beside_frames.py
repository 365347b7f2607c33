"""What lies beside plain frames and is none of them: depth, masks, poses, a second copy in another format.

Nothing of it is read with plain frames, which have neither poses nor depth, and one mask for all; what is
there nevertheless is named, and so is what would be read.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from extrags.errors import SourceError

__all__ = [
    "check_one_format",
    "frames_among",
    "is_of_another_kind",
    "listed_files",
    "tell_about_folders",
    "tell_about_other_names",
    "tell_about_pictures",
    "tell_what_is_not_read",
    "what_would_be_lost",
]

logger = logging.getLogger(__name__)

_NAMED_FILES = 3
_FEWEST_NUMBERED = 4
_NUMBERED_PER_OTHER = 10
_MATCHED_SHARE = 0.5
_WORDS = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+(?![^\W\d_A-Z])|\d+")
_KIND = re.compile(
    r"masks?|depths?|depthmaps?|disp|disparit(y|ies)|seg|segmentations?|segmented|semantics?|labels?"
)
"""A word of a name that tells what a picture shows instead of colours."""
_PERHAPS_KIND = re.compile(r"normals?|gt|groundtruth|flow|instances?|confidence|alpha")
"""A word that may as well be part of a recording's name, as of normal mucosa."""
_COLOR = re.compile(r"colou?rs?|rgb|bgr|images?|img|im|frames?|framebuffer|buffer|left|right")
"""A word that tells nothing but that a picture is a frame."""

_DEPTH_FOLDERS = ("depth", "depths", "gt_depth", "depth_gt", "disparity", "disparities")
_MASK_FOLDERS = ("mask", "masks", "gt_masks")
_POSES = re.compile(
    r"(?<![a-z])(pose|traj|groundtruth|extrinsic|transforms|savedposition|savedrotation)|trajector(y|ies)"
)
_POSE_SUFFIXES = (".txt", ".csv", ".json", ".npy", ".npz", ".yaml", ".yml", ".log", ".mat", ".tum")
_POSE_NAMES = ("sparse", "colmap", "cameras.txt", "cameras.bin", "images.txt", "images.bin")
_SINUS_POSES = ("motion.yaml", "structure.ply")
_SINUS_OTHERS = ("camera_intrinsics_per_view", "visible_view_indexes")
_READ_WITH_POSES = (
    "a poses.json with rgb/, depth/ and mask/, a transforms.json, a COLMAP model, or a poses_bounds.npy with "
    "images/, depth/ and masks/ (docs/sources.md)"
)


def listed_files(files: Sequence[Path]) -> str:
    """The names of some files, the first ones where there are many."""
    more = f" and {len(files) - _NAMED_FILES} more" if len(files) > _NAMED_FILES else ""
    return ", ".join(file.name for file in files[:_NAMED_FILES]) + more


def frames_among(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Frames, and pictures of another kind that belong to them, both in the order given.

    Pictures are of another kind where their name says so (depth, mask, ...) and most of those called alike
    have the number of a picture whose name does not: a recording that is itself called so stays.

    Args:
        files: pictures in one folder.
    """
    named = {file: _parts(file.stem) for file in files}
    families: dict[tuple[str, ...], list[Path]] = {}
    for file, (pattern, _) in named.items():
        families.setdefault(pattern, []).append(file)
    color_words: dict[tuple[int, ...], list[frozenset[str]]] = {}
    for _, (words, numbers) in named.values():
        if not _has(words, _KIND) and not _has(words, _PERHAPS_KIND):
            telling = frozenset(word for word in words if not _COLOR.fullmatch(word))
            color_words.setdefault(numbers, []).append(telling)
    left_out: set[Path] = set()
    for members in families.values():
        matched = sum(_belongs(*named[file][1], color_words) for file in members)
        if matched and matched >= _MATCHED_SHARE * len(members):
            left_out.update(members)
    return [file for file in files if file not in left_out], [file for file in files if file in left_out]


def is_of_another_kind(name: str) -> bool:
    """Whether a name says that what it stands for is depth, a mask or the like."""
    words = _parts(name)[1][0]
    return _has(words, _KIND) or _has(words, _PERHAPS_KIND)


def _parts(stem: str) -> tuple[tuple[str, ...], tuple[frozenset[str], tuple[int, ...]]]:
    """What names of one kind share, and the words and numbers of this one."""
    parts = [part.lower() for part in _WORDS.findall(stem)]
    words = frozenset(part for part in parts if not part.isdecimal())
    numbers = tuple(int(part) for part in parts if part.isdecimal())
    return tuple("" if part.isdecimal() else part for part in parts), (words, numbers)


def _belongs(
    words: frozenset[str], numbers: tuple[int, ...], color_words: dict[tuple[int, ...], list[frozenset[str]]]
) -> bool:
    """Whether a name says that it is the depth, mask, ... of a frame that is there."""
    frames = color_words.get(numbers, [])
    if _has(words, _KIND):
        return bool(frames)
    return _has(words, _PERHAPS_KIND) and any(frame <= words for frame in frames)


def _has(words: frozenset[str], kind: re.Pattern[str]) -> bool:
    return any(kind.fullmatch(word) for word in words)


def check_one_format(files: Sequence[Path]) -> None:
    """Refuse a frame that is there twice: one of the two would train where the other evaluates.

    Raises:
        SourceError: two files differ in their suffix alone; names both.
    """
    seen: dict[str, Path] = {}
    for file in files:
        other = seen.setdefault(file.stem, file)
        if other != file:
            raise SourceError(
                f"the same frame as {other.name} by its name, in another format: of a frame that is read "
                "twice one may train and the other evaluate. Move the files of one format away",
                file=file,
                frame=file.stem,
                field="rgb",
            )


def tell_about_pictures(folder: Path, left_out: Sequence[Path]) -> None:
    """Warn of pictures that `frames_among` took for no frames."""
    if left_out:
        _tell(
            f"{folder}: {len(left_out)} pictures are left out, by their names depth, masks or the like of "
            f"frames beside them ({listed_files(left_out)}). Depth and masks of single frames are read "
            f"together with poses: give {_READ_WITH_POSES}. Of plain frames, one mask.png holds for all. "
            "What is a frame nevertheless needs another name"
        )


def tell_about_other_names(files: Sequence[Path]) -> None:
    """Warn of a few frames without a number in their names, where all others have one.

    Such a picture (`overview.png`) is more often about a recording than part of it. It is read nevertheless:
    a name alone does not say what a picture shows.

    Args:
        files: the frames to read.
    """
    others = [file for file in files if not any(map(str.isdecimal, file.stem))]
    numbered = len(files) - len(others)
    if others and numbered >= max(_FEWEST_NUMBERED, _NUMBERED_PER_OTHER * len(others)):
        _tell(
            f"{files[0].parent}: beside {numbered} frames with a number in their names there is also "
            f"{listed_files(others)}, which is read as a frame. Move away what is no frame",
            topic="frames",
        )


def tell_what_is_not_read(folder: Path) -> None:
    """Warn of masks, depth and poses that lie beside frames without anything that says how they belong."""
    names = _names(folder)
    for name in names:
        if name.lower() in _MASK_FOLDERS and (folder / name).is_dir():
            _tell(f"{folder / name} is not read; of plain frames, one mask.png holds for all")
    found = _poses_and_depth(folder)
    if found:
        _tell(
            f"{folder}: read without poses and depth; not read are {', '.join(found[:_NAMED_FILES])}"
            f"{_and_more(found)}. To have poses and depth read, give {_READ_WITH_POSES}{_of_sinus_set(names)}"
        )


def what_would_be_lost(folder: Path) -> str:
    """Of a folder whose frames lie in another one within: poses and depth beside that, as a clause, or empty.

    Args:
        folder: that no reader recognises.
    """
    found = _poses_and_depth(folder)
    if not found:
        return ""
    return (
        f", which is read without {', '.join(found[:_NAMED_FILES])}{_and_more(found)}; "
        f"to have poses and depth read, give {_READ_WITH_POSES}"
    )


def _poses_and_depth(folder: Path) -> list[str]:
    """Names in a folder that tell of depth or poses of frames; those of folders end with a slash."""
    names = _names(folder)
    folders = [name for name in names if (folder / name).is_dir()]
    found = [f"{name}/" for name in folders if name.lower() in _DEPTH_FOLDERS]
    return found + [f"{name}/" if name in folders else name for name in names if _tells_poses(folder / name)]


def _names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir() if not file.name.startswith("."))


def _and_more(found: Sequence[str]) -> str:
    return f" and {len(found) - _NAMED_FILES} more" if len(found) > _NAMED_FILES else ""


def tell_about_folders(folder: Path, field: Literal["depth", "mask"], instead: str) -> None:
    """Warn of folders that are called like those of depth or masks, of a source of which none is read.

    Args:
        folder: of the source.
        field: what they hold.
        instead: what would be read, as the end of a sentence.
    """
    known = _DEPTH_FOLDERS if field == "depth" else _MASK_FOLDERS
    for place in sorted(folder.iterdir()):
        if place.name.lower() in known and place.is_dir():
            _tell(f"{place} is not read; {instead}")


def _tells_poses(place: Path) -> bool:
    name = place.name.lower()
    if name in (*_POSE_NAMES, *_SINUS_POSES, *_SINUS_OTHERS):
        return True
    return bool(_POSES.search(name)) and (place.suffix.lower() in _POSE_SUFFIXES or place.is_dir())


def _of_sinus_set(names: Sequence[str]) -> str:
    absent = [name for name in _SINUS_POSES if name not in names]
    is_part = any(name in names for name in (*_SINUS_POSES, *_SINUS_OTHERS))
    return f"; what there is of the sinus set lacks {' and '.join(absent)}" if is_part and absent else ""


def _tell(sentence: str, topic: str = "not read") -> None:
    # With a topic it is a finding of `data check`: what lies there was probably meant to be read.
    logger.warning("%s", sentence, extra={"topic": topic, "field": "files"})
