"""The folder that a training writes into: what is there already, and that no other training does so too."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from extrags.errors import ConfigError, StoreError, WeightsError, reason_of

__all__ = ["CHECKPOINT", "check_weights_there", "sole_training"]

logger = logging.getLogger(__name__)

CHECKPOINT = "checkpoint.safetensors"


@contextmanager
def sole_training(folder: Path) -> Iterator[None]:
    """No other training writes into the folder during this block; one that was killed holds nothing up.

    Args:
        folder: is there.

    Raises:
        ConfigError: when another training has it.
    """
    from tasks.locks import FlockManager

    locks, holder = FlockManager(folder), uuid4().hex
    free, without_locks = True, ""
    try:
        free = locks.acquire_lock("pretrain", holder, acquire_timeout=0.0)
    except StoreError as error:
        cause = error.__cause__
        if isinstance(cause, PermissionError) or not isinstance(cause, OSError):
            raise ConfigError(f"--output {folder}: {error}") from error
        without_locks = reason_of(cause)
    except OSError as error:
        without_locks = reason_of(error)
    if without_locks:
        # File systems without locks are no reason not to train.
        logger.warning("%s cannot be locked against a second training: %s", folder, without_locks)
    if not free:
        raise ConfigError(
            f"--output {folder}: another training writes there now, and the two would spoil each other's "
            "checkpoint; wait for its end, or take another folder"
        )
    try:
        yield
    finally:
        if not without_locks:
            locks.release_lock("pretrain", holder)


def check_weights_there(folder: Path, backend: str) -> None:
    """Refuse a folder whose weights would be lost.

    The descriptions of restorers and refiners have one name: the one that is written last is the only one.
    A restorer's training goes on in its folder from its checkpoint, which is gone once all steps are made:
    who asks for more steps then would get weights that are trained anew.

    Args:
        folder: where weights go; need not be there.
        backend: what they are of, as their description says.

    Raises:
        ConfigError: when the folder holds the description of another kind of weights, or a restorer without a
            checkpoint.
    """
    from extrags.restoration.description import DESCRIPTION, read_description

    try:
        found = read_description(folder / DESCRIPTION).get("backend")
    except WeightsError:
        # None there, or one that nothing can read: no weights would be lost.
        return
    if found != backend:
        raise ConfigError(
            f"--output {folder}: {DESCRIPTION} there describes other weights (backend {found}), and would be "
            f"overwritten by that of these ({backend}); take another folder"
        )
    if backend == "embedded" and not (folder / CHECKPOINT).is_file():
        raise ConfigError(
            f"--output {folder}: a finished restorer is there, and no checkpoint to go on from; take another "
            f"folder, with --start {folder} to train it further, or remove {DESCRIPTION} to overwrite it"
        )
