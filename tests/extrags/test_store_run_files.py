"""Files that tell of the run, which the digest leaves out; and writes that were refused."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from extrags import frame_stacks
from extrags.errors import DamagedArtefactError, StoreError
from extrags.store import Ref, Store


def put(store: Store, key: str, time: str, content: str = "same") -> Ref:
    with store.slot(stage="toy", version=1, key=key) as slot:
        (slot.path / "content").write_text(content)
        (slot.path / "page").write_text(time)
        slot.run_files.add("page")
    return slot.ref


def test_run_files_do_not_change_the_digest(tmp_path: Path) -> None:
    store = Store(tmp_path)
    early, late = put(store, "toy-v1-a", "10 s"), put(store, "toy-v1-b", "99 s")
    assert early.digest == late.digest
    assert put(store, "toy-v1-c", "10 s", "other").digest != early.digest
    assert store.verify(early)
    assert store.verify(late)


def test_the_latest_run_file_is_kept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    put(store, "toy-v1-a", "10 s")
    assert (store.open(put(store, "toy-v1-a", "99 s")) / "page").read_text() == "99 s"


def test_a_damaged_run_file_is_noticed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ref = put(store, "toy-v1-a", "10 s")
    (Path(ref.uri) / "page").write_text("11 s")
    with pytest.raises(DamagedArtefactError, match="page"):
        store.open(ref)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EDQUOT, "Disk quota exceeded"),
        RuntimeError("I/O error: No space left on device (os error 28)"),
    ],
    ids=["space", "quota", "safetensors"],
)
def test_a_refused_write_names_stage_file_and_store(tmp_path: Path, error: Exception) -> None:
    store = Store(tmp_path)

    def write() -> None:
        with store.slot(stage="toy", version=1, key="toy-v1-a") as slot:
            (slot.path / "half").write_text("x")
            raise error

    with pytest.raises(
        StoreError, match=rf"^stage toy: {tmp_path}/scratch/toy-v1-a.*/half cannot be written"
    ):
        write()
    assert list((tmp_path / "scratch").iterdir()) == []


def test_a_full_folder_of_temporary_files_is_not_blamed_on_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch of the system"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", 0)

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)

    def write() -> None:
        with Store(tmp_path / "store").slot(stage="toy", version=1, key="toy-v1-a") as slot:
            (slot.path / "half").write_text("x")
            frame_stacks.empty_stack((2, 3), np.uint8)

    with pytest.raises(
        StoreError, match=rf"stage toy: {scratch} cannot be written: No space.*TMPDIR"
    ) as said:
        write()
    assert "(store" not in str(said.value)


def test_where_even_temporary_files_have_no_room_the_store_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that has not asked for that folder yet must not look for one on a full disk."""

    def nowhere() -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "gettempdir", nowhere)
    store = Store(tmp_path)
    with (
        pytest.raises(StoreError, match=r"^stage toy: .*cannot be written: No space"),
        store.slot(stage="toy", version=1, key="toy-v1-a"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_what_may_not_be_read_elsewhere_is_no_matter_of_the_store(tmp_path: Path) -> None:
    def read() -> None:
        with Store(tmp_path / "store").slot(stage="toy", version=1, key="toy-v1-a"):
            raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "video.mp4"))

    with pytest.raises(PermissionError):
        read()
