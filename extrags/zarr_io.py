"""Layout of arrays in zarr v3: a group is one zip file, one frame per chunk, Blosc with Zstandard, CRC-32C.

The zip file is zarr's own `ZipStore`, without further compression: any zarr, and any unzip, reads it. A chunk
is a member of its own, so that one frame is read without the others. Chunks come first, in the order in
which they were written; the metadata and the zip's directory are the end of the file. Equal content gives
equal bytes.

Every chunk carries a checksum, and every chunk is written, those of fill values as well: whatever is missing
or changed is damage, never other data. Groups of earlier versions, directories with one file per chunk, are
read as they are.
"""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.array import CompressorsLike
from zarr.core.array_spec import ArrayConfigParams
from zarr.errors import NodeNotFoundError
from zarr.storage import LocalStore, MemoryStore, ZipStore

from extrags import frame_stacks
from extrags.errors import DamagedArtefactError, SourceNotFoundError

__all__ = [
    "PACKED",
    "group_exists",
    "has_array",
    "new_group",
    "open_group",
    "read_array",
    "write_array",
    "write_frames",
]

PACKED = ".zarr.zip"
"""Ending of a packed group; callers name it without."""
METADATA = "zarr.json"
HELD_BYTES = 64 << 20
"""Of a stack, so much is encoded at once, by several threads, before it is written in order."""

# zarr reads a chunk that is not there as fill values, so that a lost file would be black frames.
EVERY_CHUNK: ArrayConfigParams = {"write_empty_chunks": True}

# What damage to a zip file, to metadata or to a chunk can raise: Blosc raises RuntimeError, CRC-32C
# ValueError, and zipfile, besides its own, whatever its fields led to.
UNREADABLE = (
    zipfile.BadZipFile,
    struct.error,
    ValueError,
    RuntimeError,
    OSError,
    EOFError,
    LookupError,
    TypeError,
    AttributeError,
)


class _Pack(MemoryStore):
    """A group while it is written: metadata is held until the end, chunks until the next `flush`."""

    def __init__(self, file: zipfile.ZipFile) -> None:
        self._held: dict[str, Any] = {}
        super().__init__(self._held)
        self._file = file

    def flush(self) -> None:
        """Write the chunks that are held, sorted, since threads finish them in any order."""
        for key in sorted(key for key in self._held if not key.endswith(METADATA)):
            self._write(key)

    def finish(self) -> None:
        """Write what is held, metadata last."""
        self.flush()
        for key in sorted(self._held):
            self._write(key)

    def _write(self, key: str) -> None:
        member = zipfile.ZipInfo(key)  # Dated 1980: equal content gives equal bytes.
        member.external_attr = 0o644 << 16
        self._file.writestr(member, self._held.pop(key).to_bytes())


def packed(path: Path) -> Path:
    """The file of a group."""
    return path.with_name(path.name + PACKED)


def group_exists(path: Path) -> bool:
    """Whether there is a group at a path, packed or as a directory."""
    return packed(path).is_file() or path.is_dir()


