"""What a stage could not write because of a full disk, a quota or missing permission, named as such."""

from __future__ import annotations

import errno
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from extrags.errors import StoreError

__all__ = ["refused_write"]

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_ALLOWED = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})


def refused_write(error: BaseException, stage: str, store: str, place: Path) -> StoreError | None:
    """The error to raise instead of one that means that a stage could not write; None for any other.

    It is never tried again: somebody has to make room, or give permission.

    Args:
        error: what the stage raised.
        stage: its name.
        store: root of the store.
        place: where the stage was writing.
    """
    number, file = next(_refusals(error, place), (None, None))
    if number is None and not isinstance(error, StoreError) and _is_full(place):
        # Native writers say that something failed, but not what.
        number = errno.ENOSPC
    if number is None:
        return None
    path = file or _newest(place)
    where = f"store {store}"
    # What was found before: to look for it now would write to the full disk.
    if file is not None and file == tempfile.tempdir:
        where = "the folder of temporary files, where large stacks of frames are held; TMPDIR names another"
    return StoreError(f"stage {stage}: {path} cannot be written: {os.strerror(number)} ({where})")


def _refusals(error: BaseException | None, place: Path) -> Iterator[tuple[int, str | None]]:
    """Number and file of each error in the chain that means so."""
    while error is not None:
        number = error.errno if isinstance(error, OSError) else _rust_number(error)
        file = _file(error)
        if number in NO_ROOM or (number in NOT_ALLOWED and file and _below(file, place)):
            yield int(number or 0), file
        error = error.__cause__ or error.__context__


def _rust_number(error: BaseException) -> int | None:
    """As safetensors says it: `I/O error: No space left on device (os error 28)`."""
    found = re.search(r"\(os error (\d+)\)", str(error))
    return int(found[1]) if found else None


def _file(error: BaseException) -> str | None:
    # `write` knows no name, and `open` may have been given a number.
    name = getattr(error, "filename2", None) or getattr(error, "filename", None)
    return os.fsdecode(name) if isinstance(name, str | bytes | os.PathLike) else None


def _below(file: str, place: Path) -> bool:
    """Whether a file belongs to the attempt; one that somebody's own source lacks permission for does not."""
    return Path(file).absolute().is_relative_to(place.parent.parent)


def _is_full(place: Path) -> bool:
    with suppress(OSError):
        room = os.statvfs(place)
        return room.f_blocks > 0 and room.f_bavail == 0
    return False


def _newest(place: Path) -> Path:
    """The file that was being written, as far as can be known: the one that was changed last."""
    files = []
    for path in place.rglob("*"):
        with suppress(OSError):
            if path.is_file():
                files.append((path.stat().st_mtime_ns, path))
    return max(files)[1] if files else place
