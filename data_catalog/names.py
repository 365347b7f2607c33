"""Names of sequences: several spellings of one path, or of one sequence of the catalogue, are one name."""

from __future__ import annotations

import os
from pathlib import Path

from extrags.errors import UnknownSequenceError

__all__ = ["comparable_name", "path_of", "plain_name"]


def plain_name(name_or_path: str) -> str:
    """The name that runs of a sequence have on record: of a path that exists its plain spelling.

    `./scene//`, `scene/` and `scene` are one name. A relative path stays relative. A sequence of the
    catalogue has the name that the catalogue lists: `phantom/0` is `phantom/0@sparse`. What is neither stays
    as it is written, as does `./phantom/0`, which is a path.

    Args:
        name_or_path: what a user named.
    """
    there = os.path.exists(os.path.expanduser(name_or_path))
    return str(Path(name_or_path)) if there else _listed_name(name_or_path)


def path_of(name_or_path: str) -> str | None:
    """The absolute path of a sequence that is one, and exists; None for others.

    Args:
        name_or_path: what a user named.
    """
    there = os.path.exists(os.path.expanduser(name_or_path))
    return comparable_name(name_or_path) if there else None


def comparable_name(name: str) -> str:
    """What two names of one sequence have in common, as an absolute path, whether it exists or not.

    Args:
        name: of the catalogue, or a path; on record, or as a user named it.
    """
    place = os.path.expanduser(name)
    return os.path.abspath(place if os.path.exists(place) else os.path.expanduser(_listed_name(name)))


def _listed_name(name: str) -> str:
    """What the catalogue calls a sequence; of what it does not know, the same."""
    # Here, because it loads numpy and all readers, which who only completes a command need not wait for.
    from data_catalog.catalog import DATASETS

    try:
        found = (dataset.describe(name) for dataset in DATASETS)
        return next((item.name for item in found if item is not None), name)
    except UnknownSequenceError:
        return name
