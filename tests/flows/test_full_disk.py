"""A disk that becomes full in the middle of any stage: a small file system in memory, filled up."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from extrags.errors import StoreError
from extrags.store import Manifest, Store
from extrags.store.retention import INTERMEDIATE_STAGES
from flows.limits import can_pass
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, tiny_config

DISK_MIB = 96


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    place = tmp_path_factory.mktemp("disk")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(place)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.decode().strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def fill(disk: Path, left: int) -> Path:
    """Take all room but so many bytes."""
    ballast = disk / "ballast"
    with ballast.open("wb") as stream:
        room = os.statvfs(disk)
        free = room.f_bavail * room.f_frsize
        os.posix_fallocate(stream.fileno(), 0, max(room.f_frsize, free - left))
    return ballast


def made(store: str) -> dict[str, Manifest]:
    return {manifest.stage: manifest for manifest in Store(store).ls()}


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5], ids=["at once", "half way"])
def test_every_stage_says_what_it_could_not_write_and_resumes(
    finished: tuple[str, SequenceOutcome], disk: Path, share: float
) -> None:
    whole, undisturbed = finished
    store = disk / "store"
    shutil.copytree(whole, store)
    places = 0
    for stage, manifest in sorted(made(whole).items()):
        if stage in INTERMEDIATE_STAGES:
            continue  # Nothing asks for it where the metrics are there.
        Store(store).rm(manifest.key)
        ballast = fill(disk, int(share * manifest.bytes))
        runner = DirectRunner(str(store))
        outcome = run_sequence(SEQUENCE, tiny_config(), str(store), runner, profile="quick")
        if share and outcome.status == "ok":
            # Blocks are whole: half of a small artefact may leave room for all of it.
            assert manifest.bytes < 65536, stage
        else:
            error = outcome.error
            assert type(error) is StoreError, (stage, repr(error))
            assert str(error).startswith(f"stage {stage}: {store}/scratch/{manifest.key}"), error
            assert str(error).endswith(f"cannot be written: No space left on device (store {store})")
            assert not can_pass(error)
            assert Store(store).find(manifest.key) is None
            places += 1
        assert not list((store / "scratch").iterdir()), stage
        ballast.unlink()
        resumed = run_sequence(SEQUENCE, tiny_config(), str(store), runner, profile="quick")
        assert resumed.status == "ok", stage
        assert resumed.digests == undisturbed.digests, stage
        assert not list((store / "scratch").iterdir()), stage
        assert sorted(Store(store).keys()) == sorted(Store(whole).keys())
    assert places >= 10
    shutil.rmtree(store)


def test_a_full_disk_is_named_with_stage_path_and_store(disk: Path) -> None:
    store = Store(disk / "small")
    store.check_writable()
    ballast = fill(disk, 65536)

    def write() -> None:
        with store.slot(stage="toy", version=1, key="toy-v1-x") as slot:
            (slot.path / "first").write_bytes(b"x")
            (slot.path / "half").write_bytes(bytes(1 << 20))

    with pytest.raises(StoreError, match=r"stage toy: .*/half cannot be written: No space left .*store "):
        write()
    ballast.unlink()
    assert store.keys() == []
    assert list(store.backend.scratch.iterdir()) == []


def test_a_full_disk_is_told_where_the_server_of_the_run_only_fails(disk: Path) -> None:
    """The database lies in the store: where there is no room, Prefect's server answers 500."""
    from flows.temporary_server import ServerError, _check_room

    home = disk / "prefect"
    home.mkdir()
    _check_room(home)
    fill(disk, 4096)
    try:
        with pytest.raises(ServerError, match=r"prefect cannot be written \(No space left on device\)"):
            _check_room(home)
    finally:
        (disk / "ballast").unlink()
    assert list(home.iterdir()) == []