@contextmanager
def new_group(path: Path) -> Iterator[zarr.Group]:
    """Write a zarr v3 group; it is complete at the end of the block, and removed when that raises.

    Args:
        path: without its ending `.zarr.zip`, which is added.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    place = packed(path)
    try:
        with zipfile.ZipFile(place, "w", zipfile.ZIP_STORED, allowZip64=True) as file:
            store = _Pack(file)
            yield zarr.open_group(store, mode="w", zarr_format=3)
            store.finish()
    except BaseException:
        place.unlink(missing_ok=True)
        raise


def open_group(path: Path) -> zarr.Group:
    """Read a group that `new_group` wrote, or a directory of earlier versions.

    Args:
        path: without the ending `.zarr.zip`.

    Raises:
        SourceNotFoundError: when there is none.
        DamagedArtefactError: when it cannot be read as one; names its file.
    """
    place = packed(path)
    if not place.is_file():
        if not path.is_dir():
            raise SourceNotFoundError("no arrays here", file=place)
        try:
            return zarr.open_group(str(path), mode="r", zarr_format=3)
        except (*UNREADABLE, NodeNotFoundError) as error:
            raise DamagedArtefactError(f"cannot be read: {error}", file=path) from error
    try:
        return zarr.open_group(ZipStore(place, mode="r"), mode="r", zarr_format=3)
    except (*UNREADABLE, NodeNotFoundError) as error:
        if not place.is_file():
            raise
        raise DamagedArtefactError(f"cannot be read: {error}", file=place) from error


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
        target[...] = array
    _flush(group)


def write_frames(group: zarr.Group, name: str, stack: np.ndarray) -> None:
    """Write a stack with one frame (first axis) per chunk."""
    stack = np.ascontiguousarray(stack)
    target = group.create_array(
        name,
        shape=stack.shape,
        dtype=stack.dtype,
        chunks=(1, *stack.shape[1:]),
        compressors=_codecs(stack.dtype),
        config=EVERY_CHUNK,
    )
    if not stack.size:
        return
    step = max(1, HELD_BYTES // stack[0].nbytes)
    for first in range(0, len(stack), step):
        target[first : first + step] = stack[first : first + step]
        _flush(group)


def _flush(group: zarr.Group) -> None:
    if isinstance(group.store, _Pack):
        group.store.flush()


def has_array(group: zarr.Group, name: str) -> bool:
    """Whether a group has an array of this name.

    Raises:
        DamagedArtefactError: when its metadata cannot be read.
    """
    try:
        return name in group
    except UNREADABLE as error:
        raise DamagedArtefactError(f"{name}: {error}", file=_place(group)) from error


def read_array(group: zarr.Group, name: str) -> Any:
    """Read a whole array, in native byte order (Open3D accepts no other).

    A large stack is decoded into a mapped file of its own (`extrags.frame_stacks`): the system may drop its
    pages and read them again. Changing the array does not change the group.

    Args:
        group: from `open_group`.
        name: may be a path with slashes.

    Raises:
        DamagedArtefactError: when a chunk is missing, or cannot be decoded, or differs from its checksum;
            names its file.
        OSError: when the folder of temporary files has no room.
    """
    try:
        array = group[name]
    except KeyError as error:
        raise DamagedArtefactError(f"{name} is missing", file=_place(group)) from error
    except UNREADABLE as error:
        raise DamagedArtefactError(f"{name}: {error}", file=_place(group)) from error
    if not isinstance(array, zarr.Array):
        raise DamagedArtefactError(f"{name} is a group, expected an array", file=_place(group))
    if any(isinstance(codec, Crc32cCodec) for codec in array.compressors):
        # Arrays written before there were checksums have no chunks of fill values alone.
        present = _present(array)
        for key, _ in _chunks(array):
            if key not in present:
                raise _damaged(array, key, "this chunk is missing")
    if array.ndim > 1 and array.nbytes > frame_stacks.MAPPED_BYTES:
        return _stack(array)
    return _decoded(array, slice(None) if array.ndim else ())


def _decoded(array: zarr.Array[Any], part: slice | tuple[()]) -> np.ndarray:
    """Part of an array along its first axis, in native byte order."""
    try:
        stored = np.asarray(array[part])
    except UNREADABLE as error:
        # Codecs do not say of which chunk they speak.
        raise _damaged(array, _first_unreadable(array), str(error)) from error
    return stored.astype(stored.dtype.newbyteorder("="), copy=False)


def _stack(array: zarr.Array[Any]) -> np.ndarray:
    """A whole stack; a large one is decoded part by part into a mapped file."""
    stack = frame_stacks.empty_stack(array.shape, array.dtype.newbyteorder("="))
    # Bounded parts, so that what is decoded at once does not grow with the stack.
    step = max(1, HELD_BYTES * array.shape[0] // max(1, array.nbytes))
    for first in range(0, array.shape[0], step):
        part = slice(first, first + step)
        stack[part] = _decoded(array, part)
    return stack


def _place(group: zarr.Group | zarr.Array[Any]) -> Path:
    """The file of a packed group; the directory of another."""
    if isinstance(group.store, ZipStore):
        return group.store.path
    assert isinstance(group.store, LocalStore)
    return Path(group.store.root)


def _damaged(array: zarr.Array[Any], key: str, problem: str) -> DamagedArtefactError:
    if isinstance(array.store, ZipStore):
        return DamagedArtefactError(f"{key}: {problem}", file=_place(array))
    return DamagedArtefactError(problem, file=_place(array) / key)


def _present(array: zarr.Array[Any]) -> set[str]:
    """Keys of the chunks that an array has."""
    if isinstance(array.store, ZipStore):
        return set(array.store._zf.namelist())
    place = _place(array)
    return {key for key, _ in _chunks(array) if (place / key).is_file()}


def _chunks(array: zarr.Array[Any]) -> Iterator[tuple[str, tuple[slice, ...]]]:
    """Keys of an array's chunks, or shards as long stacks had them once, and what of it they hold."""
    size = array.shards or array.chunks
    counts = [math.ceil(length / step) for length, step in zip(array.shape, size, strict=True)]
    for index in np.ndindex(*counts):
        part = tuple(slice(at * step, (at + 1) * step) for at, step in zip(index, size, strict=True))
        yield f"{array.path}/{array.metadata.encode_chunk_key(index)}", part


def _first_unreadable(array: zarr.Array[Any]) -> str:
    """Key of the first chunk that cannot be read; the array's name if all can."""
    for key, part in _chunks(array):
        try:
            array[part]
        except UNREADABLE:
            return key
    return array.path


def _codecs(dtype: np.dtype[Any]) -> CompressorsLike:
    # Shuffling helps floats (their exponents compress together), but not single bytes. Higher levels make
    # floats no smaller and bytes by a few per cent, and take two to five times as long: a long recording
    # would be compressed for longer than it is read.
    size = dtype.itemsize
    shuffle: Literal["shuffle", "noshuffle"] = "shuffle" if size > 1 else "noshuffle"
    blosc = BloscCodec(cname="zstd", clevel=1 if size > 1 else 3, shuffle=shuffle, typesize=size)
    # The checksum comes last, over the bytes as they are stored: Blosc decodes many a flipped bit silently.
    return blosc, Crc32cCodec()
