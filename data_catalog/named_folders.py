"""Folders of named sets below the data roots (`extrags.data_directories`)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from extrags.data_directories import DATA_VARIABLE, data_roots
from extrags.errors import SourceNotFoundError

__all__ = ["find_folder", "not_on_this_machine"]


def find_folder(names: Iterable[str], roots: Sequence[Path] | None = None) -> Path | None:
    """The first folder of one of these names below a root; None where there is none.

    Args:
        names: relative to a root, the usual one first.
        roots: None looks below `data_roots()`.
    """
    names = tuple(names)
    places = (root / name for root in (data_roots() if roots is None else roots) for name in names)
    return next((place for place in places if place.is_dir()), None)


def not_on_this_machine(
    name: str, folder: str, instead: str, roots: Sequence[Path] | None = None
) -> SourceNotFoundError:
    """The error for a known sequence whose files are elsewhere.

    Args:
        name: of the sequence.
        folder: what was looked for.
        instead: what a user may give in its place.
        roots: where it was looked for; None for `data_roots()`.
    """
    looked_at = ", ".join(str(root) for root in (data_roots() if roots is None else roots))
    # Without a home folder and the variable it is looked for nowhere.
    where = f" in {looked_at}" if looked_at else ""
    return SourceNotFoundError(
        f"{name} is not on this machine: no folder {folder}{where}. Put it there, set "
        f"{DATA_VARIABLE} to the folder that holds it, or give {instead}",
        file=folder,
    )
