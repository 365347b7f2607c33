"""What artefacts are found by when somebody names them: keys, stages, labels and places."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from fnmatch import fnmatchcase

from extrags.errors import StoreError
from extrags.store.manifest import Manifest

__all__ = ["found_by", "keys_of_other_places", "matches"]

log = logging.getLogger(__name__)


def matches(pattern: str, *names: str) -> bool:
    """Whether one of the names is meant, exactly or by a shell pattern: a folder's may have brackets."""
    return any(name == pattern or fnmatchcase(name, pattern) for name in names)


def found_by(manifest: Manifest) -> list[str]:
    """What an artefact is found by, beside its key."""
    return [manifest.stage, manifest.label, *([manifest.place] if manifest.place else [])]


def keys_of_other_places(name: str, named: Mapping[str, list[str]], here: str | None) -> set[str]:
    """Keys of artefacts of that name that are not of the sequence which is meant.

    Args:
        name: a relative path.
        named: keys by place; empty where it is not known.
        here: which place is meant; None where that is not known.

    Raises:
        StoreError: when none of the places is meant, or it is not known which.
    """
    places = sorted(place for place in named if place)
    if here in places:
        # Of a single known place are also those from before there were places.
        others = set(places) - {here} | ({""} if len(places) > 1 else set())
        spared = {key for place in others for key in named.get(place, [])}
        if spared:
            log.warning(
                "%s: artefacts of that name in other places, or in one that is not known, are left: %d",
                name,
                len(spared),
            )
        return spared
    if len(places) > 1 or (places and here is not None):
        said = f", not {here}" if here is not None else ""
        raise StoreError(
            f"{name} is in this store the name of {' and '.join(places)}{said}; name one of these by its path"
        )
    return set()
