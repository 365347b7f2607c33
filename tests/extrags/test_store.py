"""Keys depend on content only; artefacts are whole or absent."""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import signal
import stat
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

import extrags.store.directory
from extrags.config import CoarseConfig, IngestConfig
from extrags.errors import ConfigError, DamagedArtefactError, MissingDependencyError, StoreError
from extrags.store import MANIFEST, Manifest, Ref, Store, canonical, content_digest, digest_of
from extrags.store.directory import held_directories
from extrags.store.integrity import Examinable
from tests.extrags.sweeping import swept_by_other_first
from tests.other_user import give_to_another_user

plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.text(max_size=4).filter(lambda name: not name.startswith("$")), inner, max_size=4
        )
    ),
    max_leaves=12,
)


class TestCanonical:
    @given(plain)
    def test_order_of_insertion_does_not_count(self, value: object) -> None:
        def turned(node: object) -> object:
            if isinstance(node, dict):
                return {name: turned(item) for name, item in reversed(node.items())}
            return [turned(item) for item in node] if isinstance(node, list) else node

        assert digest_of(turned(value)) == digest_of(value)

    @pytest.mark.parametrize(
        ("first", "second"),
        [
            (1, 1.0),
            (1, True),
            (0, False),
            ("1", 1),
            (None, "null"),
            ({"a": 1}, {"b": 1}),
            ([1, 2], [2, 1]),
            (0.1, 0.1 + 2 ** (-56)),
            ({"x": Ref(uri="p", digest="d")}, {"x": "d"}),
            ("0x1p+0", 1.0),
        ],
    )
    def test_different_values_have_different_keys(self, first: object, second: object) -> None:
        assert digest_of(first) != digest_of(second)

    def test_equal_values_have_equal_keys(self) -> None:
        assert digest_of((1, 2)) == digest_of([1, 2])
        assert digest_of(0.0) == digest_of(-0.0)

    def test_ref_counts_by_its_digest_alone(self) -> None:
        assert digest_of(Ref(uri="here", digest="d")) == digest_of(Ref(uri="there", digest="d"))
        assert digest_of(Ref(uri="here", digest="d")) != digest_of(Ref(uri="here", digest="e"))

    @pytest.mark.parametrize("field", ["iterations", "sh_degree", "depth_weight", "seed"])
    def test_every_field_of_a_model_counts(self, field: str) -> None:
        config = CoarseConfig()
        other = config.model_copy(update={field: getattr(config, field) + 1})
        assert digest_of(config) != digest_of(other)

    def test_nested_model_fields_count(self) -> None:
        config = CoarseConfig()
        other = config.model_copy(update={"light": config.light.model_copy(update={"enabled": False})})
        assert digest_of(config) != digest_of(other)

    def test_moving_or_renaming_the_class_does_not_count(self) -> None:
        class First(BaseModel):
            steps: int = 3

        class Second(BaseModel):
            steps: int = 3

        assert digest_of(First()) == digest_of(Second())

    @pytest.mark.parametrize(
        "value",
        [
            {1, 2},
            frozenset(),
            Path("x"),
            np.zeros(2),
            np.float32(1),
            print,
            b"x",
            object(),
            {1: 2},
            {"$ref": 1},
            float("nan"),
            float("inf"),
        ],
        ids=lambda value: type(value).__name__,
    )
    def test_refuses_what_has_no_stable_content(self, value: object) -> None:
        with pytest.raises(ConfigError, match=r"value\.deep\[0\]"):
            canonical({"deep": [value]})

    def test_digest_is_the_same_in_another_process(self) -> None:
        value = {"b": [1, 2.5, None], "a": "é"}
        code = f"from extrags.store import digest_of; print(digest_of({value!r}))"
        other = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": "7"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert other.stdout.strip() == digest_of(value)
        # Golden: a change here silently invalidates every artefact users have.
        assert digest_of(value) == "b319363c676d28c24377cfb85da55656"


