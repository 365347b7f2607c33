"""Paths as users write them: `~` for a home folder, and several spellings of one file."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["absolute", "expanded"]


def expanded(path: str | Path) -> Path:
    """The path with the home folder in place of `~` or `~NAME` at its begin.

    Where there is no such home it is taken as it is: files may be called `~recording.mp4`, and `pathlib`
    fails there.
    """
    return Path(os.path.expanduser(path))


def absolute(path: str | Path) -> Path:
    """The one spelling of a path that holds in every folder: absolute, without `~` and `..`.

    A `..` stays where something else would be found without it, as behind a link to a folder.
    """
    place = expanded(path).absolute()
    plain = Path(os.path.abspath(place))
    return place if plain != place and place.exists() and not _is_same(plain, place) else plain


def _is_same(one: Path, other: Path) -> bool:
    return one.exists() and one.samefile(other)
