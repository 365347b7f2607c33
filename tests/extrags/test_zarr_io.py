"""Arrays on disk: what is read is what was written, or an error that names the file."""

from __future__ import annotations

import errno
import os
import random
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec
from zarr.storage import ZipStore

from extrags import frame_stacks, zarr_io
from extrags.errors import DamagedArtefactError, SourceNotFoundError
from extrags.zarr_io import group_exists, new_group, open_group, read_array, write_array, write_frames

FRAMES = np.random.default_rng(0).integers(0, 255, (5, 4, 6, 3), dtype=np.uint8)


def write(path: Path, frames: np.ndarray = FRAMES) -> Path:
    """A group with frames; its file."""
    with new_group(path) as group:
        write_frames(group, "rgb", frames)
        write_array(group, "split/train", np.arange(3))
        group.attrs["metric"] = True
    return path.with_name(f"{path.name}.zarr.zip")


def write_directory(path: Path, frames: np.ndarray = FRAMES) -> None:
    """The same as earlier versions wrote it: one file per chunk."""
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    write_frames(group, "rgb", frames)
    write_array(group, "split/train", np.arange(3))
    group.attrs["metric"] = True


def read(path: Path, name: str = "rgb") -> np.ndarray:
    return np.asarray(read_array(open_group(path), name))


