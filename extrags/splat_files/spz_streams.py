"""The container of SPZ from version 4 on: a plain header, extensions, and streams of Zstandard.

Little-endian. Bytes 0 to 31: magic `NGSP`, version, count (32 bits each), SH degree, fractional bits, flags
(1 antialiased, 2 extensions), number of streams (8 bits each), where the table of streams begins (32 bits),
twelve zeros. From 32 on, with flag 2, extensions: type, length (32 bits each), content. The table: compressed
and plain length of each stream (64 bits each). Then the streams, one after the other, without empty ones.

Source: [SPZ] has no text for it, only the code of its library; [RFC8878], see docs/references.md.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from extrags.errors import SourceError

__all__ = ["SpzHeader", "read_header", "read_planes"]

MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBBI12x")
_RECORD = struct.Struct("<II")
_ENTRY = struct.Struct("<QQ")
_EXTENDED = 2
_AXES = 0xADBE0003
"""The extension that names the axes of the file."""
_OWN_AXES = (0, 4)
"""Not named; right, up, back."""
_FRAME_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class SpzHeader:
    """What the header says.

    Args:
        version: of the format.
        count: number of Gaussians.
        degree: of the spherical harmonics.
        bits: fractional bits of positions.
        streams: number of streams.
        table: where their table begins, in bytes.
    """

    version: int
    count: int
    degree: int
    bits: int
    streams: int
    table: int


def read_header(content: bytes, path: Path) -> SpzHeader:
    """The header, once its extensions were looked at.

    Args:
        content: of the file.
        path: named in errors.

    Raises:
        SourceError: when it is damaged, or the file has other axes than right, up, back.
    """
    if len(content) < _HEADER.size:
        raise SourceError("it ends within its header", file=path)
    magic, version, count, degree, bits, flags, streams, table = _HEADER.unpack_from(content)
    if magic != MAGIC:
        raise SourceError("not an SPZ file: wrong magic number", file=path)
    header = SpzHeader(version, count, degree, bits, streams, table)
    if version != 4:
        # What follows in other versions is not known.
        return header
    if not _HEADER.size <= table <= len(content) - streams * _ENTRY.size:
        raise SourceError(
            f"its table of {streams} streams begins at byte {table} of {len(content)}: it is truncated",
            file=path,
            field="streams",
        )
    if flags & _EXTENDED:
        _check_axes(content[_HEADER.size : table], path)
    return header


def read_planes(content: bytes, header: SpzHeader, sizes: Sequence[int], path: Path) -> list[bytes]:
    """The unpacked planes, empty ones included.

    Args:
        content: of the file.
        header: of `read_header`.
        sizes: bytes that each plane must have.
        path: named in errors.

    Raises:
        SourceError: when the streams are not those of the header, or damaged.
    """
    from numcodecs.zstd import decompress

    expected = [size for size in sizes if size]
    if header.streams != len(expected):
        raise SourceError(f"{header.streams} streams, expected {len(expected)}", file=path, field="streams")
    at = header.table + header.streams * _ENTRY.size
    found = []
    for place, size in enumerate(expected):
        packed, plain = _ENTRY.unpack_from(content, header.table + place * _ENTRY.size)
        frame = content[at : at + packed]
        at += packed
        if plain != size or len(frame) < packed or _plain_size(frame) not in (None, size):
            raise SourceError(
                f"stream {place + 1} of {header.count} Gaussians holds not the {size} bytes that it should, "
                "or is truncated",
                file=path,
                field="streams",
            )
        plane = bytearray(size)
        try:
            # Not more than announced: a small file can unpack to anything.
            decompress(frame, plane)
        except (RuntimeError, ValueError) as error:
            raise SourceError(
                f"stream {place + 1} is damaged: {error}", file=path, field="streams"
            ) from error
        found.append(bytes(plane))
    rest = iter(found)
    return [next(rest) if size else b"" for size in sizes]


def _check_axes(records: bytes, path: Path) -> None:
    """Refuse axes that are not the format's own; other extensions are passed over."""
    at = 0
    while at < len(records):
        if at + _RECORD.size > len(records):
            raise SourceError("its extensions are damaged", file=path, field="extensions")
        kind, length = _RECORD.unpack_from(records, at)
        body = records[at + _RECORD.size : at + _RECORD.size + length]
        if len(body) < length:
            raise SourceError("its extensions are damaged", file=path, field="extensions")
        if kind == _AXES and int.from_bytes(body[:4], "little") not in _OWN_AXES:
            raise SourceError(
                f"its axes are number {int.from_bytes(body[:4], 'little')} of the format's extension; right, "
                "up, back (4) are read",
                file=path,
                field="extensions",
            )
        at += _RECORD.size + length


def _plain_size(frame: bytes) -> int | None:
    """Length of a frame's content as its header has it; None where it has none.

    Source: [RFC8878], see docs/references.md.
    """
    if frame[:4] != _FRAME_MAGIC or len(frame) < 18:
        # A wrong one is refused when it is unpacked; a short one is a plane of a few Gaussians.
        return None
    descriptor = frame[4]
    single = descriptor >> 5 & 1
    width = (single, 2, 4, 8)[descriptor >> 6]
    if width == 0:
        return None
    begin = 5 + (1 - single) + (0, 1, 2, 4)[descriptor & 3]
    size = int.from_bytes(frame[begin : begin + width], "little")
    return size + 256 if width == 2 else size