@pytest.fixture(params=["directory", "folders", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    if request.param == "directory":
        yield Store(tmp_path / "store")
    elif request.param == "folders":
        # Behind a URL, but a file system with real directories, as SFTP is.
        yield Store(f"local://{tmp_path}/new/store", cache=tmp_path / "cache")
    else:
        made = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path / "cache")
        yield made
        for name in made.backend.names():
            made.backend.discard(name)


def put(store: Store, key: str = "toy-v1-aa", text: str = "hello", **about: object) -> Ref:
    with store.slot(stage="toy", version=1, key=key, **about) as slot:  # type: ignore[arg-type]
        (slot.path / "deep").mkdir()
        (slot.path / "deep" / "file.txt").write_text(text)
        slot.counts["letters"] = len(text)
    return slot.ref


class TestStore:
    def test_what_was_put_is_found_and_opened(self, store: Store) -> None:
        source = put(store, "toy-v1-source")
        ref = put(store, config={"a": 1}, inputs={"source": source}, label="phantom/0@sparse")
        assert store.find("toy-v1-aa") == ref
        assert (store.open(ref) / "deep" / "file.txt").read_text() == "hello"
        manifest = store.manifest(ref)
        assert (manifest.stage, manifest.version, manifest.label) == ("toy", 1, "phantom/0@sparse")
        assert manifest.config == {"a": 1}
        assert manifest.inputs == {"source": source.digest}
        assert manifest.input_keys == {"source": "toy-v1-source"}
        assert manifest.counts == {"letters": 5}
        assert (manifest.files, manifest.bytes) == (1, 5)
        assert "python" in manifest.software
        assert store.verify(ref)

    def test_a_check_leaves_nothing(self, store: Store) -> None:
        store.check_writable()
        assert store.keys() == []
        assert list(store.backend.scratch.iterdir()) == []
        put(store)
        store.check_writable()
        assert store.keys() == ["toy-v1-aa"]

    def test_an_absent_key_is_none(self, store: Store) -> None:
        assert store.find("toy-v1-none") is None
        assert store.ls() == []
        assert store.sweep() == []

    def test_equal_content_has_equal_digest_under_any_key(self, store: Store) -> None:
        assert put(store, "toy-v1-a").digest == put(store, "toy-v1-b").digest
        assert put(store, "toy-v1-c", "other").digest != put(store, "toy-v1-d").digest

    def test_names_count_in_the_digest(self, tmp_path: Path) -> None:
        (tmp_path / "a").mkdir()
        (tmp_path / "a" / "x").write_text("1")
        (tmp_path / "b").mkdir()
        (tmp_path / "b" / "y").write_text("1")
        assert content_digest(tmp_path / "a")[0] != content_digest(tmp_path / "b")[0]

    def test_a_failing_block_leaves_nothing(self, store: Store) -> None:
        def fail() -> None:
            with store.slot(stage="toy", version=1, key="toy-v1-bad") as slot:
                (slot.path / "half").write_text("x")
                raise ArithmeticError("no")

        with pytest.raises(ArithmeticError):
            fail()
        assert store.find("toy-v1-bad") is None
        assert store.backend.names() == []
        assert list(store.backend.scratch.iterdir()) == []

    def test_a_failure_may_keep_debugging_files(self, store: Store) -> None:
        def fail() -> None:
            with store.slot(stage="toy", version=1, key="toy-v1-bad", label="me") as slot:
                (slot.debug / "last_good.txt").write_text("step 7")
                raise ArithmeticError("diverged")

        with pytest.raises(ArithmeticError):
            fail()
        kept = store.state / "failed" / "toy-v1-bad"
        assert (kept / "last_good.txt").read_text() == "step 7"
        assert "diverged" in (kept / "error.json").read_text()
        assert store.find("toy-v1-bad") is None
        assert "failed/toy-v1-bad" in store.gc()
        assert not kept.exists()

    def test_a_success_keeps_no_debugging_files(self, store: Store) -> None:
        with store.slot(stage="toy", version=1, key="toy-v1-ok") as slot:
            (slot.debug / "trace.txt").write_text("x")
        assert not (store.state / "failed").exists()
        assert store.manifest(slot.ref).files == 0

    def test_an_unfinished_slot_has_no_ref(self, store: Store) -> None:
        with (
            store.slot(stage="toy", version=1, key="toy-v1-a") as slot,
            pytest.raises(StoreError, match="unfinished"),
        ):
            _ = slot.ref

    def test_writing_the_same_again_keeps_the_first(self, store: Store) -> None:
        first = put(store)
        assert put(store) == first
        assert store.backend.sweep(0.0) == []

    def test_other_content_replaces(self, store: Store) -> None:
        first = put(store)
        second = put(store, text="changed")
        assert store.find("toy-v1-aa") == second
        assert (store.open(second) / "deep" / "file.txt").read_text() == "changed"
        with pytest.raises(StoreError, match="replaced"):
            store.open(first)

    def test_opening_a_removed_artefact_is_an_error(self, store: Store) -> None:
        ref = put(store)
        assert store.rm("toy-v1-*") == ["toy-v1-aa"]
        assert store.find("toy-v1-aa") is None
        with pytest.raises(StoreError, match="removed"):
            store.open(ref)

    def test_rm_goes_by_key_stage_or_label(self, store: Store) -> None:
        put(store, "toy-v1-a", label="phantom/0@sparse")
        put(store, "toy-v1-b", label="phantom/1@sparse")
        assert store.rm("phantom/0*") == ["toy-v1-a"]
        assert [manifest.key for manifest in store.ls()] == ["toy-v1-b"]
        assert store.rm("toy") == ["toy-v1-b"]

    def test_a_label_with_brackets_is_found_by_its_name(self, store: Store) -> None:
        put(store, "toy-v1-a", label="scans [b]/case")
        put(store, "toy-v1-b", label="scans b/case")
        assert [manifest.key for manifest in store.ls("scans [b]/case")] == ["toy-v1-a", "toy-v1-b"]
        assert store.rm("scans [b]/cas?") == ["toy-v1-b"]
        assert store.rm("scans [b]/case") == ["toy-v1-a"]

    def test_nested_refs_survive_a_moved_store(self, tmp_path: Path) -> None:
        ref = put(Store(tmp_path / "first"))
        (tmp_path / "first").rename(tmp_path / "second")
        moved = Store(tmp_path / "second")
        found = moved.find("toy-v1-aa")
        assert found is not None
        assert digest_of(found) == digest_of(ref)
        assert moved.open(ref) == tmp_path / "second" / "artefacts" / "toy-v1-aa"


class TestDirectory:
    def test_a_damaged_manifest_is_an_error_and_is_replaced(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)
        (tmp_path / "artefacts" / "toy-v1-aa" / MANIFEST).write_text("{")
        with pytest.raises(StoreError, match="not the manifest"):
            store.find("toy-v1-aa")
        assert put(store) == ref
        assert store.find("toy-v1-aa") == ref

    def test_an_entry_of_which_nothing_can_be_told_is_left_out(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        store = Store(tmp_path)
        put(store)
        loop = tmp_path / "artefacts" / "toy-v1-loop"
        loop.symlink_to(loop)
        assert store.keys() == ["toy-v1-aa"]
        assert f"{loop} is left out: Too many levels of symbolic links" in caplog.text
        assert [manifest.key for manifest in store.ls()] == ["toy-v1-aa"]

    def test_verify_sees_a_changed_byte(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)
        (store.open(ref) / "deep" / "file.txt").write_text("jello")
        assert not store.verify(ref)

    def test_files_are_as_open_as_the_umask_says(self, tmp_path: Path) -> None:
        store, before = Store(tmp_path), os.umask(0o002)
        try:
            with store.slot(stage="s", version=1, key="s-v1-a") as slot:
                (slot.path / "usual").write_bytes(b"x")
                (slot.path / "folder").mkdir()
                private = slot.path / "folder" / "private"
                # As writers do that make a temporary file first.
                os.close(os.open(private, os.O_WRONLY | os.O_CREAT, 0o600))
            with store.slot(stage="s", version=1, key="s-v1-b") as slot:
                (slot.path / "program").write_bytes(b"x")
                (slot.path / "program").chmod(0o755)
        finally:
            os.umask(before)
        files = [path for path in (tmp_path / "artefacts").rglob("*") if path.is_file()]
        modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in files}
        assert modes == {"usual": 0o664, "private": 0o664, "program": 0o775, "manifest.json": 0o664}

    def test_a_store_that_cannot_be_written_says_so(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("x")
        with pytest.raises(StoreError, match="cannot be written"):
            Store(tmp_path / "file" / "store").check_writable()
        with pytest.raises(StoreError, match="cannot be written"):
            put(Store(tmp_path / "file"))
        Store(tmp_path / "good").check_writable()
        assert list((tmp_path / "good" / "scratch").iterdir()) == []

    def test_sigkill_leaves_only_scratch_and_sweep_removes_it(self, tmp_path: Path) -> None:
        code = (
            "import os, signal, sys; from extrags.store import Store\n"
            "with Store(sys.argv[1]).slot(stage='toy', version=1, key='toy-v1-aa') as slot:\n"
            "    (slot.path / 'half').write_text('x')\n"
            "    os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
        assert ended.returncode == -signal.SIGKILL
        store = Store(tmp_path)
        assert store.find("toy-v1-aa") is None
        assert len(list((tmp_path / "scratch").iterdir())) == 1
        with store.slot(stage="toy", version=1, key="toy-v1-bb") as alive:
            (alive.path / "being-written").write_text("x")
            removed = store.sweep_scratch()
            assert store.sweep() == []
            assert len(removed) == 1
            assert removed[0].startswith("scratch/toy-v1-aa.")
        assert [manifest.key for manifest in store.ls()] == ["toy-v1-bb"]
        assert list((tmp_path / "scratch").iterdir()) == []

    def test_folders_of_another_user_stay_and_hinder_nothing(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = Store(tmp_path)
        put(store)
        private = [tmp_path / "artefacts" / "toy-v1-private", tmp_path / "scratch" / "toy-v1-private.01"]
        free = [tmp_path / "artefacts" / "toy-v1-zz", tmp_path / "scratch" / "toy-v1-zz.01"]
        for folder in [*private, *free]:
            folder.mkdir()
        give_to_another_user(monkeypatch, *private)
        left = ["scratch/toy-v1-zz.01", "artefacts/toy-v1-zz"]
        assert held_directories(store.backend.scratch) == []
        assert store.gc(dry_run=True) == left
        assert store.gc() == left
        assert all(folder.exists() for folder in private)
        assert store.sweep_scratch() == []

    def test_what_may_not_be_removed_stays_and_hinders_nothing(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = Store(tmp_path)
        for name in ("a", "b"):
            (tmp_path / "artefacts" / f"toy-v1-{name}").mkdir(parents=True)
        rename = Path.rename

        def refused(path: Path, target: Path) -> Path:
            if path.name == "toy-v1-a":
                raise PermissionError(13, "Permission denied", str(path))
            return rename(path, target)

        monkeypatch.setattr(Path, "rename", refused)
        assert store.sweep() == ["artefacts/toy-v1-b"]

    def test_scratch_of_another_user_is_passed_over(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = Store(tmp_path)
        (tmp_path / "scratch" / "toy-v1-a.01").mkdir(parents=True)
        give_to_another_user(monkeypatch, tmp_path / "scratch")
        assert (store.sweep(), held_directories(store.backend.scratch)) == ([], [])

    def test_work_of_another_machine_on_nfs_is_left_alone(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        _keep_locks_of_directories_local(monkeypatch)
        store, other = Store(tmp_path), Store(tmp_path)
        with store.slot(stage="toy", version=1, key="toy-v1-aa") as slot:
            (slot.path / "half").write_text("x")
            assert (other.gc(dry_run=True), other.sweep(), other.sweep_scratch()) == ([], [], [])
            assert (slot.path / "half").read_text() == "x"
            assert held_directories(other.backend.scratch) == [slot.path.parent]
        assert sorted(path.name for path in store.open(slot.ref).iterdir()) == ["half", MANIFEST]
        assert held_directories(other.backend.scratch) == list((tmp_path / "scratch").iterdir()) == []

    def test_work_of_an_earlier_version_is_left_alone(self, tmp_path: Path) -> None:
        store, folder = Store(tmp_path), tmp_path / "scratch" / "toy-v1-aa.01"
        folder.mkdir(parents=True)
        lock = os.open(folder, os.O_RDONLY)
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert (store.sweep(), held_directories(store.backend.scratch)) == ([], [folder])
        assert list(folder.iterdir()) == []
        os.close(lock)
        assert store.gc(dry_run=True) == ["scratch/toy-v1-aa.01"]
        assert list(folder.iterdir()) == []
        assert store.sweep() == ["scratch/toy-v1-aa.01"]
        assert not folder.exists()

    @pytest.mark.parametrize("nfs", [False, True])
    @pytest.mark.parametrize("moment", ["open directory", "open lock", "flock directory", "flock lock"])
    def test_a_sweep_beside_the_beginning_of_work(
        self, moment: str, nfs: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if nfs:
            _keep_locks_of_directories_local(monkeypatch)
        store, swept = Store(tmp_path), []

        def sweep_first(call: Callable[..., Any], name: str) -> Callable[..., Any]:
            def swept_first(what: Any, *args: Any, **options: Any) -> Any:
                path = what if isinstance(what, Path) else Path(os.readlink(f"/proc/self/fd/{what}"))
                place = "lock" if path.name == "lock" else "directory"
                if f"{name} {place}" == moment and tmp_path / "scratch" in path.parents and not swept:
                    swept.append("begun")
                    swept.extend(store.sweep_scratch())
                return call(what, *args, **options)

            return swept_first

        opened = os.open
        monkeypatch.setattr(
            os,
            "open",
            lambda what, *args, **options: (
                sweep_first(opened, "open") if isinstance(what, Path) else opened
            )(what, *args, **options),
        )
        monkeypatch.setattr(fcntl, "flock", sweep_first(fcntl.flock, "flock"))
        with store.slot(stage="toy", version=1, key="toy-v1-aa") as slot:
            assert held_directories(store.backend.scratch) == [slot.path.parent]
            assert store.sweep() == []
            (slot.path / "file").write_text("x")
        assert swept
        assert store.find("toy-v1-aa") == slot.ref
        assert list((tmp_path / "scratch").iterdir()) == []

    def test_a_lock_that_nfs_keeps_while_it_is_open_goes_with_its_directory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        remove, close = os.unlink, os.close
        renamed: list[Path] = []

        def kept(path: Any, *args: Any, **options: Any) -> None:
            if os.fspath(path) == "lock":
                folder = Path(os.readlink(f"/proc/self/fd/{options['dir_fd']}"))
                renamed.append(folder / ".nfs01")
                (folder / "lock").rename(renamed[-1])
            else:
                remove(path, *args, **options)

        def closed(descriptor: int) -> None:
            place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            close(descriptor)
            if place in renamed and place.exists():
                remove(place)

        monkeypatch.setattr(os, "unlink", kept)
        monkeypatch.setattr(os, "close", closed)
        put(Store(tmp_path))
        assert renamed
        assert list((tmp_path / "scratch").iterdir()) == []

    def test_no_room_for_a_lock_leaves_nothing(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        opened = os.open
        (tmp_path / "scratch" / "toy-v1-aa.01.removed").mkdir(parents=True)

        def full(path: Any, flags: int, *args: Any, **options: Any) -> int:
            if flags & os.O_CREAT and os.path.basename(path) == "lock":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            return opened(path, flags, *args, **options)

        monkeypatch.setattr(os, "open", full)
        store = Store(tmp_path)
        with pytest.raises(StoreError, match="No space left"):
            put(store)
        assert store.sweep() == ["scratch/toy-v1-aa.01.removed"]
        assert list((tmp_path / "scratch").iterdir()) == []

    def test_what_is_removed_while_it_is_made_anew_is_there_whole(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = Store(tmp_path)
        put(store)
        looked = extrags.store.directory.intact_manifest

        def then_removed(backend: Examinable, key: str) -> Manifest | None:
            found = looked(backend, key)
            store.rm(key)
            return found

        monkeypatch.setattr(extrags.store.directory, "intact_manifest", then_removed)
        with store.slot(stage="toy", version=1, key="toy-v1-aa", renew=True) as slot:
            (slot.path / "deep").mkdir()
            (slot.path / "deep" / "file.txt").write_text("hello")
        assert (store.open(slot.ref) / "deep" / "file.txt").read_text() == "hello"

    def test_several_processes_write_one_key(self, tmp_path: Path) -> None:
        context = multiprocessing.get_context("spawn")
        with context.Pool(3) as pool:
            refs = pool.map(_put_many, [str(tmp_path)] * 3)
        assert refs[0] == refs[1] == refs[2]
        assert len(Store(tmp_path).ls()) == 20
        assert list((tmp_path / "scratch").iterdir()) == []


def _keep_locks_of_directories_local(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on an NFS client, which asks the server for locks of files alone: no machine sees the other's."""
    lock = fcntl.flock

    def local(descriptor: int, kind: int) -> None:
        if not stat.S_ISDIR(os.fstat(descriptor).st_mode):
            lock(descriptor, kind)

    monkeypatch.setattr(fcntl, "flock", local)


def _put_many(root: str) -> list[Ref]:
    store = Store(root)
    return [put(store, f"toy-v1-{index:02d}") for index in range(20)]


class TestUrl:
    def test_folders_of_a_file_system_come_and_go(self, tmp_path: Path) -> None:
        store = Store(f"local://{tmp_path}/store", cache=tmp_path / "cache")
        ref = put(store)
        (damaged,) = (tmp_path / "store" / "toy-v1-aa").rglob("file.txt")
        damaged.write_text("jello")
        with pytest.raises(DamagedArtefactError) as caught:
            store.open(ref)
        place = store.set_aside(caught.value)
        assert place is not None
        assert len(list(Path(place.removeprefix("local://")).rglob("file.txt"))) == 1
        unfinished = tmp_path / "store" / "toy-v1-bb" / "attempt"
        unfinished.mkdir(parents=True)
        (unfinished / "half").write_text("x")
        assert store.sweep(older_than_hours=-0.1) == ["toy-v1-bb/attempt"]
        assert sorted(path.name for path in (tmp_path / "store").iterdir()) == ["damaged"]

    def test_a_file_system_that_cannot_be_written_is_said_when_checked(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("x")
        with pytest.raises(StoreError, match="cannot be written"):
            Store(f"local://{tmp_path}/file/store", cache=tmp_path / "cache").check_writable()

    def test_an_upload_without_manifest_is_invisible_and_swept(self, tmp_path: Path) -> None:
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path)
        ref = put(store)
        backend = store.backend
        backend.fs.pipe_file(f"{backend.prefix}/toy-v1-bb/attempt/half", b"x")  # type: ignore[union-attr]
        backend.fs.pipe_file(f"{backend.prefix}/toy-v1-aa/loser/half", b"x")  # type: ignore[union-attr]
        assert store.find("toy-v1-bb") is None
        assert store.sweep(older_than_hours=1.0) == []
        assert sorted(store.sweep(older_than_hours=0.0)) == ["toy-v1-aa/loser", "toy-v1-bb/attempt"]
        assert store.verify(ref)

    @pytest.mark.parametrize("scheme", ["memory", "local"])
    @pytest.mark.parametrize("moment", ["find", "rm"])
    def test_two_machines_sweep_at_once(
        self, scheme: str, moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        place = uuid.uuid4().hex if scheme == "memory" else f"{tmp_path}/store"
        store, other = (Store(f"{scheme}://{place}", cache=tmp_path / name) for name in ("here", "there"))
        backend: Any = store.backend
        ref = put(store)
        for name in ("toy-v1-bb/one", "toy-v1-bb/two", "toy-v1-cc/one"):
            backend.fs.makedirs(f"{backend.prefix}/{name}", exist_ok=True)
            backend.fs.pipe_file(f"{backend.prefix}/{name}/half", b"x")
        swept = swept_by_other_first(monkeypatch, store, other, moment)
        assert store.sweep(older_than_hours=-0.1) == []
        assert swept == ["begun", "toy-v1-bb/one", "toy-v1-bb/two", "toy-v1-cc/one"]
        assert store.keys() == ["toy-v1-aa"]
        assert store.verify(ref)

    def test_an_empty_folder_is_as_old_as_it_is(self, tmp_path: Path) -> None:
        store = Store(f"local://{tmp_path}/store", cache=tmp_path / "cache")
        put(store)
        begun, old = (tmp_path / "store" / "toy-v1-bb" / name for name in ("begun", "old"))
        begun.mkdir(parents=True)
        old.mkdir()
        os.utime(old, (0, 0))
        assert store.sweep() == ["toy-v1-bb/old"]
        assert (begun.exists(), old.exists()) == (True, False)

    def test_local_copies_go_with_what_they_are_copies_of(self, tmp_path: Path) -> None:
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path)
        removed, kept = store.open(put(store, "toy-v1-aa")), store.open(put(store, "toy-v1-ab"))
        assert store.rm("toy-v1-aa") == ["toy-v1-aa"]
        assert (removed.exists(), kept.exists()) == (False, True)
        changed = store.open(put(store, "toy-v1-ab", "changed"))
        assert (kept.exists(), changed.exists()) == (False, True)
        assert store.rm("toy-v1-ab") == ["toy-v1-ab"]
        assert not changed.exists()

    def test_copies_of_what_another_machine_removed_are_swept(self, tmp_path: Path) -> None:
        url = f"memory://{uuid.uuid4().hex}"
        store, other = Store(url, cache=tmp_path / "here"), Store(url, cache=tmp_path / "there")
        removed, replaced, damaged, kept = (
            store.open(put(store, f"toy-v1-{name}")) for name in ("removed", "replaced", "damaged", "kept")
        )
        other.rm("toy-v1-removed")
        put(other, "toy-v1-replaced", "changed")
        backend = store.backend
        backend.fs.pipe_file(f"{backend.prefix}/toy-v1-damaged/{MANIFEST}", b"{")  # type: ignore[union-attr]
        gone = [f"artefacts/{path.name}" for path in (removed, replaced)]
        assert store.gc(dry_run=True) == gone
        assert removed.exists()
        assert store.sweep() == gone
        assert not removed.exists()
        assert not replaced.exists()
        # Which copy a damaged manifest stood for is not known.
        assert damaged.exists()
        assert kept.exists()
        assert store.sweep() == []

    def test_damage_is_seen_on_reading(self, tmp_path: Path) -> None:
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path)
        ref = put(store)
        backend = store.backend
        (name,) = [name for name in backend.fs.find(backend.prefix) if name.endswith("file.txt")]  # type: ignore[union-attr]
        backend.fs.pipe_file(name, b"jello")  # type: ignore[union-attr]
        with pytest.raises(StoreError, match="damaged"):
            store.open(ref)

    def test_an_unknown_protocol_is_an_error(self) -> None:
        with pytest.raises(StoreError, match="nosuch"):
            Store("nosuch://bucket")

    def test_a_missing_driver_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from fsspec.registry import known_implementations

        driver = {"class": "no_such_driver.FileSystem", "err": "Install no_such_driver"}
        monkeypatch.setitem(known_implementations, "undriven", driver)
        with pytest.raises(MissingDependencyError, match="Install no_such_driver"):
            Store("undriven://bucket/prefix")


def test_a_setting_that_came_later_counts_where_it_changes_something() -> None:
    usual = IngestConfig()
    assert "stereo_camera" not in canonical(usual)
    assert digest_of(IngestConfig(stereo_camera="right")) != digest_of(usual)
