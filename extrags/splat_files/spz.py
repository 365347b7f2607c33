"""SPZ, the compressed format of Niantic: fixed-point numbers, packed attribute by attribute, in gzip.

Versions 2, 3 and 4 are read, version 3 is written: every reader knows it. Layout of 2 and 3 after gzip,
little-endian: magic `NGSP`, version, count, SH degree, fractional bits of positions, flags, a zero; then
positions (3 x 24 bits), opacities (8 bits), colours (3 x 8), logarithms of scales (3 x 8, steps of 1/16 from
-10), rotations (version 2: x, y, z of 8 bits; version 3: 32 bits, the largest component left out), SH
coefficients (8 bits, coefficient by coefficient). Version 4 holds the same six planes, each compressed with
Zstandard, behind a header that is not compressed (`extrags.splat_files.spz_streams`).

The format's axes are right, up, back; ours are OpenCV's right, down, forward. Positions, rotations and
harmonics are turned by half a turn about x on the way, as the format's own tools do for PLY files.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from extrags.errors import SourceError, SourceNotFoundError, reason_of
from extrags.gaussians import Gaussians
from extrags.output_files import write_file
from extrags.splat_files.packing import largest_component, levels, unit_quaternions
from extrags.splat_files.spz_streams import read_header, read_planes

__all__ = ["read_spz", "write_spz"]

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_COLOR_SCALE = 0.15
"""Of the colours' SH coefficients, set by the format: 8 bits reach a little beyond [0, 1]."""
_REST = {0: 0, 1: 3, 2: 8, 3: 15}
"""SH coefficients above degree 0, by degree."""
_SMALLEST_SCALE, _LARGEST_SCALE = -10.0, 255 / 16 - 10
"""Logarithms of standard deviations that 8 bits hold."""
_OUTSIDE_SHARE = 0.01
"""So many Gaussians may be of another size without a picture showing it much."""
_LARGEST_COUNT = 10_000_000
_MOST_FROM_A_BYTE = 1032
"""Gzip unpacks a byte to no more: two bits stand for 258 bytes at most. Zstandard could to thousands of times
as much, and a file of 20 kB fill gigabytes, but only with one number repeated: no scene is like that."""
_QUAT_MAX = 511
_COMPRESSION = 6
"""As the format's own tools have it. The highest level takes seven times as long for 0.6 % fewer bytes."""
_FLIPPED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
"""Signs of SH coefficients 1 to 15 under half a turn about x: those odd in (y, z) together change."""


def write_spz(gaussians: Gaussians, path: Path) -> None:
    """Write SPZ of version 3.

    Positions get as many fractional bits as the scene's size leaves of 24, at most 20; scales reach from
    e^-10 to e^5.9 world units (a flat Gaussian may be thinner), colours from -0.44 to 1.44; SH coefficients
    lie in [-1, 1), in steps of 1/8 (degree 1: 1/16) as the format's own tools round them.

    Args:
        gaussians: with colours, not albedo (`bake_light`).
        path: file to write.

    Raises:
        CaptureError: when there are no Gaussians.
        SourceError: for positions that 24 bits cannot hold, or where more than one Gaussian in a hundred has
            a size that the format has not.
    """
    gaussians, n = gaussians.for_file(path), len(gaussians)
    means = gaussians.means.double().numpy() * [1, -1, -1]
    reach = float(np.abs(means).max(initial=0.0))
    bits = 20 if reach == 0 else min(20, int(np.floor(np.log2((2**23 - 1) / reach))))
    if bits < 0 or not np.isfinite(reach):
        raise SourceError(f"positions reach to {reach:g}; SPZ holds at most 2^23 units", field="means")
    fixed = np.rint(means * (1 << bits)).astype("<i4")
    positions = fixed.view(np.uint8).reshape(n, 3, 4)[:, :, :3]
    opacities = levels(gaussians.opacities.sigmoid().numpy(), 8).astype(np.uint8)
    sh0 = gaussians.sh0.numpy()[:, 0]
    colors = levels(sh0 * _COLOR_SCALE + 0.5, 8).astype(np.uint8)
    _check_sizes(gaussians.scales.numpy())
    scales = _bytes((gaussians.scales.numpy() + 10) * 16)
    # Components in the format's order x, y, z, w.
    quats = unit_quaternions(gaussians.quats.numpy())[:, [1, 2, 3, 0]] * [1, -1, -1, 1]
    largest, rest = largest_component(quats)
    magnitude = np.rint(np.abs(rest) * np.sqrt(2) * _QUAT_MAX).astype(np.uint32).clip(0, _QUAT_MAX)
    parts = magnitude | ((rest < 0).astype(np.uint32) << 9)
    packed = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    shN = gaussians.shN.numpy() * _FLIPPED[: gaussians.shN.shape[1], None]
    harmonics = np.rint(shN * 128 + 128)
    # Steps of 8 for degree 1, of 16 above: gzip does the rest.
    step = np.where(np.arange(shN.shape[1]) < 3, np.float32(8), np.float32(16))[:, None]
    harmonics = _bytes(np.floor((harmonics + step / 2) / step) * step)
    header = _HEADER.pack(_MAGIC, 3, n, gaussians.sh_degree, bits, 0, 0)
    content = [positions, opacities, colors, scales, packed.astype("<u4"), harmonics]
    body = b"".join(np.ascontiguousarray(part).tobytes() for part in content)
    # No time stamp: the same scene gives the same file.
    write_file(path, gzip.compress(header + body, _COMPRESSION, mtime=0))


