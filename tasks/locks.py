"""A Prefect lock manager on `flock(2)`.

Prefect's own file locks become stale when their holder is killed. The kernel releases a `flock` with the last
file descriptor of its process, for whatever reason the process ends. Requires a local file system or NFSv4.
With object stores, locks are local to a machine (in its cache directory); machines that race for one key
both compute it, which is harmless: artefacts are written atomically, and the first one is kept.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import logging
import os
import threading
import time
from pathlib import Path
from typing import Any

from prefect.locking.protocol import LockManager

from extrags.errors import StoreError, reason_of

__all__ = ["FlockManager", "sweep_locks"]

log = logging.getLogger(__name__)

POLL_SECONDS = 0.05
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
"""What `flock` says on file systems that have none, as some mounts of networks."""


class FlockManager(LockManager):
    """One lock file per key below a directory; the file is removed on release.

    Args:
        directory: where the lock files stand.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = Path(directory)
        self._guard = threading.Lock()
        self._held: dict[str, tuple[str, int]] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Locks belong to the process that acquired them; a copy in a worker starts without any.
        return {"directory": self.directory}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["directory"])  # type: ignore[misc]

    def __deepcopy__(self, memo: dict[int, Any]) -> FlockManager:
        # CachePolicy.configure() deep-copies the policy; all copies must know the same held locks.
        return self

    def acquire_lock(
        self,
        key: str,
        holder: str,
        acquire_timeout: float | None = None,
        hold_timeout: float | None = None,
    ) -> bool:
        """Acquire the lock of a key; waits for `acquire_timeout` seconds, or without limit.

        `hold_timeout` is not needed: a lock never outlives its process.

        Raises:
            StoreError: when the lock's file may not be opened, or its file system has no locks.
        """
        if self.is_lock_holder(key, holder):
            return True
        descriptor = _lock_file(self._path(key), acquire_timeout)
        if descriptor is None:
            return False
        with self._guard:
            self._held[key] = (holder, descriptor)
        return True

    async def aacquire_lock(
        self,
        key: str,
        holder: str,
        acquire_timeout: float | None = None,
        hold_timeout: float | None = None,
    ) -> bool:
        """As `acquire_lock`, without blocking the event loop."""
        return await asyncio.to_thread(self.acquire_lock, key, holder, acquire_timeout, hold_timeout)

    def release_lock(self, key: str, holder: str) -> None:
        """Release the lock and remove its file.

        Raises:
            ValueError: when `holder` does not hold it (the protocol's contract).
        """
        with self._guard:
            owner, descriptor = self._held.get(key, ("", -1))
            if owner != holder:
                raise ValueError(f"no lock held by {holder} for {key}")
            del self._held[key]
        # Unlinked while still locked: a process that waits on this inode then finds that the path is gone
        # or refers to another inode, and retries.
        try:
            self._path(key).unlink(missing_ok=True)
        finally:
            os.close(descriptor)

    def is_locked(self, key: str) -> bool:
        """Whether anybody holds the lock of a key.

        Raises:
            StoreError: when its file system has no locks.
        """
        with self._guard:
            if key in self._held:
                return True
        try:
            # Read alone: the file may be another user's.
            descriptor = os.open(self._path(key), os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            return not _locked(descriptor, self._path(key), fcntl.LOCK_SH)
        finally:
            os.close(descriptor)

    def is_lock_holder(self, key: str, holder: str) -> bool:
        """Whether `holder` took the lock through this manager."""
        with self._guard:
            return self._held.get(key, ("", -1))[0] == holder

    def wait_for_lock(self, key: str, timeout: float | None = None) -> bool:
        """Wait until nobody holds the lock of a key; False when the time is up."""
        end = None if timeout is None else time.monotonic() + timeout
        while self.is_locked(key):
            if end is not None and time.monotonic() >= end:
                return False
            time.sleep(POLL_SECONDS)
        return True

    async def await_for_lock(self, key: str, timeout: float | None = None) -> bool:
        """As `wait_for_lock`, without blocking the event loop."""
        return await asyncio.to_thread(self.wait_for_lock, key, timeout)

    def _path(self, key: str) -> Path:
        return self.directory / f"{key}.lock"


def _lock_file(path: Path, timeout: float | None) -> int | None:
    """Open and lock the file at a path, retrying if it is replaced meanwhile; None on timeout.

    Raises:
        StoreError: when the file may not be opened, as one of another user, or its file system has no locks.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    end = None if timeout is None else time.monotonic() + timeout
    while True:
        try:
            # For all who may write what is written here: the umask says who they are.
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except PermissionError as error:
            raise StoreError(
                f"the lock {path} cannot be opened: {error.strerror}. Users who share a store need a group "
                "that may write its folders and files (umask 002)"
            ) from error
        try:
            wait = not _locked(descriptor, path, fcntl.LOCK_EX)
            # Its former holder may have removed the file between our open and our lock.
            if not wait and _is_at(descriptor, path):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        if wait:
            if end is not None and time.monotonic() >= end:
                return None
            time.sleep(POLL_SECONDS)


def _locked(descriptor: int, path: Path, kind: int) -> bool:
    """Lock an open file without waiting; False where another holds it.

    Args:
        descriptor: of the open file.
        path: its place, for messages.
        kind: LOCK_EX or LOCK_SH.

    Raises:
        StoreError: when it cannot be locked at all.
    """
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise StoreError(f"{path} cannot be locked: {reason_of(error)}") from error
        raise StoreError(
            f"{path} cannot be locked: its file system has no locks ({reason_of(error)}). A store needs a "
            "local file system, NFSv4 or an object store"
        ) from error
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def sweep_locks(directory: Path) -> list[str]:
    """Remove the lock files that killed processes left (they lock nothing any more).

    Those that may not be opened or removed, as those of another user, stay.
    """
    removed = []
    for path in sorted(directory.glob("*.lock")) if directory.is_dir() else []:
        try:
            descriptor = _lock_file(path, 0.0)
        except StoreError as error:
            log.debug("%s", error)
            continue
        if descriptor is None:
            continue
        try:
            path.unlink(missing_ok=True)
            removed.append(f"{directory.name}/{path.name}")
        except PermissionError as error:
            log.debug("the lock %s cannot be removed: %s", path, error.strerror)
        finally:
            os.close(descriptor)
    return removed
