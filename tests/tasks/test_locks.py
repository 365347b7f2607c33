"""Locks are exclusive, survive no process, and leave no file."""

from __future__ import annotations

import copy
import errno
import fcntl
import multiprocessing
import os
import pickle
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from prefect.locking.protocol import LockManager

from extrags.errors import StoreError
from tasks.locks import FlockManager, sweep_locks


def test_one_holder_at_a_time(tmp_path: Path) -> None:
    first, second = FlockManager(tmp_path), FlockManager(tmp_path)
    assert isinstance(first, LockManager)
    assert first.acquire_lock("k", "a")
    assert first.acquire_lock("k", "a")
    assert first.is_locked("k")
    assert second.is_locked("k")
    assert first.is_lock_holder("k", "a")
    assert not second.is_lock_holder("k", "a")
    assert not second.acquire_lock("k", "b", acquire_timeout=0.0)
    assert not first.acquire_lock("k", "b", acquire_timeout=0.0)
    assert not second.wait_for_lock("k", timeout=0.0)
    with pytest.raises(ValueError, match="no lock held by b"):
        second.release_lock("k", "b")
    first.release_lock("k", "a")
    assert not second.is_locked("k")
    assert second.acquire_lock("k", "b", acquire_timeout=0.0)
    second.release_lock("k", "b")
    assert list(tmp_path.iterdir()) == []


def test_a_waiter_gets_the_lock_when_it_is_released(tmp_path: Path) -> None:
    first, second = FlockManager(tmp_path), FlockManager(tmp_path)
    first.acquire_lock("k", "a")
    got = threading.Event()

    def wait() -> None:
        assert second.acquire_lock("k", "b")
        got.set()

    waiter = threading.Thread(target=wait)
    waiter.start()
    time.sleep(0.1)
    assert not got.is_set()
    first.release_lock("k", "a")
    assert got.wait(5)
    waiter.join()
    second.release_lock("k", "b")
    assert list(tmp_path.iterdir()) == []


def test_copies_share_locks_and_pickles_do_not(tmp_path: Path) -> None:
    manager = FlockManager(tmp_path)
    manager.acquire_lock("k", "a")
    assert copy.deepcopy(manager).is_lock_holder("k", "a")
    other = pickle.loads(pickle.dumps(manager))
    assert other.is_locked("k")
    assert not other.is_lock_holder("k", "a")
    manager.release_lock("k", "a")


def test_sigkill_frees_the_lock_and_sweep_removes_its_file(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from tasks.locks import FlockManager\n"
        "FlockManager(Path(sys.argv[1])).acquire_lock('k', 'a'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    manager = FlockManager(tmp_path)
    manager.acquire_lock("held", "me")
    assert not manager.is_locked("k")
    assert sweep_locks(tmp_path) == [f"{tmp_path.name}/k.lock"]
    assert manager.acquire_lock("k", "b", acquire_timeout=0.0)
    manager.release_lock("k", "b")
    manager.release_lock("held", "me")
    assert list(tmp_path.iterdir()) == []


def test_a_lock_is_for_all_who_may_write_there(tmp_path: Path) -> None:
    manager, before = FlockManager(tmp_path), os.umask(0o002)
    try:
        manager.acquire_lock("k", "a")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "k.lock").stat().st_mode) == 0o664
    manager.release_lock("k", "a")


def test_a_lock_of_another_user_stays_and_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("k", "ours"):
        (tmp_path / f"{name}.lock").touch()
    opened = os.open

    def refusing(path: str | Path, flags: int, *mode: int) -> int:
        if Path(path).name == "k.lock" and flags & os.O_RDWR:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", refusing)
    assert sweep_locks(tmp_path) == [f"{tmp_path.name}/ours.lock"]
    manager = FlockManager(tmp_path)
    assert not manager.is_locked("k")
    with pytest.raises(StoreError, match=r"k\.lock cannot be opened: Permission denied"):
        manager.acquire_lock("k", "b", acquire_timeout=0.0)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOLCK, r"k\.lock cannot be locked: its file system has no locks \(No locks available\)"),
        (errno.EOPNOTSUPP, r"k\.lock cannot be locked: its file system has no locks"),
        (errno.EIO, r"k\.lock cannot be locked: Input/output error"),
    ],
)
def test_a_file_system_without_locks_is_named_and_nothing_stays_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    def refusing(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    manager, open_before = FlockManager(tmp_path), len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(fcntl, "flock", refusing)
    with pytest.raises(StoreError, match=said):
        manager.acquire_lock("k", "a")
    with pytest.raises(StoreError, match=said):
        manager.is_locked("k")
    assert sweep_locks(tmp_path) == []
    assert len(os.listdir("/proc/self/fd")) == open_before


def test_a_lock_that_may_not_be_removed_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "k.lock").touch()

    def refused(path: Path, **_: bool) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", refused)
        assert sweep_locks(tmp_path) == []
    assert sweep_locks(tmp_path) == [f"{tmp_path.name}/k.lock"]


def test_many_processes_never_hold_it_together(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        pool.map(_count_up, [str(tmp_path)] * 2)
    assert (tmp_path / "count").read_text() == "100"
    assert [path.name for path in tmp_path.iterdir()] == ["count"]


def _count_up(directory: str) -> None:
    manager = FlockManager(Path(directory))
    count = Path(directory) / "count"
    for turn in range(50):
        assert manager.acquire_lock("k", f"{turn}")
        count.write_text(str(int(count.read_text()) + 1 if count.exists() else 1))
        manager.release_lock("k", f"{turn}")
