"""Layout of arrays in zarr v3: one frame per chunk, Blosc with Zstandard, shards for long stacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from zarr.codecs import BloscCodec

__all__ = ["open_group", "read_array", "write_array", "write_frames"]

SHARD_ABOVE_CHUNKS = 1000
"""Stacks of more frames than this are sharded, to keep the number of files low."""
FRAMES_PER_SHARD = 64


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
        compressors=_codec(array.dtype),
    )
    if array.size:
        target[...] = array


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
        compressors=_codec(stack.dtype),
    )
    if stack.size:
        target[...] = stack


def read_array(group: zarr.Group, name: str) -> Any:
    """Read a whole array, in native byte order (Open3D accepts no other)."""
    stored = np.asarray(group[name][...])  # type: ignore[index]
    return stored.astype(stored.dtype.newbyteorder("="), copy=False)


def _codec(dtype: np.dtype[Any]) -> BloscCodec:
    # Bit shuffling helps floats (their exponents compress together), but not single bytes.
    shuffle: Literal["bitshuffle", "noshuffle"] = "bitshuffle" if dtype.itemsize > 1 else "noshuffle"
    return BloscCodec(cname="zstd", clevel=5, shuffle=shuffle, typesize=dtype.itemsize)
