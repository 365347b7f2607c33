"""Objects that a process has loaded last: a run reads the same frames in nearly every stage."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from extrags.store.storable import Storable

__all__ = ["forget_loaded", "kept_or_read"]

S = TypeVar("S", bound=Storable)

MOST_KEPT = 2
"""A run reads its frames and, without the held-out ones, its training frames; some stages both."""
KEPT_BYTES = 4 << 30
"""Beside the last one, of all arrays together: those of a long recording take room for temporary files."""

_kept: dict[tuple[type[Storable], str], Storable] = {}
"""By class and digest; the one that was asked for last is the last."""


def forget_loaded() -> None:
    """Keep no loaded object any longer: its memory, or the room of its mapped files, is free."""
    _kept.clear()


def kept_or_read(kind: type[S], digest: str, read: Callable[[], S]) -> S:
    """An object that is kept, else what `read` gives, which is kept from now on.

    Args:
        kind: its class.
        digest: of the artefact that holds it.
        read: reads it from there.
    """
    kept = _kept.pop((kind, digest), None)
    if isinstance(kept, kind):
        found = kept
    else:
        # Before, not after: long recordings take much room.
        _make_room(MOST_KEPT - 1, KEPT_BYTES)
        found = read()
    _make_room(MOST_KEPT - 1, KEPT_BYTES - _size(found))
    _kept[kind, digest] = found
    return found


def _make_room(most: int, most_bytes: int) -> None:
    """Let the oldest go; other threads may do so at the same time."""
    for key in list(_kept):
        if len(_kept) > most or sum(map(_size, list(_kept.values()))) > most_bytes:
            _kept.pop(key, None)
        else:
            break


def _size(found: Storable) -> int:
    """Bytes of its arrays."""
    # Without numpy, which commands that only look into a store do not load.
    return sum(getattr(value, "nbytes", 0) for value in vars(found).values())
