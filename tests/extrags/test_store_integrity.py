"""What is read from the store is what was stored, or the damage is named."""

from __future__ import annotations

import errno
import json
import os
import pickle
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags.errors import ArtefactGoneError, ConfigError, DamagedArtefactError, StoreError
from extrags.store import MANIFEST, Manifest, Ref, Storable, Store
from extrags.store.artefacts import _as_damage
from extrags.store.manifest import manifest_text
from extrags.zarr_io import new_group, open_group, read_array, write_array, write_frames

KEY = "toy-v1-aa"
CHUNK = "frames.zarr.zip"


class Frames(Storable):
    stored_as = "frames"

    def __init__(self, rgb: np.ndarray) -> None:
        self.rgb = rgb

    def save(self, path: Path) -> None:
        with new_group(path) as group:
            write_frames(group, "rgb", self.rgb)
            write_array(group, "K", np.eye(3))
            group.attrs["scale_mm"] = 1.5

    @classmethod
    def load(cls, path: Path) -> Frames:
        group = open_group(path)
        return cls(read_array(group, "rgb") * group.attrs["scale_mm"])


def put(store: Store, key: str = KEY) -> Ref:
    with store.slot(stage="toy", version=1, key=key, label="phantom/0") as slot:
        slot.save(Frames(np.arange(24, dtype=np.float32).reshape(3, 2, 4)))
        slot.save_json("about.json", {"frames": 3, "voxel_mm": 0.25})
        slot.counts["frames"] = 3
    return slot.ref


class Place:
    """A store and access to its files beside it, local or remote."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.remote: Any = getattr(store.backend, "fs", None)

    def name(self, file: str) -> str:
        if self.remote is None:
            return f"{self.store.root}/artefacts/{KEY}/{file}"
        (found,) = [
            name
            for name in self.remote.find(f"{self.store.backend.prefix}/{KEY}")  # type: ignore[union-attr]
            if name.endswith(f"/{file}")
        ]
        return str(found)

    def change(self, file: str, by: Callable[[bytes], bytes]) -> None:
        if self.remote is None:
            Path(self.name(file)).write_bytes(by(Path(self.name(file)).read_bytes()))
        else:
            self.remote.pipe_file(self.name(file), by(self.remote.cat_file(self.name(file))))

    def remove(self, file: str) -> None:
        if self.remote is None:
            Path(self.name(file)).unlink()
        else:
            self.remote.rm_file(self.name(file))


@pytest.fixture(params=["directory", "memory"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Place]:
    if request.param == "directory":
        yield Place(Store(tmp_path / "store"))
    else:
        made = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path / "cache")
        yield Place(made)
        if made.backend.fs.exists(made.backend.prefix):  # type: ignore[union-attr]
            made.backend.fs.rm(made.backend.prefix, recursive=True)  # type: ignore[union-attr]


def flipped(content: bytes) -> bytes:
    """The bit in the middle."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]


def chunk_flipped(content: bytes) -> bytes:
    """A bit of the first chunk's data, which follow the header of its member."""
    name = content.index(b"rgb/c/0/0/0")
    at = name + len(b"rgb/c/0/0/0") + 20
    return content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :]


