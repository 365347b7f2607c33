"""Shell patterns over the names of the catalogue: `c3vdv2/*@sparse`, `phantom/[0-3]@sparse`."""

from __future__ import annotations

import re
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import NamedTuple

from data_catalog.catalog import list_sequences
from data_catalog.names import plain_name
from extrags.errors import SourceNotFoundError, UnknownSequenceError
from extrags.user_paths import expanded

__all__ = ["Matched", "is_named", "is_pattern", "matching_names"]

_NEAR = 3


class Matched(NamedTuple):
    """What a pattern stands for on this machine.

    Args:
        names: in the order of the catalogue.
        elsewhere: names that match as well, but whose data are not here.
    """

    names: tuple[str, ...]
    elsewhere: tuple[str, ...]


def is_pattern(text: str) -> bool:
    """Whether a text is a pattern over names: it has `*`, `?` or `[`, and no such path exists."""
    return re.search(r"[*?\[]", text) is not None and not expanded(text).exists()


def is_named(name: str, pattern: str) -> bool:
    """Whether a text names a sequence, in any spelling or as a pattern; folders may have brackets."""
    return name in (pattern, plain_name(pattern)) or fnmatchcase(name, pattern)


def matching_names(pattern: str) -> Matched:
    """The names that match a shell pattern; of the phantom's endless scenes, those that are listed.

    Args:
        pattern: with `*` (also across `/`), `?`, `[0-3]`.

    Raises:
        UnknownSequenceError: nothing matches; names what is near.
        SourceNotFoundError: names match, but the data of none are on this machine.
    """
    listed = list_sequences()
    found = [item for item in listed if fnmatchcase(item.name, pattern)]
    if not found:
        known = [item.name for item in listed]
        bare = re.sub(r"\[(.)[^\]]*\]", r"\1", pattern).replace("*", "").replace("?", "")
        near = get_close_matches(bare, known, n=_NEAR, cutoff=0.4)
        hint = f"near ones: {', '.join(near)}" if near else "all names: extrags data list"
        raise UnknownSequenceError(f"the pattern {pattern!r} matches no sequence of the catalogue; {hint}")
    here = tuple(item.name for item in found if item.available)
    elsewhere = tuple(item.name for item in found if not item.available)
    if not here:
        raise SourceNotFoundError(
            f"the pattern {pattern!r} matches {len(found)} sequences, but the data of none are on this "
            f"machine: {', '.join(elsewhere[:_NEAR])}{', ...' if len(elsewhere) > _NEAR else ''}"
        )
    return Matched(here, elsewhere)