class TestPacked:
    def test_a_group_is_one_file_that_any_zarr_reads(self, tmp_path: Path) -> None:
        file = write(tmp_path / "a")
        assert list(tmp_path.iterdir()) == [file]
        assert group_exists(tmp_path / "a")
        with ZipStore(file, mode="r") as store:
            group = zarr.open_group(store, mode="r")
            assert dict(group.attrs) == {"metric": True}
            np.testing.assert_array_equal(group["rgb"][...], FRAMES)
        np.testing.assert_array_equal(read(tmp_path / "a", "split/train"), np.arange(3))

    @pytest.mark.parametrize("held_bytes", [1, 200, 1 << 20])
    def test_equal_content_gives_equal_bytes(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held_bytes: int
    ) -> None:
        frames = np.random.default_rng(1).integers(0, 9, (40, 64, 64, 3), dtype=np.uint8)
        monkeypatch.setattr(zarr_io, "HELD_BYTES", held_bytes * frames[0].nbytes // 100)
        first, second = write(tmp_path / "a", frames), write(tmp_path / "b", frames)
        assert first.read_bytes() == second.read_bytes()
        np.testing.assert_array_equal(read(tmp_path / "a"), frames)

    def test_one_frame_is_read_without_the_others(self, tmp_path: Path) -> None:
        file = write(tmp_path / "a")
        with zipfile.ZipFile(file) as pack:
            members = {item.filename: item for item in pack.infolist()}
        whole = bytearray(file.read_bytes())
        for index in (0, 1, 3, 4):
            at = members[f"rgb/c/{index}/0/0/0"].header_offset
            whole[at : at + 60] = bytes(60)
        file.write_bytes(whole)
        np.testing.assert_array_equal(open_group(tmp_path / "a")["rgb"][2], FRAMES[2])  # type: ignore[index]

    def test_a_group_that_fails_leaves_nothing(self, tmp_path: Path) -> None:
        def fail() -> None:
            with new_group(tmp_path / "a") as group:
                write_frames(group, "rgb", FRAMES)
                raise ArithmeticError

        with pytest.raises(ArithmeticError):
            fail()
        assert list(tmp_path.iterdir()) == []

    def test_what_is_not_there_is_named(self, tmp_path: Path) -> None:
        assert not group_exists(tmp_path / "a")
        with pytest.raises(SourceNotFoundError, match=r"a\.zarr\.zip"):
            open_group(tmp_path / "a")


class TestMapped:
    @pytest.fixture(autouse=True)
    def scratch(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """Everything is large, and temporary files lie in a folder of their own."""
        folder = tmp_path / "scratch"
        folder.mkdir()
        monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", 0)
        # Two frames are decoded at once.
        monkeypatch.setattr(zarr_io, "HELD_BYTES", 2 * FRAMES[0].nbytes)
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        return folder

    @pytest.mark.parametrize("dtype", ["uint8", "bool", "float32", ">f4", "int64"])
    def test_it_is_what_was_written(self, tmp_path: Path, dtype: str) -> None:
        frames = FRAMES.astype(dtype)
        write(tmp_path / "a", frames)
        found = read(tmp_path / "a")
        assert found.dtype == np.dtype(dtype).newbyteorder("=")
        assert isinstance(found.base, np.memmap)
        np.testing.assert_array_equal(found, frames)

    def test_the_file_has_no_name_and_is_not_changed(self, tmp_path: Path, scratch: Path) -> None:
        write(tmp_path / "a")
        first = read(tmp_path / "a")
        assert list(scratch.iterdir()) == []
        first[:] = 0
        assert not first.any()
        np.testing.assert_array_equal(read(tmp_path / "a"), FRAMES)

    def test_damage_is_named_and_leaves_nothing(self, tmp_path: Path, scratch: Path) -> None:
        file = write(tmp_path / "a")
        with zipfile.ZipFile(file) as pack:
            chunk = pack.getinfo("rgb/c/4/0/0/0")
        content = bytearray(file.read_bytes())
        content[chunk.header_offset + 30 + len(chunk.filename) + 20] ^= 1
        file.write_bytes(content)
        with pytest.raises(DamagedArtefactError, match="rgb/c/4/0/0/0"):
            read(tmp_path / "a")
        assert list(scratch.iterdir()) == []

    def test_a_full_disk_is_an_error(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        write(tmp_path / "a")

        def full(*_: int) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
        with pytest.raises(OSError, match="No space left"):
            read(tmp_path / "a")

    def test_only_large_stacks_are_mapped(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", FRAMES.nbytes)
        write(tmp_path / "a")
        assert not isinstance(read(tmp_path / "a").base, np.memmap)
        assert not isinstance(read(tmp_path / "a", "split/train").base, np.memmap)


class TestDamage:
    def test_every_flipped_bit_is_an_error_or_does_no_harm(self, tmp_path: Path) -> None:
        file = write(tmp_path / "a", FRAMES[:2, :2, :2, :1])
        whole = file.read_bytes()
        with zipfile.ZipFile(file) as pack:
            chunk = pack.getinfo("rgb/c/1/0/0/0")
        begin = chunk.header_offset + 30 + len(chunk.filename)
        inside = range(8 * begin, 8 * (begin + chunk.file_size))
        chance = random.Random(0)
        for bit in [*inside, *chance.sample(range(8 * len(whole)), 400)]:
            content = bytearray(whole)
            content[bit // 8] ^= 1 << bit % 8
            file.write_bytes(content)
            found, problem = None, ""
            try:
                found = read(tmp_path / "a")
            except DamagedArtefactError as error:
                problem = str(error)
            if bit in inside:
                assert "a.zarr.zip: rgb/c/1/0/0/0: " in problem
            elif found is None:
                assert "a.zarr.zip: " in problem
            else:
                np.testing.assert_array_equal(found, FRAMES[:2, :2, :2, :1])

    @pytest.mark.parametrize("left", [0, 1, 200, -1])
    def test_a_truncated_file_is_noticed(self, tmp_path: Path, left: int) -> None:
        file = write(tmp_path / "a")
        file.write_bytes(file.read_bytes()[:left])
        with pytest.raises(DamagedArtefactError, match=r"a\.zarr\.zip"):
            read(tmp_path / "a")

    @pytest.mark.parametrize("frames", [FRAMES, np.zeros_like(FRAMES)], ids=["random", "black"])
    def test_a_missing_chunk_is_noticed_whatever_was_in_it(self, tmp_path: Path, frames: np.ndarray) -> None:
        file = write(tmp_path / "a", frames)
        with zipfile.ZipFile(file) as whole:
            members = [(item, whole.read(item)) for item in whole.infolist()]
        with zipfile.ZipFile(file, "w") as less:
            for item, content in members:
                if item.filename != "rgb/c/2/0/0/0":
                    less.writestr(item, content)
        with pytest.raises(DamagedArtefactError, match=r"rgb/c/2/0/0/0: this chunk is missing"):
            read(tmp_path / "a")

    def test_a_group_is_no_array(self, tmp_path: Path) -> None:
        write(tmp_path / "a")
        with pytest.raises(DamagedArtefactError, match="expected an array"):
            read(tmp_path / "a", "split")


@pytest.mark.parametrize(
    "value", [np.array(0.0, np.float32), np.zeros(3), np.zeros((0, 4)), np.arange(6).reshape(2, 3)]
)
def test_single_arrays_come_back(tmp_path: Path, value: np.ndarray) -> None:
    with new_group(tmp_path / "a") as group:
        write_array(group, "deep/value", value)
    found = read(tmp_path / "a", "deep/value")
    assert found.dtype == value.dtype
    np.testing.assert_array_equal(found, value)


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 16
    file.write_bytes(content)


class TestDirectoriesOfEarlierVersions:
    def test_they_are_read(self, tmp_path: Path) -> None:
        write_directory(tmp_path / "a")
        assert group_exists(tmp_path / "a")
        assert (tmp_path / "a" / "rgb" / "c" / "3" / "0" / "0" / "0").is_file()
        np.testing.assert_array_equal(read(tmp_path / "a"), FRAMES)
        np.testing.assert_array_equal(read(tmp_path / "a", "split/train"), np.arange(3))
        assert dict(open_group(tmp_path / "a").attrs) == {"metric": True}

    def test_every_flipped_bit_of_a_chunk_is_noticed(self, tmp_path: Path) -> None:
        write_directory(tmp_path / "a", FRAMES[:, :2, :2, :1])
        file = tmp_path / "a" / "rgb" / "c" / "3" / "0" / "0" / "0"
        whole = file.read_bytes()
        for bit in range(0, 8 * len(whole), 3):
            content = bytearray(whole)
            content[bit // 8] ^= 1 << bit % 8
            file.write_bytes(content)
            with pytest.raises(DamagedArtefactError, match=r"rgb/c/3/0/0/0: "):
                read(tmp_path / "a")

    @pytest.mark.parametrize("frames", [FRAMES, np.zeros_like(FRAMES)], ids=["random", "black"])
    @pytest.mark.parametrize("damage", [Path.unlink, flip_a_bit, lambda file: file.write_bytes(b"")])
    def test_damage_is_noticed(
        self, tmp_path: Path, frames: np.ndarray, damage: Callable[[Path], None]
    ) -> None:
        write_directory(tmp_path / "a", frames)
        damage(tmp_path / "a" / "rgb" / "c" / "2" / "0" / "0" / "0")
        with pytest.raises(DamagedArtefactError, match="rgb/c/2/0/0/0: "):
            read(tmp_path / "a")

    @pytest.mark.parametrize("damage", [Path.unlink, flip_a_bit])
    def test_shards_are_guarded_like_chunks(self, tmp_path: Path, damage: Callable[[Path], None]) -> None:
        group = zarr.open_group(str(tmp_path / "a"), mode="w", zarr_format=3)
        array = group.create_array(
            "rgb",
            shape=FRAMES.shape,
            dtype=FRAMES.dtype,
            chunks=(1, *FRAMES.shape[1:]),
            shards=(2, *FRAMES.shape[1:]),
            compressors=zarr_io._codecs(FRAMES.dtype),
            config=zarr_io.EVERY_CHUNK,
        )
        array[...] = FRAMES
        np.testing.assert_array_equal(read(tmp_path / "a"), FRAMES)
        damage(tmp_path / "a" / "rgb" / "c" / "1" / "0" / "0" / "0")
        with pytest.raises(DamagedArtefactError, match="rgb/c/1/0/0/0"):
            read(tmp_path / "a")

    def test_arrays_from_before_there_were_checksums(self, tmp_path: Path) -> None:
        frames = FRAMES.copy()
        frames[2] = 0
        group = zarr.open_group(str(tmp_path / "a"), mode="w", zarr_format=3)
        old = group.create_array(
            "rgb",
            shape=frames.shape,
            dtype=frames.dtype,
            chunks=(1, 4, 6, 3),
            compressors=BloscCodec(typesize=1),
        )
        old[...] = frames
        # As it was: a chunk of fill values alone was not written.
        assert not (tmp_path / "a" / "rgb" / "c" / "2" / "0" / "0" / "0").exists()
        np.testing.assert_array_equal(read(tmp_path / "a"), frames)
