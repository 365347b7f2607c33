"""What readers of listed frames share: the list, absent frames, files beside them, matrices, splits."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from extrags.errors import SourceError, SourceNotFoundError
from extrags.frame_names import COLOR_SUFFIXES, natural_key

__all__ = [
    "FilesBeside",
    "listed_split",
    "load_frame_list",
    "matrix_of",
    "present_frames",
    "warn_of_unmasked",
]

logger = logging.getLogger(__name__)

NAMED_FRAMES = 5
"""A warning names so many frames."""


class FilesBeside:
    """Files of frames in a folder of their own, such as masks, found by the names of the frames.

    Args:
        folder: with the files, also in folders below it; there need not be any.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._listed: dict[Path, dict[tuple[str, str], Path]] = {}

    def find(self, stems: Iterable[str | Path], suffixes: Sequence[str]) -> Path | None:
        """The file of the first stem that has one, with the first of its suffixes; None without any.

        Args:
            stems: paths below the folder, without suffix.
            suffixes: in lower case; files may have them in upper case as well.
        """
        for stem in stems:
            place = self.folder / stem
            listed = self._files_of(place.parent)
            found = next(
                (listed[place.name, suffix] for suffix in suffixes if (place.name, suffix) in listed), None
            )
            if found is not None:
                return found
        return None

    def of_any_format(self, stems: Iterable[str | Path]) -> Path | None:
        """The first file of the first stem that has one, whatever its suffix, as to name what is not read."""
        for stem in stems:
            place = self.folder / stem
            suffixes = [suffix for name, suffix in self._files_of(place.parent) if name == place.name]
            found = self.find([stem], suffixes)
            if found is not None:
                return found
        return None

    def _files_of(self, folder: Path) -> dict[tuple[str, str], Path]:
        """Files directly in a folder by stem and suffix."""
        if folder not in self._listed:
            # Of two suffixes that differ in case alone the lower one comes last, and is taken.
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            self._listed[folder] = {
                (file.stem, file.suffix.lower()): file for file in files if file.is_file()
            }
        return self._listed[folder]


def load_frame_list(file: Path, key: str) -> dict[str, Any]:
    """An object with a list `frames`, each frame of which names its own file.

    Args:
        file: JSON.
        key: of a frame's file.

    Raises:
        SourceError: no JSON, no such list, an empty one, a frame without file, or one listed twice.
    """
    try:
        # Editors on Windows put a mark at the beginning.
        content = json.loads(file.read_text(encoding="utf-8-sig"))
    except (RecursionError, ValueError) as error:
        raise SourceError(f"not readable as JSON: {error}", file=file) from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise SourceError("expected an object with a list `frames`", file=file, field="frames")
    if not content["frames"]:
        raise SourceError("the list of frames is empty", file=file, field="frames")
    seen: set[str] = set()
    for index, entry in enumerate(content["frames"]):
        if not isinstance(entry, dict) or not isinstance(entry.get(key), str):
            raise SourceError(f"expected an object with `{key}`", file=file, frame=index, field=key)
        if entry[key] in seen:
            raise SourceError("the frame is listed twice", file=file, frame=entry[key], field=key)
        seen.add(entry[key])
    return content


def present_frames(files: Mapping[str, Path], max_absent_share: float, *, listing: Path) -> set[str]:
    """Names of the listed frames that are there; the others are left out with a warning that names them.

    Published scenes list frames they do not ship (instant-ngp's fox: 67 and 50).

    Args:
        files: the image of each listed frame, by the frame's name.
        max_absent_share: with more absent, the scene is refused.
        listing: the file that lists them, named in messages.

    Raises:
        SourceNotFoundError: no frame is there, or too many are absent; names the first absent file.
    """
    absent = [name for name, file in files.items() if not file.is_file()]
    present = files.keys() - set(absent)
    if not absent:
        return present
    if not present or len(absent) > max_absent_share * len(files):
        raise SourceNotFoundError(
            f"{listing.name} lists {len(files)} frames, and {len(absent)} of them are absent, this one "
            f"first; at most {max_absent_share:.0%} may be (ingest.max_absent_share)"
            f"{_of_other_suffix(files, absent, listing)}",
            file=files[absent[0]],
            frame=absent[0],
            field="file",
        )
    logger.warning(
        "%s lists %d frames; %d of them are absent and left out: %s%s",
        listing,
        len(files),
        len(absent),
        _named(absent),
        _of_other_suffix(files, absent, listing),
    )
    return present


