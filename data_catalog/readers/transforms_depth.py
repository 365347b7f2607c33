"""Depth that a `transforms.json` names: which files are read, and in which unit."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_catalog.inside import inside
from extrags.errors import SourceError, SourceNotFoundError

__all__ = [
    "DEPTH_FILE_KEYS",
    "DEPTH_KEYS",
    "DEPTH_UNIT",
    "NERFSTUDIO_DEPTH_SCALE",
    "depth_factor",
    "depth_files",
]

logger = logging.getLogger(__name__)

NERFSTUDIO_DEPTH_SCALE = 1e-3
_OF_NERFSTUDIO, _OF_INSTANT_NGP = "depth_file_path", "depth_path"
DEPTH_FILE_KEYS = (_OF_NERFSTUDIO, _OF_INSTANT_NGP)
"""Names of a frame's depth file; the first that it has counts."""
_UNIT, _INTEGER_SCALE, _SWITCH = "depth_unit_scale_factor", "integer_depth_scale", "enable_depth_loading"
DEPTH_KEYS = (_UNIT, _INTEGER_SCALE, _SWITCH)
"""What is stated of the depth of all frames."""

DEPTH_UNIT = (
    f"what files hold is multiplied by {_UNIT}, which is {NERFSTUDIO_DEPTH_SCALE:g} where the file does not "
    "state it (1 would leave it as it is)"
)


def depth_files(
    content: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], file: Path
) -> dict[str, Path | None]:
    """Depth of each frame, by its `file_path`; None where it names none, or one that is absent.

    Files that are named by instant-ngp's key alone are read where instant-ngp reads them; elsewhere a warning
    says that they are not.

    Args:
        content: of all frames.
        entries: of the frames.
        file: that holds both.

    Raises:
        SourceNotFoundError: all that are named are absent.
        SourceError: a name that leads out of the folder.
    """
    unread = _why_unread(content, file)
    key_of = {entry["file_path"]: _key(entry, unread) for entry in entries}
    named = {
        entry["file_path"]: None if key is None else _named(entry, key, file)
        for entry, key in zip(entries, key_of.values(), strict=True)
    }
    passed_over = sum(_OF_INSTANT_NGP in entry and key_of[entry["file_path"]] is None for entry in entries)
    if unread and passed_over:
        logger.warning(
            "%s: depth of %d of %d frames (%s) is not read, as in instant-ngp: %s",
            file,
            passed_over,
            len(entries),
            _OF_INSTANT_NGP,
            unread,
            extra={"topic": "not read", "field": _OF_INSTANT_NGP},
        )
    found = {
        frame: place if place is not None and place.is_file() else None for frame, place in named.items()
    }
    if not any(found.values()):
        for frame, place in named.items():
            if place is not None:
                raise SourceNotFoundError("no such file", file=place, frame=frame, field=key_of[frame])
    return found


def depth_factor(content: Mapping[str, Any], depth_file: Path, file: Path) -> float:
    """What a value of a depth file is multiplied with to be in the unit of the poses.

    Args:
        content: of all frames.
        depth_file: with the values.
        file: that holds `content`, named in errors.

    Raises:
        SourceError: the factor that is stated is no positive number.
    """
    if _UNIT in content:
        key = _UNIT
    elif _INTEGER_SCALE in content and depth_file.suffix.lower() != ".npy":
        key = _INTEGER_SCALE
    else:
        return NERFSTUDIO_DEPTH_SCALE
    factor = _number(content, key, file)
    if not np.isfinite(factor) or factor <= 0:
        raise SourceError(f"{factor:g}; expected a positive number", file=file, field=key)
    return factor


def _key(entry: Mapping[str, Any], unread: str) -> str | None:
    """By which a frame names its depth."""
    if _OF_NERFSTUDIO in entry:
        return _OF_NERFSTUDIO
    return _OF_INSTANT_NGP if _OF_INSTANT_NGP in entry and not unread else None


def _named(entry: Mapping[str, Any], key: str, file: Path) -> Path:
    """The depth file of a frame, which may be absent."""
    return inside(file.parent, str(entry[key]), file=file, frame=entry["file_path"], field=key)


def _why_unread(content: Mapping[str, Any], file: Path) -> str:
    """Why files of instant-ngp's key are not read; empty where they are."""
    if not content.get(_SWITCH, True):
        return f"{_SWITCH} is off"
    if _UNIT in content:
        return ""
    if _INTEGER_SCALE not in content:
        return f"there is no {_INTEGER_SCALE}, the length of one level"
    scale = _number(content, _INTEGER_SCALE, file)
    return "" if scale > 0 else f"{_INTEGER_SCALE} is {scale:g}, and only above 0 the length of one level"


def _number(content: Mapping[str, Any], key: str, file: Path) -> float:
    try:
        return float(content[key])
    except (OverflowError, TypeError, ValueError) as error:
        raise SourceError(f"{content[key]!r}; expected a number", file=file, field=key) from error