def _check_sizes(scales: Float[np.ndarray, "n 3"]) -> None:
    """Refuse a scene of which much would get another size; scales are logarithms."""
    # How thin the thinnest axis is changes no picture.
    _, middle, largest = np.sort(scales, axis=1).T
    for outside, kind in ((largest > _LARGEST_SCALE, "larger"), (middle < _SMALLEST_SCALE, "smaller")):
        if outside.mean() > _OUTSIDE_SHARE:
            raise SourceError(
                f"{100 * outside.mean():.0f} % of the Gaussians are {kind} than SPZ can hold, whose scales "
                f"reach from {np.exp(_SMALLEST_SCALE):.1e} to {np.exp(_LARGEST_SCALE):.0f} units of the "
                "scene; another format, or another unit, holds them",
                field="scales",
            )


def read_spz(path: Path) -> Gaussians:
    """Read SPZ of version 2, 3 or 4; extensions of version 4 other than the one for its axes are passed over.

    Raises:
        SourceNotFoundError: when there is no such file.
        SourceError: when it is damaged, of another version, has other axes than the format's own, or
            announces more than it holds.
    """
    if not path.is_file():
        raise SourceNotFoundError("no such file", file=path)
    with path.open("rb") as stream:
        compressed = stream.read(2) == b"\x1f\x8b"
    version, n, degree, bits, planes = _gzipped(path) if compressed else _streams(path)
    positions, opacities, colors, scales, rotations, harmonics = planes
    fixed = np.zeros((n, 3, 4), dtype=np.uint8)
    fixed[:, :, 1:] = positions.reshape(n, 3, 3)
    means = (fixed.view("<i4")[..., 0] >> 8) / float(1 << bits) * [1, -1, -1]
    share = (opacities.astype(np.float64) / 255).clip(1e-6, 1 - 1e-6)
    quats = (_three_bytes if version == 2 else _smallest_three)(rotations)
    shN = (harmonics.reshape(n, _REST[degree], 3).astype(np.float32) - 128) / 128
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy((quats[:, [3, 0, 1, 2]] * [1, 1, -1, -1]).astype(np.float32)),
        scales=torch.from_numpy(scales.reshape(n, 3).astype(np.float32) / 16 - 10),
        opacities=torch.from_numpy(np.log(share / (1 - share)).astype(np.float32)),
        sh0=torch.from_numpy((colors.reshape(n, 1, 3).astype(np.float32) / 255 - 0.5) / _COLOR_SCALE),
        shN=torch.from_numpy(shN * _FLIPPED[: shN.shape[1], None]),
    )


_Planes = tuple[int, int, int, int, list[UInt8[np.ndarray, "b"]]]
"""Version, number of Gaussians, SH degree, fractional bits, and the planes in the order of the file."""