def _of_other_suffix(files: Mapping[str, Path], absent: Sequence[str], listing: Path) -> str:
    """That images which are absent are there as files of another kind; empty where they are not.

    They are not taken: what else has a frame's name may be its mask or a preview, and a lens is that of the
    size it was calibrated with.
    """
    folders: dict[Path, FilesBeside] = {}
    found = []
    for name in absent:
        folder = files[name].parent
        beside = folders.setdefault(folder, FilesBeside(folder))
        other = beside.find([files[name].stem], COLOR_SUFFIXES)
        if other is not None:
            found.append((name, other))
    if not found:
        return ""
    name, other = found[0]
    return (
        f"; {len(found)} of the absent ones are there with another suffix, {other.name} for "
        f"{Path(name).name} first: if these are the images, let their names and those in {listing.name} agree"
    )


def warn_of_unmasked(folder: Path, masks: Mapping[str, Path | None]) -> None:
    """Say which frames have no mask although there are masks: nothing is left out of them.

    Args:
        folder: with the masks.
        masks: of each frame, by its name.
    """
    without = [name for name, file in masks.items() if file is None]
    if without:
        logger.warning(
            "%s: %d of %d frames have no mask and are tissue throughout: %s",
            folder,
            len(without),
            len(masks),
            _named(without),
        )


def _named(frames: Sequence[str]) -> str:
    more = f" and {len(frames) - NAMED_FRAMES} more" if len(frames) > NAMED_FRAMES else ""
    return ", ".join(frames[:NAMED_FRAMES]) + more


def matrix_of(
    owner: dict[str, Any],
    field: str,
    size: int,
    *,
    file: Path,
    frame: str,
    error: type[SourceError] = SourceError,
) -> Float[np.ndarray, "n n"]:
    """A square matrix of an entry.

    Args:
        owner: a frame, or the whole file.
        field: key of the matrix.
        size: its number of rows.
        file: named in errors.
        frame: named in errors.
        error: kind of what is raised.

    Raises:
        SourceError: missing, no numbers, or of another shape.
    """
    if field not in owner:
        raise error(f"no {field}; expected {size} x {size} numbers", file=file, frame=frame, field=field)
    try:
        matrix = np.asarray(owner[field], dtype=np.float64)
    except (OverflowError, TypeError, ValueError) as cause:
        raise error(f"not a matrix of numbers: {cause}", file=file, frame=frame, field=field) from cause
    if matrix.shape != (size, size):
        raise error(
            f"found shape {matrix.shape}; expected {size} rows of {size} numbers",
            file=file,
            frame=frame,
            field=field,
        )
    return matrix


def listed_split(
    known: Collection[str],
    training: Collection[str] | None,
    held_out: Collection[str] | None,
    *,
    file: Path,
) -> dict[str, Literal["train", "test"]]:
    """The part of each frame that lists name; frames that neither of two lists names are left out.

    Args:
        known: names of all frames.
        training: names listed to train on; None, without a list, is all that are not held out.
        held_out: names listed to evaluate on; None, without a list, is all that are not to train on.
        file: named in messages.

    Returns:
        Part by name, of the frames that have one; empty where nothing is said.

    Raises:
        SourceError: a frame stands in both lists.
    """
    if held_out is None:
        held_out = set(known) - set(known if training is None else training)
        if not held_out:
            return {}
    if training is None:
        training = set(known) - set(held_out)
    both = sorted(set(held_out) & set(training), key=natural_key)
    if both:
        raise SourceError(
            f"{len(both)} frames both train and evaluate, this one is the first",
            file=file,
            frame=both[0],
            field="split",
        )
    neither = sorted(set(known) - set(held_out) - set(training), key=natural_key)
    if neither:
        logger.warning(
            "%s: %d of %d frames are neither to train on nor to evaluate on and left out; the first is %s",
            file,
            len(neither),
            len(known),
            neither[0],
        )
    parts: dict[str, Literal["train", "test"]] = dict.fromkeys(held_out, "test")
    return parts | dict.fromkeys(training, "train")
