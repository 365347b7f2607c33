"""Damaged artefacts inside a run: set aside, made anew, and the run goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from extrags.errors import ArtefactGoneError, DamagedArtefactError
from extrags.store import Store
from flows.failures import release_locals

__all__ = ["again_after_damage"]

log = logging.getLogger(__name__)

T = TypeVar("T")


def again_after_damage(store: Store, work: Callable[[], T]) -> T:
    """Do some work, and do it again when it met an artefact that is damaged or was set aside by another run.

    What is missing from the store when a stage looks for it is made anew there and then
    (`Store.find_or_set_aside`). This is for damage that a later stage meets when it reads its inputs: the
    damaged artefact is set aside, and everything is looked up again from the beginning, which makes it anew
    and finds what is whole in the store.

    Args:
        store: where the artefacts are.
        work: looks everything up in the store, and makes what is missing.

    Raises:
        DamagedArtefactError: when one artefact is damaged a second time: the disk is failing.
        ArtefactGoneError: when one artefact goes away a second time.
    """
    met: set[str] = set()
    while True:
        try:
            return work()
        except (ArtefactGoneError, DamagedArtefactError) as error:
            if not error.key or error.key in met:
                raise
            met.add(error.key)
            release_locals(error)  # Error and context may hold each other, and so what the stage had read.
            if isinstance(error, DamagedArtefactError):
                store.set_aside(error)
            log.warning("looking up all stages again, since %s", error)