class TestFind:
    def test_a_missing_file(self, place: Place) -> None:
        put(place.store)
        place.remove(CHUNK)
        with pytest.raises(DamagedArtefactError, match=f"artefact {KEY} of stage toy is damaged") as caught:
            place.store.find(KEY)
        assert (caught.value.stage, caught.value.key) == ("toy", KEY)
        assert "cache verify --repair --store" in str(caught.value)

    def test_a_truncated_file(self, place: Place) -> None:
        put(place.store)
        place.change(CHUNK, lambda content: content[:-1])
        with pytest.raises(DamagedArtefactError):
            place.store.find(KEY)

    def test_a_file_too_many(self, place: Place) -> None:
        put(place.store)
        if place.remote is None:
            Path(place.name("about.json")).with_name("more").write_text("x")
        else:
            place.remote.pipe_file(place.name("about.json").replace("about.json", "more"), b"x")
        with pytest.raises(DamagedArtefactError):
            place.store.find(KEY)

    def test_in_a_directory_the_file_is_named(self, tmp_path: Path) -> None:
        put(Store(tmp_path))
        (tmp_path / "artefacts" / KEY / CHUNK).unlink()
        with pytest.raises(DamagedArtefactError, match=f"{CHUNK}: is missing"):
            Store(tmp_path).find(KEY)

    def test_what_is_set_aside_is_made_anew(self, place: Place, caplog: pytest.LogCaptureFixture) -> None:
        ref = put(place.store)
        place.remove(CHUNK)
        assert place.store.find_or_set_aside(KEY) is None
        assert "stage toy: artefact toy-v1-aa is damaged" in caplog.text
        assert place.store.find(KEY) is None
        assert put(place.store) == ref
        assert place.store.find_or_set_aside(KEY) == ref
        assert place.store.keys() == [KEY]


