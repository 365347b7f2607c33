"""Names of sequences that are paths: several spellings of one path are one name."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["comparable_name", "path_of", "plain_name"]


def plain_name(name_or_path: str) -> str:
    """The name that runs of a sequence have on record: of a path that exists its plain spelling.

    `./scene//`, `scene/` and `scene` are one name. A relative path stays relative. What does not exist stays
    as it is written: `./phantom/0` is a path, and `phantom/0` a sequence of the catalogue.

    Args:
        name_or_path: what a user named.
    """
    there = os.path.exists(os.path.expanduser(name_or_path))
    return str(Path(name_or_path)) if there else name_or_path


def path_of(name_or_path: str) -> str | None:
    """The absolute path of a sequence that is one, and exists; None for others.

    Args:
        name_or_path: what a user named.
    """
    there = os.path.exists(os.path.expanduser(name_or_path))
    return comparable_name(name_or_path) if there else None


def comparable_name(name: str) -> str:
    """What two names of one sequence have in common: absolute paths, whether they exist or not.

    Args:
        name: of the catalogue, or a path; on record, or as a user named it.
    """
    return os.path.abspath(os.path.expanduser(name))
