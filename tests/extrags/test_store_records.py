"""Records beside the artefacts, what is in work, and manifests renewed by a refresh."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
import uuid
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from extrags.errors import StoreError
from extrags.store import Store, in_work, read_records, write_record
from extrags.store.url import UrlBackend

HOLDS = """
import sys, time
from extrags.store import Store
with Store(sys.argv[1]).slot(stage="toy", version=1, key="toy-v1-b", label="other"):
    print("in", flush=True)
    time.sleep(99)
"""


@pytest.fixture(params=["directory", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "directory":
        return Store(tmp_path / "store")
    return Store(f"memory://{tmp_path.name}", cache=tmp_path / "cache")


def fill(store: Store, key: str, text: str, *, renew: bool = False) -> None:
    with store.slot(stage="toy", version=1, key=key, label="seq", renew=renew) as slot:
        (slot.path / "a.txt").write_text(text)


class TestRecords:
    def test_written_replaced_and_found_by_the_begin_of_their_names(self, store: Store) -> None:
        assert read_records(store) == {}
        write_record(store, "outcome.b", {"n": 1})
        write_record(store, "outcome.a", {"n": 2})
        write_record(store, "outcome.b", {"n": 3})
        write_record(store, "benchmark.x", {})
        assert list(read_records(store, "outcome.").items()) == [
            ("outcome.a", {"n": 2}),
            ("outcome.b", {"n": 3}),
        ]

    def test_they_are_no_artefacts_and_stay(self, store: Store) -> None:
        fill(store, "toy-v1-a", "x")
        write_record(store, "outcome.a", {"n": 2})
        assert store.keys() == ["toy-v1-a"]
        assert [manifest.key for manifest in store.ls()] == ["toy-v1-a"]
        store.gc(older_than_hours=0.0)
        store.rm("toy*")
        assert store.keys() == []
        assert read_records(store) == {"outcome.a": {"n": 2}}

    def test_a_damaged_one_is_passed_over(self, store: Store, caplog: pytest.LogCaptureFixture) -> None:
        write_record(store, "outcome.a", {"n": 2})
        store.backend.write_record("outcome.b.json", b"{")
        store.backend.write_record("outcome.c.json", b"3")
        store.backend.write_record("outcome.d.json", b"[]")
        assert list(read_records(store)) == ["outcome.a"]
        for name in "bcd":
            assert f"outcome.{name}.json" in caplog.text

    def test_one_without_its_fields_is_damaged(self, store: Store, caplog: pytest.LogCaptureFixture) -> None:
        class Shape(BaseModel):
            n: int
            rows: list[dict[str, int]] = []

        for name, record in {
            "a": {"n": 2, "more": "x"},
            "b": {},
            "c": {"n": 1, "rows": [{"k": "?"}]},
        }.items():
            write_record(store, name, record)
        assert read_records(store, shape=Shape) == {"a": {"n": 2, "more": "x"}}
        assert "b.json of" in caplog.text
        assert "is damaged and skipped: n: Field required" in caplog.text
        assert "is damaged and skipped: rows.0.k: Input should be" in caplog.text

    def test_one_that_cannot_be_read_is_not_taken_for_gone(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Retention would remove what that run has used."""
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path / "cache")
        for name in ("run-a", "run-b", "run-c"):
            write_record(store, name, {"n": 1})
        assert isinstance(store.backend, UrlBackend)
        read = store.backend.fs.cat_file

        def failing(path: str, *given: Any, **more: Any) -> bytes:
            if "run-b" in path:
                raise problem
            return bytes(read(path, *given, **more))

        monkeypatch.setattr(
            type(store.backend.fs), "cat_file", lambda _, *given, **more: failing(*given, **more)
        )
        problem: Exception = TimeoutError("no answer")
        with pytest.raises(StoreError, match=r"records cannot be read.*no answer"):
            read_records(store)
        problem = FileNotFoundError("removed meanwhile")
        assert list(read_records(store)) == ["run-a", "run-c"]

    def test_any_failure_to_write_is_one_of_the_store(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        class EndpointConnectionError(Exception):
            """As botocore's: no OSError."""

        def failing(*_given: object, **_more: object) -> None:
            raise EndpointConnectionError("no route")

        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path / "cache")
        assert isinstance(store.backend, UrlBackend)
        monkeypatch.setattr(type(store.backend.fs), "pipe_file", failing)
        with pytest.raises(StoreError, match=r"outcome\.a.* cannot be written.*no route"):
            write_record(store, "outcome.a", {})

    @pytest.mark.parametrize("name", ["", "../x", "a/b", "a b"])
    def test_names_are_no_paths(self, store: Store, name: str) -> None:
        with pytest.raises(StoreError, match="cannot be called"):
            write_record(store, name, {})

    def test_writers_of_one_name_never_mix(self, store: Store) -> None:
        def write(number: int) -> None:
            for _ in range(20):
                write_record(store, "outcome.a", {"n": [number] * 500})

        threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            for record in read_records(store).values():
                assert len(set(record["n"])) == 1
        for thread in threads:
            thread.join()
        assert len(read_records(store)) == 1

    def test_a_store_that_cannot_be_written_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "store").mkdir()
        (tmp_path / "store" / "records").write_text("in the way")
        with pytest.raises(StoreError, match=str(tmp_path / "store")):
            write_record(Store(tmp_path / "store"), "outcome.a", {})