def _gzipped(path: Path) -> _Planes:
    """Versions 2 and 3."""
    try:
        with gzip.open(path) as stream:
            start = stream.read(_HEADER.size)
            if len(start) < _HEADER.size:
                raise SourceError("it ends within its header", file=path)
            magic, version, n, degree, bits, _, _ = _HEADER.unpack(start)
            if magic != _MAGIC:
                raise SourceError("not an SPZ file: wrong magic number", file=path)
            if version not in (2, 3):
                raise _unknown_version(path, version)
            _check_header(path, n, degree, bits)
            sizes = _plane_sizes(version, degree)
            _check_room(path, n, n * sum(sizes))
            # Not more than announced: a small file can unpack to anything.
            body = stream.read(n * sum(sizes))
    except (OSError, EOFError, zlib.error) as error:
        raise SourceError(f"not an SPZ file, or damaged: {reason_of(error)}", file=path) from error
    if len(body) < n * sum(sizes):
        raise SourceError(f"{n} Gaussians announced, but the file is truncated", file=path, field="count")
    ends = np.cumsum([n * size for size in sizes])[:-1]
    return version, n, degree, bits, np.split(np.frombuffer(body, dtype=np.uint8), ends)


def _streams(path: Path) -> _Planes:
    """Version 4."""
    content = path.read_bytes()
    header = read_header(content, path)
    if header.version != 4:
        raise _unknown_version(path, header.version)
    _check_header(path, header.count, header.degree, header.bits)
    sizes = [header.count * size for size in _plane_sizes(4, header.degree)]
    _check_room(path, header.count, sum(sizes))
    planes = [np.frombuffer(plane, dtype=np.uint8) for plane in read_planes(content, header, sizes, path)]
    return 4, header.count, header.degree, header.bits, planes


def _plane_sizes(version: int, degree: int) -> list[int]:
    """Bytes per Gaussian of each plane."""
    return [9, 1, 3, 3, 3 if version == 2 else 4, 3 * _REST[degree]]


def _check_header(path: Path, count: int, degree: int, bits: int) -> None:
    if degree not in _REST:
        raise SourceError(f"SH degree {degree}; expected 0 to 3", file=path, field="sh_degree")
    if count > _LARGEST_COUNT or bits > 24:
        raise SourceError(f"{count} Gaussians with {bits} fractional bits", file=path, field="count")


def _check_room(path: Path, count: int, needed: int) -> None:
    """Refuse, before memory is taken, a number of Gaussians that the file is too small for."""
    there = path.stat().st_size
    if needed > there * _MOST_FROM_A_BYTE:
        raise SourceError(
            f"{count} Gaussians of {needed} bytes announced in a file of {there}: truncated, or made to fill "
            "the memory",
            file=path,
            field="count",
        )


def _unknown_version(path: Path, version: int) -> SourceError:
    return SourceError(f"SPZ of version {version}; 2, 3 and 4 are read", file=path, field="version")


def _smallest_three(packed: UInt8[np.ndarray, "b"]) -> Float[np.ndarray, "n 4"]:
    """Components x, y, z, w from 2 bits that name the largest and 3 x 10 bits with sign."""
    words = packed.view("<u4") if packed.flags.aligned else np.frombuffer(packed.tobytes(), "<u4")
    parts = np.stack([words >> 20, words >> 10, words], axis=1) & 0x3FF
    values = (parts & _QUAT_MAX) / _QUAT_MAX * np.sqrt(0.5) * np.where(parts >> 9, -1.0, 1.0)
    largest = (words >> 30).astype(np.int64)
    quats = np.zeros((len(words), 4))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(quats, others, values, axis=1)
    quats[np.arange(len(words)), largest] = np.sqrt(np.maximum(0, 1 - (values**2).sum(axis=1)))
    return quats


def _three_bytes(packed: UInt8[np.ndarray, "b"]) -> Float[np.ndarray, "n 4"]:
    """Components x, y, z, w from x, y, z with w not negative."""
    vector = packed.reshape(-1, 3) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (vector**2).sum(axis=1)))
    quats = np.concatenate([vector, w[:, None]], axis=1)
    return np.asarray(quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(values).clip(0, 255).astype(np.uint8))
