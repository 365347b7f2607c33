"""Layout of arrays in zarr v3: one frame per chunk, Blosc with Zstandard, CRC-32C, shards for long stacks.

Every chunk carries a checksum, and every chunk is written, those of fill values as well: whatever is missing
or changed is damage, never other data.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
import zarr.core.sync as zarr_sync
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.array import CompressorsLike
from zarr.core.array_spec import ArrayConfigParams
from zarr.storage import LocalStore

from extrags.errors import DamagedArtefactError

__all__ = ["open_group", "read_array", "write_array", "write_frames"]

SHARD_ABOVE_CHUNKS = 1000
"""Stacks of more frames than this are sharded, to keep the number of files low."""
FRAMES_PER_SHARD = 64

SETTLE_SECONDS = 10.0
"""How long to wait for the other chunks when one could not be written."""

# zarr reads a chunk that is not there as fill values, so that a lost file would be black frames.
EVERY_CHUNK: ArrayConfigParams = {"write_empty_chunks": True}


def open_group(path: Path, *, mode: Literal["r", "w", "a"]) -> zarr.Group:
    """Open a zarr v3 group on the local disk."""
    return zarr.open_group(str(path), mode=mode, zarr_format=3)


def write_array(group: zarr.Group, name: str, array: np.ndarray) -> None:
    """Write one array as a single chunk; `name` may be a path with slashes."""
    array = np.asarray(array, order="C")  # ascontiguousarray would make a scalar one-dimensional
    target = group.create_array(
        name,
        shape=array.shape,
        dtype=array.dtype,
        chunks=tuple(max(1, size) for size in array.shape),
        compressors=_codecs(array.dtype),
        config=EVERY_CHUNK,
    )
    if array.size:
        _fill(target, array)


def write_frames(group: zarr.Group, name: str, stack: np.ndarray) -> None:
    """Write a stack with one frame (first axis) per chunk, sharded when it is long."""
    stack = np.ascontiguousarray(stack)
    chunk = (1, *stack.shape[1:])
    shards = None
    if stack.shape[0] > SHARD_ABOVE_CHUNKS:
        shards = (FRAMES_PER_SHARD, *stack.shape[1:])
    target = group.create_array(
        name,
        shape=stack.shape,
        dtype=stack.dtype,
        chunks=chunk,
        shards=shards,
        compressors=_codecs(stack.dtype),
        config=EVERY_CHUNK,
    )
    if stack.size:
        _fill(target, stack)


def read_array(group: zarr.Group, name: str) -> Any:
    """Read a whole array, in native byte order (Open3D accepts no other).

    Args:
        group: on the local disk.
        name: may be a path with slashes.

    Raises:
        DamagedArtefactError: when a chunk is missing, or cannot be decoded, or differs from its checksum;
            names its file.
    """
    array = group[name]
    if not isinstance(array, zarr.Array):
        raise DamagedArtefactError("a group, expected an array", file=f"{group.store_path}/{name}")
    if any(isinstance(codec, Crc32cCodec) for codec in array.compressors):
        # Arrays written before there were checksums have no chunks of fill values alone.
        for file, _ in _chunks(array):
            if not file.is_file():
                raise DamagedArtefactError("this chunk is missing", file=file)
    try:
        stored = np.asarray(array[...])
    except (ValueError, RuntimeError, OSError) as error:
        # Codecs do not say of which chunk they speak: ValueError from CRC-32C, RuntimeError from Blosc.
        file = _first_unreadable(array)
        raise DamagedArtefactError(str(error), file=file) from error
    return stored.astype(stored.dtype.newbyteorder("="), copy=False)


def _fill(target: Any, values: np.ndarray) -> None:
    try:
        target[...] = values
    except Exception:
        # zarr raises at the first chunk that cannot be written, while others are still being written: into
        # a directory that is about to be removed, which they would make again.
        loop = zarr_sync.loop[0]
        if loop is not None:
            with suppress(TimeoutError):
                asyncio.run_coroutine_threadsafe(_all_written(), loop).result(SETTLE_SECONDS)
        raise


async def _all_written() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    if others:
        await asyncio.wait(others)


def _chunks(array: zarr.Array[Any]) -> Iterator[tuple[Path, tuple[slice, ...]]]:
    """Files of an array, chunks or shards, and what of it they hold."""
    assert isinstance(array.store, LocalStore)
    folder = Path(array.store.root) / array.path
    size = array.shards or array.chunks
    counts = [math.ceil(length / step) for length, step in zip(array.shape, size, strict=True)]
    for index in np.ndindex(*counts):
        part = tuple(slice(at * step, (at + 1) * step) for at, step in zip(index, size, strict=True))
        yield folder / array.metadata.encode_chunk_key(index), part


def _first_unreadable(array: zarr.Array[Any]) -> Path:
    """The first file of an array that cannot be read; the array's folder if all can."""
    for file, part in _chunks(array):
        try:
            array[part]
        except (ValueError, RuntimeError, OSError):
            return file
    return Path(str(array.store_path).removeprefix("file://"))


def _codecs(dtype: np.dtype[Any]) -> CompressorsLike:
    # Bit shuffling helps floats (their exponents compress together), but not single bytes.
    shuffle: Literal["bitshuffle", "noshuffle"] = "bitshuffle" if dtype.itemsize > 1 else "noshuffle"
    # The checksum comes last, over the bytes as they are stored: Blosc decodes many a flipped bit silently.
    return BloscCodec(cname="zstd", clevel=5, shuffle=shuffle, typesize=dtype.itemsize), Crc32cCodec()
