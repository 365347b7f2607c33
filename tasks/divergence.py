"""Debugging files of an optimisation that diverged."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from extrags.errors import DivergedError
from extrags.store import Slot

__all__ = ["keep_last_finite_scene"]


@contextmanager
def keep_last_finite_scene(slot: Slot) -> Iterator[None]:
    """On divergence, save the last finite scene with the debugging files of the failed stage.

    The error is kept until the last sequence of a run has ended; the scene in it is not.
    """
    try:
        yield
    except DivergedError as error:
        from extrags.scene import Scene

        if isinstance(error.last_good, Scene):
            error.last_good.save(slot.debug / "last_good_scene")
            error.last_good = None
        raise
