"""Artefacts on a server that speaks S3: whole or absent, whoever writes, and however that ends."""

from __future__ import annotations

import logging
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags.errors import ConfigError, DamagedArtefactError, StoreError
from extrags.store import Ref, Store
from extrags.zarr_io import new_group, open_group, read_array, write_frames
from tests.extrags.sweeping import swept_by_other_first
from tests.s3 import BUCKET, SECRET, s3_server

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

KEY = "toy-v1-aa"


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with s3_server():
        yield


@pytest.fixture
def url(server: None) -> str:
    return f"s3://{BUCKET}/{uuid.uuid4().hex}"


@pytest.fixture
def store(url: str, tmp_path: Path) -> Store:
    return Store(url, cache=tmp_path / "cache")


def put(store: Store, key: str = KEY, seed: int = 0, files: int = 3) -> Ref:
    frames = np.random.default_rng(seed).integers(0, 255, (4, 16, 16, 3), dtype=np.uint8)
    with store.slot(stage="toy", version=1, key=key, label="phantom/0") as slot:
        with new_group(slot.path / "frames") as group:
            write_frames(group, "rgb", frames)
        for index in range(files):
            (slot.path / f"{index}.txt").write_text(f"{seed} {index}")
    return slot.ref


def seeds_in(folder: Path) -> set[str]:
    """Of which writers the files of an artefact are."""
    return {path.read_text().split()[0] for path in folder.glob("*.txt")}


def attempts(store: Store, key: str = KEY) -> list[str]:
    backend: Any = store.backend
    return [name for name, kind in backend._children(f"{backend.prefix}/{key}") if kind == "directory"]


def test_what_is_stored_comes_back(store: Store, tmp_path: Path) -> None:
    assert not store.exists()
    store.check_writable()
    ref = put(store)
    assert store.exists()
    elsewhere = Store(store.root, cache=tmp_path / "elsewhere")
    assert elsewhere.find(KEY) == ref
    folder = elsewhere.open(ref)
    assert read_array(open_group(folder / "frames"), "rgb").shape == (4, 16, 16, 3)
    assert store.verify(ref)
    assert store.keys() == [KEY]
    assert [item.label for item in store.ls()] == ["phantom/0"]
    assert store.rm(KEY) == [KEY]
    assert store.find(KEY) is None
    assert store.keys() == []


