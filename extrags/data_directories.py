"""Search paths for data sets and weights: environment variables, then the user's XDG directories.

Neither the source checkout nor the working directory is searched.

Source: XDG Base Directory Specification 0.8; as it requires, relative paths in its variables are ignored.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["DATA_VARIABLE", "cache_directory", "data_roots", "user_directories", "weights_roots"]

DATA_VARIABLE = "EXTRAGS_DATA"
"""Environment variable: the folder that holds data sets."""


def cache_directory() -> Path:
    """`$XDG_CACHE_HOME/extrags`, usually `~/.cache/extrags`."""
    return _base("XDG_CACHE_HOME", ".cache") / "extrags"


def user_directories() -> list[Path]:
    """The user's data and cache directories: `~/.local/share/extrags` and `~/.cache/extrags`, usually."""
    return [_base("XDG_DATA_HOME", ".local/share") / "extrags", cache_directory()]


def data_roots() -> list[Path]:
    """Folders searched for data sets, in this order: `$EXTRAGS_DATA`, then the user's directories."""
    chosen = os.environ.get(DATA_VARIABLE)
    named = [Path(chosen).expanduser()] if chosen else []
    return list(dict.fromkeys([*named, *user_directories()]))


def weights_roots(kind: str) -> list[Path]:
    """Folders searched for weights of a kind, e.g. `lpips`: that subfolder of the user's directories."""
    return [directory / kind for directory in user_directories()]


def _base(variable: str, usual: str) -> Path:
    chosen = Path(os.environ.get(variable, ""))
    return chosen if chosen.is_absolute() else Path.home() / usual
