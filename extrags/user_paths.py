"""Paths as users write them: `~` for a home folder."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["expanded"]


def expanded(path: str | Path) -> Path:
    """The path with the home folder in place of `~` or `~NAME` at its begin.

    Where there is no such home it is taken as it is: files may be called `~recording.mp4`, and `pathlib`
    fails there.
    """
    return Path(os.path.expanduser(path))