def test_a_damaged_object_is_set_aside_and_made_anew(store: Store) -> None:
    ref = put(store)
    backend: Any = store.backend
    (name,) = [name for name in backend.fs.find(backend.prefix) if name.endswith("frames.zarr.zip")]
    content = bytearray(backend.fs.cat_file(name))
    content[len(content) // 2] ^= 4
    backend.fs.pipe_file(name, bytes(content))
    with pytest.raises(DamagedArtefactError, match=r"frames\.zarr\.zip: its content has changed") as caught:
        store.open(ref)
    place = store.set_aside(caught.value)
    assert place is not None
    assert place.startswith(f"{store.root}/damaged/{KEY}.")
    assert store.keys() == []
    assert put(store) == ref
    assert store.verify(ref)
    (removed,) = store.gc()
    assert removed.startswith(f"damaged/{KEY}.")
    backend.fs.rm_file(f"{backend.prefix}/{KEY}/{attempts(store)[0]}/1.txt")
    assert Store(store.root, cache=store.state.parent / "new").find_or_set_aside(KEY) is None


def test_an_upload_that_fails_is_invisible_and_swept(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    backend: Any = store.backend
    whole = backend.fs.put_file
    uploaded: list[str] = []

    def fails(source: str, target: str) -> None:
        if len(uploaded) == 2:
            raise OSError("the line is down")
        uploaded.append(target)
        whole(source, target)

    monkeypatch.setattr(backend.fs, "put_file", fails)
    with pytest.raises(StoreError, match="cannot be written: the line is down"):
        put(store)
    monkeypatch.undo()
    assert store.find(KEY) is None
    assert len(attempts(store)) == 1
    # Who removes an artefact leaves the uploads of others alone.
    assert store.rm("*") == []
    assert len(attempts(store)) == 1
    assert store.sweep(older_than_hours=1.0) == []
    assert len(store.sweep(older_than_hours=-0.1)) == 1
    assert store.keys() == []
    assert store.verify(put(store))


@pytest.mark.parametrize("moment", ["find", "rm"])
def test_two_machines_sweep_at_once(
    store: Store, url: str, moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend: Any = store.backend
    for index in range(3):
        backend.fs.pipe_file(f"{backend.prefix}/toy-v1-{index}/attempt/half", b"x")
    other = Store(url, cache=tmp_path / "there")
    swept = swept_by_other_first(monkeypatch, store, other, moment)
    assert len(store.sweep(older_than_hours=-0.1)) + len(swept) - 1 in (3, 4)
    assert store.keys() == []


def test_a_removal_beside_an_upload_spares_it(store: Store, tmp_path: Path) -> None:
    put(store, seed=1)
    backend: Any = store.backend
    backend.fs.pipe_file(f"{backend.prefix}/{KEY}/of-another/half", b"x")
    assert store.rm(KEY) == [KEY]
    assert attempts(store) == ["of-another"]


def test_a_bucket_that_is_missing_is_not_made(tmp_path: Path) -> None:
    import s3fs

    for prefix in ("", "/prefix"):
        with pytest.raises(StoreError, match="cannot be written"):
            Store(f"s3://missing-bucket{prefix}", cache=tmp_path).check_writable()
    assert not s3fs.S3FileSystem().exists("missing-bucket")


def test_a_server_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    s3fs.S3FileSystem.clear_instance_cache()
    store = Store(f"s3://{BUCKET}/away", cache=tmp_path)
    for action in (store.check_writable, store.exists, lambda: store.find(KEY)):
        with pytest.raises(StoreError, match=f"s3://{BUCKET}/away"):
            action()
    s3fs.S3FileSystem.clear_instance_cache()


class TestSecrets:
    @pytest.mark.parametrize(
        "url",
        [
            f"s3://key:{SECRET}@bucket/prefix",
            f"sftp://user:{SECRET}@host/place",
            f"https://host/place?sig={SECRET}",
            f"s3://bucket/prefix?aws_secret_access_key={SECRET}",
        ],
    )
    def test_a_url_with_credentials_is_refused_and_not_repeated(self, url: str, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="holds credentials") as caught:
            Store(url, cache=tmp_path)
        assert SECRET not in str(caught.value)

    def test_the_command_does_not_repeat_it(self, capsys: pytest.CaptureFixture[str]) -> None:
        from flows.cli import main

        assert main(["cache", "ls", "--store", f"s3://key:{SECRET}@bucket/prefix"]) == 2
        said = capsys.readouterr()
        assert "holds credentials" in said.err
        assert SECRET not in said.err + said.out

    def test_secrets_of_the_environment_are_nowhere(
        self, store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level(logging.DEBUG, "extrags")
        ref = put(store)
        store.open(ref)
        backend: Any = store.backend
        texts = [backend.fs.cat_file(name) for name in backend.fs.find(backend.prefix)]
        texts += [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
        assert texts
        assert not any(SECRET.encode() in text for text in texts)
        assert SECRET not in caplog.text + repr(ref)
        away = Store("s3://no-such-bucket/prefix", cache=tmp_path)
        with pytest.raises(StoreError) as caught:
            put(away)
        assert SECRET not in str(caught.value)


def _write_many(url: str, cache: str, seed: int) -> list[str]:
    store = Store(url, cache=Path(cache))
    # One key with content of each writer's own, and keys that all write alike.
    made = [put(store, "same-v1-00", seed=seed).digest]
    made += [put(store, f"alike-v1-{index:02d}", seed=index).digest for index in range(3)]
    put(store, f"own-v1-{seed:02d}", seed=seed)
    return made


@pytest.mark.parametrize("writers", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_several_processes_write_the_same_and_different_keys(url: str, tmp_path: Path, writers: int) -> None:
    context = multiprocessing.get_context("spawn")
    with context.Pool(writers) as pool:
        made = pool.starmap(_write_many, [(url, str(tmp_path / str(seed)), seed) for seed in range(writers)])
    assert len({tuple(each[1:]) for each in made}) == 1
    store = Store(url, cache=tmp_path / "reader")
    assert len(store.keys()) == 1 + 3 + writers
    for manifest in store.ls():
        ref = store.find(manifest.key)
        assert ref is not None
        # All files of an artefact are of one writer.
        assert len(seeds_in(store.open(ref))) == 1
        assert store.verify(ref)
    winner = store.find("same-v1-00")
    assert winner is not None
    assert winner.digest in {each[0] for each in made}
    store.sweep(older_than_hours=-0.1)
    left = store.keys()
    assert all(len(attempts(store, key)) == 1 for key in left)


_UPLOAD = """
import sys
from pathlib import Path
from extrags.store import Store
from tests.extrags.test_store_s3 import put
store = Store(sys.argv[1], cache=Path(sys.argv[2]))
print("ready", flush=True)
put(store, files=60)
print("done", flush=True)
"""


@pytest.mark.slow
def test_uploads_that_are_killed_leave_nothing_false(url: str, tmp_path: Path) -> None:
    chance = random.Random(0)
    store = Store(url, cache=tmp_path / "cache")
    command = [sys.executable, "-c", _UPLOAD]
    cut_short = 0
    begun = 0.0
    lasted = 0.0
    for index in range(21):
        writer = subprocess.Popen(
            [*command, url, str(tmp_path / "cache")], stdout=subprocess.PIPE, text=True, cwd=os.getcwd()
        )
        assert writer.stdout is not None
        writer.stdout.readline()
        begun = time.monotonic()
        if index == 0:
            # How long an upload takes: the kills are spread over it.
            assert writer.stdout.readline() == "done\n"
            lasted = time.monotonic() - begun
            whole = store.find(KEY)
            assert whole is not None
        else:
            time.sleep(chance.random() * lasted)
            writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        found = store.find(KEY)
        if found is None:
            cut_short += bool(attempts(store))
        else:
            assert found == whole
            assert store.verify(found)
        store.rm(KEY)
        store.sweep(older_than_hours=-0.1)
        assert store.keys() == []
        backend: Any = store.backend
        assert backend.fs.find(backend.prefix) == []
        assert not list((store.state / "scratch").iterdir())
    assert cut_short >= 8
    assert store.verify(put(store, files=60))