class TestInWork:
    def test_what_is_made_here_and_by_others(self, store: Store) -> None:
        with store.slot(stage="toy", version=1, key="toy-v1-a", label="seq"):
            (found,) = in_work(store)
            assert (found["key"], found["stage"], found["label"]) == ("toy-v1-a", "toy", "seq")
        assert in_work(store) == []

    def test_a_killed_process_works_no_more(self, tmp_path: Path) -> None:
        store = Store(tmp_path / "store")
        command = [sys.executable, "-c", HOLDS, store.root]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"in\n"
            assert [item["label"] for item in in_work(store)] == ["other"]
            process.kill()
        assert in_work(store) == []
        assert len(list((tmp_path / "store" / "scratch").iterdir())) == 1, "the next run sweeps it"


class TestRenewed:
    def test_equal_content_made_again_says_when_it_was_made_last(self, store: Store) -> None:
        fill(store, "toy-v1-a", "x")
        (first,) = store.ls()
        with store.slot(stage="toy", version=1, key="toy-v1-a", label="later", renew=True) as slot:
            (slot.path / "a.txt").write_text("x")
            slot.counts["n"] = 3
        (second,) = store.ls()
        assert (second.digest, second.label, second.counts) == (first.digest, "later", {"n": 3})
        ref = store.find("toy-v1-a")
        assert ref is not None
        assert store.verify(ref)
        assert (store.open(ref) / "a.txt").read_text() == "x"

    def test_without_it_the_first_stays(self, store: Store) -> None:
        fill(store, "toy-v1-a", "x")
        (first,) = store.ls()
        fill(store, "toy-v1-a", "x")
        assert store.ls() == [first]
        json.dumps(first.model_dump(mode="json"))


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES])
def test_a_record_that_the_disk_does_not_give_back_hides_no_other(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    for name in ("one", "other"):
        write_record(store, name, {"name": name})
    usual = Path.read_bytes

    def failing(path: Path) -> bytes:
        if path.name == "one.json":
            raise OSError(number, os.strerror(number), str(path))
        return usual(path)

    monkeypatch.setattr(Path, "read_bytes", failing)
    if number == errno.EIO:
        assert read_records(store) == {"other": {"name": "other"}}
        assert "the record one.json" in caplog.text
    else:
        with pytest.raises(StoreError, match="Permission denied"):
            read_records(store)
