"""Arrays on disk: what is read is what was written, or an error that names the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec

from extrags import zarr_io
from extrags.errors import DamagedArtefactError
from extrags.zarr_io import open_group, read_array, write_array, write_frames

FRAMES = np.random.default_rng(0).integers(0, 255, (5, 4, 6, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_frames(open_group(tmp_path / "a", mode="w"), "rgb", FRAMES)
    return tmp_path / "a"


def read(folder: Path, name: str = "rgb") -> np.ndarray:
    return np.asarray(read_array(open_group(folder, mode="r"), name))


def test_every_flipped_bit_of_a_chunk_is_noticed(tmp_path: Path) -> None:
    folder, frames = tmp_path / "a", FRAMES[:, :2, :2, :1]
    write_frames(open_group(folder, mode="w"), "rgb", frames)
    file = folder / "rgb" / "c" / "3" / "0" / "0" / "0"
    whole = file.read_bytes()
    for bit in range(8 * len(whole)):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        file.write_bytes(content)
        with pytest.raises(DamagedArtefactError, match=r"rgb/c/3/0/0/0: "):
            read(folder)
    file.write_bytes(whole)
    np.testing.assert_array_equal(read(folder), frames)


@pytest.mark.parametrize("left", [0, 1, 20])
def test_a_truncated_chunk_is_noticed(folder: Path, left: int) -> None:
    file = folder / "rgb" / "c" / "1" / "0" / "0" / "0"
    file.write_bytes(file.read_bytes()[:left])
    with pytest.raises(DamagedArtefactError, match="rgb/c/1/0/0/0"):
        read(folder)


@pytest.mark.parametrize("frames", [FRAMES, np.zeros_like(FRAMES)], ids=["random", "black"])
def test_a_missing_chunk_is_noticed_whatever_was_in_it(tmp_path: Path, frames: np.ndarray) -> None:
    write_frames(open_group(tmp_path / "a", mode="w"), "rgb", frames)
    np.testing.assert_array_equal(read(tmp_path / "a"), frames)
    (tmp_path / "a" / "rgb" / "c" / "2" / "0" / "0" / "0").unlink()
    with pytest.raises(DamagedArtefactError, match=r"rgb/c/2/0/0/0: this chunk is missing"):
        read(tmp_path / "a")


@pytest.mark.parametrize(
    "value", [np.array(0.0, np.float32), np.zeros(3), np.zeros((0, 4)), np.arange(6).reshape(2, 3)]
)
def test_single_arrays_come_back(tmp_path: Path, value: np.ndarray) -> None:
    write_array(open_group(tmp_path / "a", mode="w"), "deep/value", value)
    found = read(tmp_path / "a", "deep/value")
    assert found.dtype == value.dtype
    np.testing.assert_array_equal(found, value)


def test_a_missing_scalar_is_noticed(tmp_path: Path) -> None:
    write_array(open_group(tmp_path / "a", mode="w"), "value", np.array(0.0, np.float32))
    (tmp_path / "a" / "value" / "c").unlink()
    with pytest.raises(DamagedArtefactError, match="value/c"):
        read(tmp_path / "a", "value")


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 16
    file.write_bytes(content)


@pytest.mark.parametrize("damage", [Path.unlink, flip_a_bit])
def test_shards_are_guarded_like_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[Path], None]
) -> None:
    monkeypatch.setattr(zarr_io, "SHARD_ABOVE_CHUNKS", 4)
    monkeypatch.setattr(zarr_io, "FRAMES_PER_SHARD", 2)
    write_frames(open_group(tmp_path / "a", mode="w"), "rgb", FRAMES)
    np.testing.assert_array_equal(read(tmp_path / "a"), FRAMES)
    files = [path for path in (tmp_path / "a" / "rgb" / "c").rglob("*") if path.is_file()]
    assert len(files) == 3
    damage(tmp_path / "a" / "rgb" / "c" / "1" / "0" / "0" / "0")
    with pytest.raises(DamagedArtefactError, match="rgb/c/1/0/0/0"):
        read(tmp_path / "a")


def test_arrays_from_before_there_were_checksums_are_read(tmp_path: Path) -> None:
    group = open_group(tmp_path / "a", mode="w")
    frames = FRAMES.copy()
    frames[2] = 0
    old = group.create_array(
        "rgb", shape=frames.shape, dtype=frames.dtype, chunks=(1, 4, 6, 3), compressors=BloscCodec(typesize=1)
    )
    old[...] = frames
    # As it was: a chunk of fill values alone was not written.
    assert not (tmp_path / "a" / "rgb" / "c" / "2" / "0" / "0" / "0").exists()
    np.testing.assert_array_equal(read(tmp_path / "a"), frames)


def test_a_group_is_no_array(tmp_path: Path) -> None:
    zarr.open_group(str(tmp_path / "a"), mode="w", zarr_format=3).create_group("rgb")
    with pytest.raises(DamagedArtefactError, match="expected an array"):
        read(tmp_path / "a")
