"""File names that stand in files of others: none of them leaves the folder of its source."""

from __future__ import annotations

import os
from pathlib import Path

from extrags.errors import SourceError

__all__ = ["inside", "with_slashes"]


def inside(
    folder: Path, name: str, *, file: Path, frame: str | int | None = None, field: str | None = None
) -> Path:
    """The file that a name in a source means.

    Absolute names are taken where they lead into the folder, and `..` where it stays in it. A name with the
    separators of Windows is taken with `/`, where there is no file of that name. Links are followed: they are
    made on this machine, and what they lead to counts in cache keys by its content.

    Args:
        folder: of the source.
        name: as written in `file`.
        file: named in errors.
        frame: named in errors.
        field: named in errors.

    Raises:
        SourceError: it leads out of the folder, or is no file name.
    """
    spelled = with_slashes(folder, name, file=file)
    return _below(folder, spelled, file=file, frame=frame, field=field)


def with_slashes(folder: Path, name: str, *, file: Path) -> str:
    """A name in a source as `inside` takes it: with `/` where it has the separators of Windows.

    Args:
        folder: of the source.
        name: as written in `file`; whether it leads out of the folder is not looked at.
        file: that holds it.
    """
    if "\\" not in name:
        return name
    try:
        found = _below(folder, name, file=file, frame=None, field=None)
    except SourceError:
        # Only as a name of this system's it leads elsewhere, or is too long.
        return name.replace("\\", "/")
    return name if os.path.lexists(found) else name.replace("\\", "/")


def _below(folder: Path, name: str, *, file: Path, frame: str | int | None, field: str | None) -> Path:
    if not _is_text(name) or len(os.fsencode(name)) > _LONGEST:
        raise SourceError(f"{name[:80]!r} is no file name", file=file, frame=_shown(frame), field=field)
    root = os.path.abspath(folder)
    path = os.path.normpath(os.path.join(root, name))
    if path != root and not path.startswith(os.path.join(root, "")):
        raise SourceError(
            f"{name[:200]!r} leads out of the folder; files of a source lie below it: copy or link them "
            "there",
            file=file,
            frame=_shown(frame),
            field=field,
        )
    relative = os.path.relpath(path, root)
    if any(len(os.fsencode(part)) > _LONGEST_PART for part in relative.split(os.sep)):
        raise SourceError(f"{name[:80]!r} is no file name", file=file, frame=_shown(frame), field=field)
    return folder / relative


def _is_text(name: str) -> bool:
    # What JSON may hold and no file system: lone halves of characters.
    return bool(name) and "\0" not in name and not any("\ud800" <= letter <= "\udfff" for letter in name)


_LONGEST = 4000
_LONGEST_PART = 250
"""In bytes; file systems refuse longer ones with errors of their own."""


def _shown(frame: str | int | None) -> str | int | None:
    return frame.replace("\0", "\\0")[:200] if isinstance(frame, str) else frame
