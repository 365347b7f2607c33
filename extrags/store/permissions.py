"""Who may read the files of an artefact."""

from __future__ import annotations

import stat
from contextlib import suppress
from pathlib import Path

__all__ = ["give_usual_permissions"]


def give_usual_permissions(directory: Path, *, like: Path) -> None:
    """Give the files of an artefact at least the permissions that a new file has here.

    Some writers make files that their owner alone may read, whatever the umask says: other users of the store
    could not use them.

    Args:
        directory: the files.
        like: a file that was written in the usual way.
    """
    usual = stat.S_IMODE(like.stat().st_mode)
    for path in directory.rglob("*"):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode) and usual & ~mode:
            # Where a file system has no permissions, nobody is refused.
            with suppress(OSError):
                path.chmod(stat.S_IMODE(mode) | usual)
