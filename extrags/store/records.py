"""Small records of runs beside the artefacts: how each ended, what it measured; and what is in work now.

Records are no artefacts: nothing is looked up in them to decide what a stage makes. Each has a name of its
own and is written at once or not at all, on object stores with one put; of several writers of one name, the
last one's stays. So there is no file that two machines would have to change in turns.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from extrags.errors import StoreError, reason_of
from extrags.store.artefacts import Store
from extrags.store.directory import ABOUT, held_directories

__all__ = ["in_work", "read_records", "remove_record", "write_record"]

log = logging.getLogger(__name__)

_SUFFIX = ".json"


class _Object(BaseModel):
    """Any JSON object."""


def write_record(store: Store, name: str, record: Mapping[str, Any]) -> None:
    """Write a record to a store; one of the same name is replaced.

    Args:
        store: where.
        name: letters, digits, `.`, `-` and `_`.
        record: plain JSON.

    Raises:
        StoreError: when it cannot be written.
    """
    if not re.fullmatch(r"[\w.-]+", name):
        raise StoreError(f"a record cannot be called {name!r}")
    text = json.dumps(record, indent=1, allow_nan=False).encode()
    try:
        store.backend.write_record(name + _SUFFIX, text)
    except StoreError:
        raise
    except OSError as error:
        raise StoreError(
            f"the record {name} cannot be written to {store.root}: {reason_of(error)}"
        ) from error


def read_records(
    store: Store, prefix: str = "", shape: type[BaseModel] = _Object
) -> dict[str, dict[str, Any]]:
    """Records by name, in the order of their names; one that is damaged is left out, with a warning.

    Args:
        store: where they are.
        prefix: what their names begin with.
        shape: the fields that each has, and what is in them; it may have others as well.

    Raises:
        StoreError: when the store cannot be read.
    """
    try:
        texts = store.backend.read_records(prefix)
    except OSError as error:
        raise StoreError(f"the records of {store.root} cannot be read: {reason_of(error)}") from error
    found = {}
    for name, text in sorted(texts.items()):
        try:
            record = json.loads(text)
            shape.model_validate(record)
        except ValidationError as error:
            fault = error.errors()[0]
            place = ".".join(map(str, fault["loc"]))
            _pass_over(store, name, f"{place}: {fault['msg']}" if place else fault["msg"])
        except ValueError as error:
            _pass_over(store, name, str(error))
        else:
            found[name.removesuffix(_SUFFIX)] = record
    return found


def _pass_over(store: Store, name: str, reason: str) -> None:
    log.warning("the record %s of %s is damaged and skipped: %s", name, store.root, reason)


def remove_record(store: Store, name: str) -> None:
    """Remove a record, if it is there.

    Raises:
        StoreError: when it cannot be removed.
    """
    try:
        store.backend.remove_record(name + _SUFFIX)
    except OSError as error:
        raise StoreError(
            f"the record {name} cannot be removed from {store.root}: {reason_of(error)}"
        ) from error


def in_work(store: Store) -> list[dict[str, str]]:
    """`{key, stage, label, started}` of the artefacts that are being made now.

    In a directory by any process that holds the lock of its scratch directory, which the kernel releases
    when the process ends; of an object store, by those of this machine.
    """
    found = []
    for directory in held_directories(store.backend.scratch):
        try:
            found.append(json.loads((directory / ABOUT).read_bytes()))
        except (OSError, ValueError):
            continue  # No artefact, only just begun or ended, or not for this user to read.
    return found
