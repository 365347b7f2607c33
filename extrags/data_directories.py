"""Search paths for data sets and weights: environment variables, then the user's XDG directories.

Neither the source checkout nor the working directory is searched.

Source: XDG Base Directory Specification 0.8; as it requires, relative paths in its variables are ignored.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from extrags.errors import ConfigError
from extrags.user_paths import expanded

__all__ = [
    "DATA_VARIABLE",
    "cache_directory",
    "check_home",
    "data_roots",
    "user_directories",
    "weights_roots",
]

DATA_VARIABLE = "EXTRAGS_DATA"
"""Environment variable: the folder that holds data sets."""


def cache_directory() -> Path:
    """`$XDG_CACHE_HOME/extrags`, usually `~/.cache/extrags`.

    Raises:
        ConfigError: when nothing tells this user's home folder, in which it would be.
    """
    return _base("XDG_CACHE_HOME", ".cache") / "extrags"


def user_directories() -> list[Path]:
    """The user's data and cache directories: `~/.local/share/extrags` and `~/.cache/extrags`, usually.

    Raises:
        ConfigError: when nothing tells this user's home folder, in which they would be.
    """
    return [_base("XDG_DATA_HOME", ".local/share") / "extrags", cache_directory()]


def data_roots() -> list[Path]:
    """Folders searched for data sets, in this order: `$EXTRAGS_DATA`, then the user's directories."""
    chosen = os.environ.get(DATA_VARIABLE)
    named = [expanded(chosen)] if chosen else []
    return list(dict.fromkeys([*named, *_searched()]))


def weights_roots(kind: str) -> list[Path]:
    """Folders searched for weights of a kind, e.g. `lpips`: that subfolder of the user's directories."""
    return [directory / kind for directory in _searched()]


def check_home() -> None:
    """For who needs packages that look for the user's home folder when they are imported, as Prefect does.

    Raises:
        ConfigError: when nothing tells it: HOME is not set, and the system does not know the user.
    """
    _home()


def _searched() -> list[Path]:
    """The user's directories; without a home folder there is nothing in them."""
    with suppress(ConfigError):
        return user_directories()
    return []


def _base(variable: str, usual: str) -> Path:
    chosen = Path(os.environ.get(variable, ""))
    return chosen if chosen.is_absolute() else _home() / usual


def _home() -> Path:
    try:
        return Path.home()
    except RuntimeError as error:
        raise ConfigError(
            "no home folder is known of this user; set HOME to a folder that can be written"
        ) from error
