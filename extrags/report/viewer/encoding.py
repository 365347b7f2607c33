"""Gaussians in few bytes, as the viewer of the page reads them.

A body of planes, compressed with gzip, which browsers can undo themselves. The Gaussians are put in Morton
order and cut into blocks of 256; each channel of a block is stored in 8 or 16 bits between the smallest and
the largest value it has there. Neighbours are alike, so that a centre keeps about 1e-5 of the size of its
block and a colour about 1/500 of the range of its neighbours. Rotations drop the largest of four components
and keep ten bits of each other one. Values known of Gaussians (the quantities) take 8 bits over a range
common to all, 255 standing for unknown. Where a scene knows from which side its Gaussians were seen, two bits
of each say so in a last plane; the shortest axis of a flat Gaussian stays the shortest in 8 bits.

SPZ was not used: it keeps colours in steps of a fixed range made for light baked into them, which clips
bright albedo. SOG needs a clustering for every page.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, Int8, UInt8
from torch import Tensor

from extrags.errors import ShapeError, SourceError
from extrags.gaussians import Gaussians
from extrags.raster.rendering import ALPHA_MIN
from extrags.splat_files.packing import largest_component, levels, unit_quaternions

__all__ = ["EncodedScene", "Quantity", "decoded_scene", "encoded_scene", "faint_gaussians"]

BLOCK = 256
"""Gaussians that share the range of each channel."""
UNKNOWN = 255
"""Stored where a quantity is not known."""
MORTON_BITS = 16
COMPRESSION = 6
SQRT_HALF = 2**-0.5

_BYTES = {"mean": 2, "scale": 1, "opacity": 1, "sh": 1}


@dataclass(frozen=True)
class Quantity:
    """A number known of each Gaussian.

    Args:
        values: one per Gaussian, NaN where it is not known, [N].
        low: shown in the first colour.
        high: shown in the last colour.
        title: what it is, for the list of the viewer.
        ends: what its lowest and highest values mean.
    """

    values: Float[np.ndarray, "n"]
    low: float | int
    high: float | int
    title: str
    ends: tuple[str, str]


@dataclass(frozen=True)
class EncodedScene:
    """A scene as the page carries it.

    Args:
        body: compressed planes.
        count: number of Gaussians.
        degree: of the spherical harmonics kept.
        quantities: names of the quantities, in the order of their planes.
        sided: whether the sides from which the Gaussians were seen (`Scene.facing`) follow.
    """

    body: bytes
    count: int
    degree: int
    quantities: tuple[str, ...]
    sided: bool = False


def encoded_scene(
    gaussians: Gaussians,
    quantities: Mapping[str, Quantity] | None = None,
    *,
    facing: Int8[Tensor, "n"] | None = None,
    degree: int | None = None,
) -> EncodedScene:
    """Gaussians as planes of small integers; those that no picture shows (opacity below 1/255) are left out.

    Args:
        gaussians: the scene.
        quantities: numbers known of each Gaussian.
        facing: sides from which the Gaussians were seen (`Scene.facing`); None where nobody knows.
        degree: highest degree of harmonics to keep; None keeps all.

    Raises:
        ShapeError: when a quantity or the sides have another number of entries.
    """
    quantities = {} if quantities is None else quantities
    for name, quantity in quantities.items():
        if quantity.values.shape != (len(gaussians),):
            raise ShapeError(f"{name} has shape {quantity.values.shape}, expected ({len(gaussians)},)")
    if facing is not None and facing.shape != (len(gaussians),):
        raise ShapeError(f"facing has shape {tuple(facing.shape)}, expected ({len(gaussians)},)")
    kept = min(gaussians.sh_degree, 3 if degree is None else degree)
    opacity = gaussians.opacities.detach().sigmoid().numpy()
    shown = np.flatnonzero(opacity >= ALPHA_MIN)
    means = gaussians.means.detach().numpy()[shown]
    order = shown[_morton_order(means)]
    picked = gaussians.detached().subset(torch.from_numpy(order))
    planes = [
        *_channel_planes("mean", picked.means.numpy()),
        *_rotation_planes(picked.quats.numpy()),
        *_channel_planes("scale", picked.scales.numpy()),
        *_channel_planes("opacity", opacity[order][:, None]),
        *_channel_planes("sh", picked.sh[:, : (kept + 1) ** 2].flatten(1).numpy()),
    ]
    for quantity in quantities.values():
        share = (quantity.values[order] - quantity.low) / max(quantity.high - quantity.low, 1e-12)
        level = np.rint(np.clip(np.nan_to_num(share), 0, 1) * (UNKNOWN - 1))
        planes.append(np.where(np.isfinite(share), level, UNKNOWN).astype(np.uint8).tobytes())
    if facing is not None:
        planes.append(_packed_sides(facing.cpu().numpy()[order]))
    # Without the time of day: equal scenes give equal bytes.
    body = gzip.compress(b"".join(planes), COMPRESSION, mtime=0)
    return EncodedScene(body, len(order), kept, tuple(quantities), facing is not None)


def faint_gaussians(gaussians: Gaussians) -> int:
    """How many no picture shows (opacity below 1/255): `encoded_scene` leaves them out."""
    return int((gaussians.opacities.detach().sigmoid() < ALPHA_MIN).sum())


def decoded_scene(
    encoded: EncodedScene,
) -> tuple[Gaussians, dict[str, UInt8[np.ndarray, "n"]], Int8[Tensor, "n"] | None]:
    """What the viewer makes of an encoded scene: Gaussians in Morton order, levels of its quantities, sides.

    Raises:
        SourceError: when the body does not have the length its header says.
    """
    raw, n = gzip.decompress(encoded.body), encoded.count
    reader = _Reader(raw, n)
    means = reader.channels("mean", 3)
    quats = _rotations(reader.take(4 * n).reshape(4, n))
    scales = reader.channels("scale", 3)
    opacity = reader.channels("opacity", 1)[:, 0]
    terms = (encoded.degree + 1) ** 2
    sh = torch.from_numpy(reader.channels("sh", 3 * terms).reshape(n, terms, 3))
    quantities = {name: reader.take(n) for name in encoded.quantities}
    facing = torch.from_numpy(_sides(reader.take(-(-n // 4)), n)) if encoded.sided else None
    if reader.at != len(raw):
        raise SourceError(f"an encoded scene has {len(raw)} bytes, expected {reader.at}")
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.logit(torch.from_numpy(opacity), eps=1e-6),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )
    return gaussians, quantities, facing


class _Reader:
    def __init__(self, raw: bytes, count: int) -> None:
        self.raw, self.count, self.at = np.frombuffer(raw, np.uint8), count, 0

    def take(self, size: int) -> UInt8[np.ndarray, "_"]:
        if self.at + size > len(self.raw):
            raise SourceError(f"an encoded scene ends after {len(self.raw)} bytes")
        self.at += size
        return self.raw[self.at - size : self.at]

    def channels(self, kind: str, number: int) -> Float[np.ndarray, "n c"]:
        blocks, size = -(-self.count // BLOCK), _BYTES[kind]
        block = np.arange(self.count) // BLOCK
        columns = []
        for _ in range(number):
            low, high = np.frombuffer(self.take(8 * blocks).tobytes(), "<f4").reshape(2, blocks)
            level = sum(
                self.take(self.count).astype(np.float32) * np.float32(256**part) for part in range(size)
            )
            step = (high - low) / np.float32(256**size - 1)
            columns.append(low[block] + level * step[block])
        return np.stack(columns, axis=1).astype(np.float32)


def _channel_planes(kind: str, values: Float[np.ndarray, "n c"]) -> list[bytes]:
    """Ranges and levels of each channel: lows of all blocks, highs, then planes of low and high bytes."""
    size, starts = _BYTES[kind], np.arange(0, len(values), BLOCK)
    levels = 256**size - 1
    block = np.arange(len(values)) // BLOCK
    planes = []
    for column in np.ascontiguousarray(values.T, dtype=np.float32):
        low = np.minimum.reduceat(column, starts) if len(starts) else column
        high = np.maximum.reduceat(column, starts) if len(starts) else column
        span = (high - low).astype(np.float64)[block]
        share = (column.astype(np.float64) - low[block]) / np.where(span > 0, span, 1)
        level = np.rint(share * levels).astype("<u2").view(np.uint8).reshape(-1, 2)
        planes += [low.astype("<f4").tobytes(), high.astype("<f4").tobytes()]
        planes += [np.ascontiguousarray(level[:, part]).tobytes() for part in range(size)]
    return planes


def _packed_sides(facing: Int8[np.ndarray, "n"]) -> bytes:
    """Two bits each, 0 to 2 for -1 to 1, the first of four in the lowest bits."""
    level = np.pad((facing + 1).astype(np.uint8), (0, -len(facing) % 4)).reshape(-1, 4)
    return bytes(level[:, 0] | level[:, 1] << 2 | level[:, 2] << 4 | level[:, 3] << 6)


def _sides(packed: UInt8[np.ndarray, "_"], count: int) -> Int8[np.ndarray, "n"]:
    level = packed[:, None] >> np.arange(0, 8, 2, dtype=np.uint8) & 3
    return level.reshape(-1)[:count].astype(np.int8) - np.int8(1)


def _rotation_planes(quats: Float[np.ndarray, "n 4"]) -> list[bytes]:
    """Three components of ten bits each, and in the upper two bits which one is left out."""
    largest, rest = largest_component(unit_quaternions(quats))
    level = levels(rest / SQRT_HALF * 0.5 + 0.5, 10)
    word = level[:, 0] | level[:, 1] << 10 | level[:, 2] << 20 | largest.astype(np.uint32) << 30
    packed = np.ascontiguousarray(word.astype("<u4").view(np.uint8).reshape(-1, 4).T)
    return [packed.tobytes()]


def _rotations(planes: UInt8[np.ndarray, "4 n"]) -> Float[np.ndarray, "n 4"]:
    word = np.ascontiguousarray(planes.T).view("<u4")[:, 0]
    rest = np.stack([(word >> shift) & 1023 for shift in (0, 10, 20)], axis=1) / 1023 * 2 - 1
    rest = rest * SQRT_HALF
    largest = word >> 30
    quats = np.zeros((len(word), 4))
    quats[np.arange(4) != largest[:, None]] = rest.reshape(-1)
    quats[np.arange(len(word)), largest] = np.sqrt(np.clip(1 - (rest**2).sum(1), 0, 1))
    return quats.astype(np.float32)


def _morton_order(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Order along a curve that keeps neighbours together."""
    if not len(means):
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(means, [0.01, 0.99], axis=0)
    share = (means - low) / max(float((high - low).max()), 1e-12)
    cell = (np.clip(share, 0, 1) * (2**MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(means), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            taken = cell[:, axis] >> np.uint64(bit) & np.uint64(1)
            code |= taken << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