class TestOpen:
    @pytest.mark.parametrize("file", [CHUNK, "about.json"])
    def test_a_flipped_bit_in_any_file(self, place: Place, file: str) -> None:
        ref = put(place.store)
        place.change(file, flipped)
        assert place.store.find(KEY) == ref
        with pytest.raises(DamagedArtefactError, match=f"{file}: its content has changed"):
            place.store.open(ref)
        assert not place.store.verify(ref)

    def test_a_bit_anywhere_in_a_manifest(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)
        whole = store.manifest(ref)
        file = tmp_path / "artefacts" / KEY / MANIFEST
        text = file.read_bytes()
        # 13 and 8 have no common factor: every place within a byte has its turn.
        for bit in range(0, 8 * len(text), 13):
            content = bytearray(text)
            content[bit // 8] ^= 1 << bit % 8
            file.write_bytes(content)
            with pytest.raises(DamagedArtefactError, match=r"manifest\.json: is not the manifest"):
                store.manifest(ref)
        file.write_bytes(text)
        assert store.manifest(ref) == whole

    def test_a_list_of_other_files_is_damage(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        whole = store.manifest(put(store))
        contents = {**whole.contents, "about.json": (1, "00")}
        file = tmp_path / "artefacts" / KEY / MANIFEST
        file.write_bytes(manifest_text(whole.model_copy(update={"contents": contents})))
        with pytest.raises(DamagedArtefactError, match=r"manifest\.json: its list of files"):
            store.open(Ref(uri="", digest=whole.digest).model_copy(update={"uri": str(file.parent)}))

    def test_chunks_may_be_left_to_their_own_checksums(self, tmp_path: Path) -> None:
        ref = put(Store(tmp_path))
        place = Place(Store(tmp_path, verify="metadata"))
        place.change(CHUNK, chunk_flipped)
        place.store.open(ref)
        with pytest.raises(DamagedArtefactError, match=f"{KEY}.*{CHUNK}: its content has changed"):
            place.store.load(Frames, ref)
        place.change(CHUNK, chunk_flipped)
        assert place.store.load(Frames, ref).rgb[0, 0, 1] == 1.5

    def test_metadata_of_packed_arrays_is_compared_before_chunks_are_read(self, tmp_path: Path) -> None:
        ref = put(Store(tmp_path))
        place = Place(Store(tmp_path, verify="metadata"))
        # The last bytes are the zip's directory: names and places of chunks.
        place.change(CHUNK, lambda content: content[:-60] + bytes([content[-60] ^ 1]) + content[-59:])
        with pytest.raises(DamagedArtefactError, match=f"{CHUNK}: its content has changed"):
            place.store.open(ref)

    def test_the_environment_chooses(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        ref = put(Store(tmp_path))
        place = Place(Store(tmp_path))
        place.change(CHUNK, chunk_flipped)
        monkeypatch.setenv("EXTRAGS_VERIFY", "metadata")
        assert Store(tmp_path).open(ref).is_dir()
        monkeypatch.setenv("EXTRAGS_VERIFY", "all")
        with pytest.raises(DamagedArtefactError):
            Store(tmp_path).open(ref)
        monkeypatch.setenv("EXTRAGS_VERIFY", "some")
        with pytest.raises(ConfigError, match="EXTRAGS_VERIFY is 'some'; expected all or metadata"):
            Store(tmp_path)

    def test_contents_are_compared_once_per_process(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from extrags.store import integrity

        store = Store(tmp_path)
        ref = put(store)
        read: list[str] = []
        whole = integrity._read

        def counted(path: Path) -> Any:
            read.append(path.name)
            return whole(path)

        monkeypatch.setattr(integrity, "_read", counted)
        store.open(ref)
        assert len(read) == store.manifest(ref).files
        for _ in range(3):
            Store(tmp_path).open(ref)
        assert len(read) == store.manifest(ref).files

    def test_damage_after_the_first_look_is_named_when_it_is_read(self, tmp_path: Path) -> None:
        place = Place(Store(tmp_path))
        ref = put(place.store)
        place.store.open(ref)
        place.change(CHUNK, flipped)
        with pytest.raises(DamagedArtefactError, match=f"artefact {KEY} .*{CHUNK}: its content has changed"):
            place.store.load(Frames, ref)
        place.change(CHUNK, flipped)
        place.change("about.json", lambda content: b"{" * len(content))
        with pytest.raises(DamagedArtefactError, match=f"artefact {KEY} .*about.json: its content"):
            place.store.load_json("about.json", ref)

    @pytest.mark.parametrize(("number", "damaged"), [(errno.EIO, True), (errno.EACCES, False)])
    def test_a_folder_that_cannot_be_listed(
        self, number: int, damaged: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = Store(tmp_path)
        put(store)

        def scandir(place: str) -> object:
            raise OSError(number, os.strerror(number), str(place))

        monkeypatch.setattr("extrags.store.integrity.os.scandir", scandir)
        if damaged:
            found = store.examine(KEY)
            assert found is not None
            assert found.problem == "cannot be listed: Input/output error"
        else:
            with pytest.raises(StoreError, match="cannot be read: Permission denied"):
                store.examine(KEY)

    def test_an_error_that_is_none_of_the_store_stays_what_it_is(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)
        with pytest.raises(FileNotFoundError) as caught:
            store.load_json("nothing.json", ref)
        assert not isinstance(caught.value, StoreError)

    def test_a_damaged_local_copy_is_fetched_again(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path)
        ref = put(store)
        file = store.open(ref) / CHUNK
        whole = file.read_bytes()
        for damage in (Path.unlink, lambda path: path.write_bytes(flipped(whole))):
            damage(file)
            # The first is seen in number and size of files, the second where the chunk is read.
            if file.exists():
                with pytest.raises(DamagedArtefactError, match=CHUNK):
                    store.load(Frames, ref)
            assert store.find(KEY) == ref
            assert (store.open(ref) / CHUNK).read_bytes() == whole
        assert "is damaged and is fetched again" in caplog.text
        assert store.verify(ref)


class TestFormerArtefacts:
    @pytest.fixture
    def store(self, tmp_path: Path) -> Store:
        """An artefact as the first versions wrote it: no checksums, no numbers."""
        store = Store(tmp_path)
        ref = put(store)
        folder = tmp_path / "artefacts" / KEY
        left_out = {"checksum", "files", "bytes", "contents"}
        (folder / MANIFEST).write_text(store.manifest(ref).model_dump_json(indent=1, exclude=left_out))
        return store

    def test_they_are_read(self, store: Store) -> None:
        ref = store.find(KEY)
        assert ref is not None
        assert store.load(Frames, ref).rgb.shape == (3, 2, 4)
        assert store.examine(KEY) is None

    def test_a_changed_byte_is_noticed(self, store: Store) -> None:
        ref = store.find(KEY)
        assert ref is not None
        Place(store).change("about.json", flipped)
        with pytest.raises(DamagedArtefactError, match="its files have digest"):
            store.open(ref)

    def test_numbers_are_compared_where_there_are_some(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)
        folder = tmp_path / "artefacts" / KEY
        text = manifest_text(store.manifest(ref).model_copy(update={"contents": {}}))
        (folder / MANIFEST).write_bytes(text)
        (folder / CHUNK).unlink()
        with pytest.raises(DamagedArtefactError, match=r"files of \d+ bytes, expected \d+ files"):
            store.find(KEY)

    def test_a_manifest_of_a_later_version_is_read(self, tmp_path: Path) -> None:
        class Later(Manifest):
            place: str = "elsewhere"

        store = Store(tmp_path)
        ref = put(store)
        later = Later(**store.manifest(ref).model_dump())
        (tmp_path / "artefacts" / KEY / MANIFEST).write_bytes(manifest_text(later))
        assert store.manifest(ref).counts == {"frames": 3}


class TestSetAside:
    def test_nothing_is_deleted_and_the_reason_lies_beside_it(self, tmp_path: Path) -> None:
        place = Place(Store(tmp_path))
        put(place.store)
        place.change(CHUNK, flipped)
        damage = place.store.examine(KEY)
        assert damage is not None
        aside = place.store.set_aside(damage)
        assert aside is not None
        assert Path(aside).parent == tmp_path / "damaged"
        assert (Path(aside) / "artefact" / CHUNK).is_file()
        record = json.loads((Path(aside) / "damage.json").read_text())
        assert (record["stage"], record["key"], record["file"]) == ("toy", KEY, CHUNK)
        assert "changed" in record["problem"]
        assert place.store.keys() == []

    def test_gc_removes_it(self, place: Place) -> None:
        put(place.store)
        place.remove(CHUNK)
        place.store.find_or_set_aside(KEY)
        (removed,) = place.store.gc()
        assert removed.startswith(f"damaged/{KEY}.")
        assert place.store.gc() == []

    def test_two_may_clean_at_once(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        store = Store(tmp_path)
        for name in ("first", "second"):
            (tmp_path / "failed" / name).mkdir(parents=True)
        usual = shutil.rmtree

        def slower(place: Path, *given: Any, **more: Any) -> None:
            if Path(place).name == "first":
                usual(place)
            usual(place, *given, **more)

        with monkeypatch.context() as patched:
            patched.setattr(shutil, "rmtree", slower)
            assert store.gc() == ["failed/first", "failed/second"]
        assert list((tmp_path / "failed").iterdir()) == []
        # What is being set aside loses its place.
        put(store)
        (tmp_path / "artefacts" / KEY / CHUNK).unlink()
        rename = Path.rename
        monkeypatch.setattr(Path, "rename", lambda path, to: (usual(to.parent), rename(path, to))[1])
        assert store.find_or_set_aside(KEY) is None
        monkeypatch.undo()
        put(store)
        assert store.find(KEY) is not None

    def test_what_another_process_has_made_anew_stays(self, place: Place) -> None:
        ref = put(place.store)
        place.change(CHUNK, flipped)
        damage = place.store.examine(KEY)
        assert damage is not None
        place.change(CHUNK, flipped)
        assert place.store.set_aside(damage) is None
        assert place.store.find(KEY) == ref

    def test_a_damaged_manifest_is_set_aside_too(self, place: Place) -> None:
        put(place.store)
        place.change(MANIFEST, flipped)
        assert place.store.ls() == []
        assert place.store.sweep(older_than_hours=0.0) == []
        assert place.store.find_or_set_aside(KEY) is None
        assert put(place.store).digest

    @pytest.mark.parametrize("pattern", ["*", KEY, "toy"])
    def test_a_damaged_manifest_is_removed_by_key_or_stage(self, pattern: str, place: Place) -> None:
        put(place.store)
        place.change(MANIFEST, flipped)
        assert place.store.rm("phantom/*") == []
        assert place.store.rm(pattern) == [KEY]
        assert place.store.keys() == []

    def test_a_manifest_that_the_disk_does_not_give_back_is_damage_to_who_looks_through_the_store(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        store = Store(tmp_path)
        put(store)
        usual, number = Path.read_bytes, errno.EIO

        def failing(path: Path) -> bytes:
            if path.name == MANIFEST and path.parent.is_dir():
                raise OSError(number, os.strerror(number), str(path))
            return usual(path)

        monkeypatch.setattr(Path, "read_bytes", failing)
        # It may pass: who needs the artefact tries again before it is given up.
        with pytest.raises(StoreError) as found:
            store.find(KEY)
        assert not isinstance(found.value, DamagedArtefactError)
        assert store.ls() == []
        assert "manifest.json cannot be read: Input/output error" in caplog.text
        damage = store.examine(KEY)
        assert isinstance(damage, DamagedArtefactError)
        assert store.set_aside(damage) is not None
        assert store.find(KEY) is None
        # An object store answers so when it is busy.
        with pytest.raises(StoreError, match="busy"):
            _as_damage(_caused_by(OSError(errno.EIO, "busy")), KEY, "s3://bucket")
        # What this user may not read may be whole, and keeps nobody from the rest.
        (tmp_path / "artefacts" / KEY).mkdir()
        number = errno.EACCES
        with pytest.raises(StoreError, match="Permission denied"):
            store.examine(KEY)
        caplog.clear()
        assert store.ls() == []
        assert f"{KEY} is skipped" in caplog.text
        assert store.rm("*") == []
        assert f"{KEY} is left: " in caplog.text
        assert store.rm(KEY) == [KEY]

    def test_writing_the_same_again_replaces_a_damaged_artefact(self, place: Place) -> None:
        ref = put(place.store)
        place.change(CHUNK, flipped)
        assert put(place.store) == ref
        assert place.store.verify(ref)


def _caused_by(cause: OSError) -> StoreError:
    error = StoreError(str(cause))
    error.__cause__ = cause
    return error


class TestSlot:
    def test_a_failure_by_damaged_inputs_names_them(self, tmp_path: Path) -> None:
        place = Place(Store(tmp_path))
        ref = put(place.store)

        def fail() -> None:
            with place.store.slot(stage="next", version=1, key="next-v1-aa") as slot:
                folder = slot.open(ref)
                place.change("about.json", flipped)
                raise ArithmeticError(folder)

        with pytest.raises(DamagedArtefactError, match=r"of stage toy is damaged: about\.json") as caught:
            fail()
        assert isinstance(caught.value.__cause__, ArithmeticError)

    def test_a_failure_with_whole_inputs_stays_what_it_is(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)

        def fail() -> None:
            with store.slot(stage="next", version=1, key="next-v1-aa") as slot:
                slot.open(ref)
                raise ArithmeticError("diverged")

        with pytest.raises(ArithmeticError, match="diverged"):
            fail()

    def test_an_input_that_goes_away_is_named(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        ref = put(store)

        def fail() -> None:
            with store.slot(stage="next", version=1, key="next-v1-aa") as slot:
                folder = slot.open(ref)
                store.rm(KEY)
                (folder / "about.json").read_text()

        with pytest.raises(ArtefactGoneError, match=KEY) as caught:
            fail()
        assert caught.value.key == KEY


@pytest.mark.parametrize(
    "error",
    [
        DamagedArtefactError("is missing", file="a/b", stage="toy", key=KEY, store="s"),
        ArtefactGoneError("it went away", KEY),
    ],
)
def test_errors_cross_process_boundaries_whole(error: Exception) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), vars(again)) == (str(error), vars(error))
