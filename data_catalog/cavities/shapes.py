"""Cavities of eight kinds as clearances in mm, each within a box.

Colon, sac, airways and field begin as those of `extrags.depth.pretraining.cavities`; oesophagus, sinus, joint
and bladder are made here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float

from data_catalog.cavities.noise import SolidNoise
from data_catalog.cavities.surface import Clearance
from extrags.depth.pretraining.cavities import Cavities

__all__ = ["KINDS", "Kind", "Shape", "make_shape"]

Kind = Literal["colon", "sac", "oesophagus", "airways", "sinus", "joint", "bladder", "field"]
KINDS: tuple[Kind, ...] = get_args(Kind)

_JOIN = 1e-6


@dataclass(frozen=True)
class Shape:
    """A cavity before polyps, diverticula and instruments.

    Args:
        kind: what it is like.
        clearance: in mm, near the wall about the distance to it.
        low_mm: lower corner of the box that holds it.
        high_mm: upper corner.
        radius_mm: typical distance from its middle to the wall.
        tube: whether there is a way ahead to look along.
        facing: where the lens looks, on the whole, in a cavity that is looked at from one side.
    """

    kind: Kind
    clearance: Clearance
    low_mm: Float[np.ndarray, "3"]
    high_mm: Float[np.ndarray, "3"]
    radius_mm: float
    tube: bool
    facing: Float[np.ndarray, "3"] | None = None


def make_shape(kind: Kind, rng: np.random.Generator) -> Shape:
    """A cavity of a kind, drawn."""
    return _MAKERS[kind](rng)


def _colon(rng: np.random.Generator) -> Shape:
    scale = float(rng.uniform(14, 26))
    scene, base = _library_shape("colon", rng, scale)
    half = float(rng.uniform(2.2, 3.0)) * scale
    period = float(scene.fold_period) * scale
    # Sacculations between the folds, in three rows.
    depth, turn = rng.uniform(0.0, 0.22) * scale, rng.uniform(0, 2 * np.pi)
    z = np.linspace(-half, half, 200)
    middle = scale * _middle(scene, z / scale)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        x = points[:, 0] - np.interp(points[:, 2], z, middle[:, 0])
        y = points[:, 1] - np.interp(points[:, 2], z, middle[:, 1])
        rows = np.abs(np.sin(1.5 * np.arctan2(y, x) + turn))
        along = np.abs(np.sin(np.pi * points[:, 2] / period))
        return np.asarray(base(points) + depth * np.sqrt(rows * along), dtype=np.float32)

    reach = np.abs(middle).max(axis=0) + 1.5 * scale + depth
    return Shape(
        "colon",
        clearance,
        np.array([-reach[0], -reach[1], -half]),
        np.array([reach[0], reach[1], half]),
        scale,
        True,
    )


def _sac(rng: np.random.Generator) -> Shape:
    scale = float(rng.uniform(18, 32))
    scene, base = _library_shape("sac", rng, scale)
    reach = 1.45 * scale * scene.axes[0, 0].numpy().astype(np.float64)
    return Shape("sac", base, -reach, reach, float(reach.min()) / 1.45, False)


def _airways(rng: np.random.Generator) -> Shape:
    scale = float(rng.uniform(7.5, 12))
    scene, base = _library_shape("airways", rng, scale)
    starts, directions, radii = (
        part[0].numpy().astype(np.float64) * factor
        for part, factor in zip(scene.branches, (scale, 1.0, scale), strict=True)
    )
    twigs = []
    for k in range(1, 4):
        fork = starts[k] + directions[k] * rng.uniform(2.5, 4.0) * scale
        for _ in range(2):
            aim = directions[k] + 0.8 * rng.standard_normal(3)
            aim[2] = abs(aim[2])
            aim /= np.linalg.norm(aim)
            twigs.append((fork, fork + aim * rng.uniform(2, 4) * scale, radii[k] * rng.uniform(0.6, 0.85)))
    ring, period = rng.uniform(0.0, 0.5), rng.uniform(2.5, 4.5)
    rough = SolidNoise.random(rng, 30.0, 5.0)
    end = starts[1, 2]

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        inside = base(points)
        for first, last, radius in twigs:
            inside = _joined(inside, radius - _to_segment(points, first, last), 1.0)
        rings = np.abs(np.sin(np.pi * points[:, 2] / period)) * np.where(points[:, 2] < end, ring, 0.3 * ring)
        return np.asarray(inside - rings - 0.15 * rough(points), dtype=np.float32)

    wide = 4.2 * scale
    return Shape(
        "airways",
        clearance,
        np.array([-wide, -wide, -3.5 * scale]),
        np.array([wide, wide, end + 4.2 * scale]),
        scale,
        True,
    )


def _field(rng: np.random.Generator) -> Shape:
    scale = float(rng.uniform(38, 62))
    scene, base = _library_shape("field", rng, scale)
    point, direction, radius = scene.instruments
    scene.instruments = (point, direction, -radius.abs() - _JOIN)
    farthest = scale * float(scene.distance)
    dome = np.array([1.9 * scale, 1.9 * scale, 0.0])
    dome[2] = rng.uniform(0.8, 1.2) * scale
    bulge = SolidNoise.random(rng, 120.0, 40.0)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        scaled = points / dome
        scaled[:, 2] = np.minimum(scaled[:, 2], 0)
        ratio = np.sqrt(np.square(scaled).sum(1))
        around = (1 - ratio) * dome.min() * (1 + 0.1 * bulge(points))
        return np.asarray(_cut(base(points), around, 4.0), dtype=np.float32)

    high = np.array([dome[0], dome[1], farthest + 0.55 * scale])
    return Shape(
        "field",
        clearance,
        np.array([-dome[0], -dome[1], -dome[2]]),
        high,
        farthest,
        False,
        np.array([0.0, 0.0, 1.0]),
    )


def _oesophagus(rng: np.random.Generator) -> Shape:
    radius, length = float(rng.uniform(8, 13)), float(rng.uniform(90, 130))
    folds, depth = int(rng.integers(3, 8)), rng.uniform(0.04, 0.5)
    twist, phase = rng.uniform(-0.03, 0.03), rng.uniform(0, 2 * np.pi)
    ring, period = rng.uniform(0, 0.9), rng.uniform(5, 12)
    squeeze_at, squeeze = rng.uniform(-0.2, 0.3) * length, rng.uniform(0.0, 0.5)
    bend, bend_phase = rng.uniform(0, 9, 2), rng.uniform(0, 2 * np.pi, 2)
    wobble, rough = SolidNoise.random(rng, 60.0, 15.0), SolidNoise.random(rng, 12.0, 3.0)
    roughness = rng.uniform(0.0, 0.35)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        z = points[:, 2]
        x = points[:, 0] - bend[0] * np.sin(2 * np.pi * z / length + bend_phase[0])
        y = points[:, 1] - bend[1] * np.sin(2 * np.pi * z / length + bend_phase[1])
        angle = np.arctan2(y, x)
        swing = wobble(points)
        star = 0.5 + 0.5 * np.cos(folds * (angle + twist * z) + phase + 0.9 * swing)
        narrow = (
            1
            - squeeze * np.exp(-np.square((z - squeeze_at) / 14))
            - 0.75 / (1 + np.exp((0.42 * length - z) / 3))
        )
        wall = radius * narrow * (1 - depth * star**1.5) * (1 + 0.06 * swing)
        wall = wall - ring * np.exp(-np.square(np.sin(np.pi * z / period) / 0.35)) * narrow
        return np.asarray(wall - np.sqrt(x**2 + y**2) - roughness * rough(points), dtype=np.float32)

    reach = bend + 1.25 * radius
    return Shape(
        "oesophagus",
        clearance,
        np.array([*-reach, -length / 2]),
        np.array([*reach, length / 2]),
        radius,
        True,
    )


def _sinus(rng: np.random.Generator) -> Shape:
    axes = rng.uniform(16, 30, 3)
    count = int(rng.integers(4, 8))
    middles = rng.uniform(-0.75, 0.75, (count, 3)) * axes
    thickness = rng.uniform(0.8, 2.2)
    # Each chamber is joined to the nearest one before it, so that all can be reached.
    doors = []
    for k in range(1, count):
        nearest = int(np.argmin(np.linalg.norm(middles[:k] - middles[k], axis=1)))
        doors.append((middles[nearest], middles[k], rng.uniform(3.2, 6.0)))
    bodies = []
    for _ in range(int(rng.integers(2, 6))):
        start = rng.uniform(-0.9, 0.9, 3) * axes
        along = rng.standard_normal(3)
        along *= rng.uniform(14, 32) / np.linalg.norm(along)
        middle = start + along / 2 + rng.uniform(-5, 5, 3)
        bodies.append((start, middle, start + along, rng.uniform(2.5, 6.0)))
    bulge, rough = SolidNoise.random(rng, 40.0, 9.0), SolidNoise.random(rng, 9.0, 3.0)
    roughness = rng.uniform(0.05, 0.3)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        swing = bulge(points)
        around = (1 - np.sqrt(np.square(points / axes).sum(1))) * axes.min() + 1.5 * swing
        moved = points + 1.5 * swing[:, None]
        distances = np.stack([np.linalg.norm(moved - middle, axis=1) for middle in middles], axis=1)
        two = np.partition(distances, 1, axis=1)[:, :2]
        inside = _cut(around, (two[:, 1] - two[:, 0]) / 2 - thickness, 2.0)
        for first, last, radius in doors:
            inside = _joined(
                inside, np.minimum(radius + 0.6 * swing - _to_segment(points, first, last), around), 1.5
            )
        for first, middle, last, radius in bodies:
            tube = np.minimum(_to_segment(points, first, middle), _to_segment(points, middle, last))
            inside = _cut(inside, tube - radius - 0.8 * swing, 1.5)
        return np.asarray(inside - roughness * rough(points), dtype=np.float32)

    return Shape("sinus", clearance, -1.2 * axes, 1.2 * axes, 10.0, False)


def _joint(rng: np.random.Generator) -> Shape:
    axes = rng.uniform((24, 18, 13), (36, 26, 19))
    solids = []
    for side in (-1, 1):
        radius = rng.uniform(16, 26)
        center = np.array(
            [
                side * rng.uniform(0.35, 0.7) * axes[0],
                rng.uniform(-6, 6),
                0.55 * axes[2] + radius * rng.uniform(0.55, 0.85),
            ]
        )
        solids.append((center, radius))
    floor, dish = rng.uniform(0.35, 0.75) * axes[2], rng.uniform(0.0, 0.12)
    crescent = rng.uniform(0.5, 0.8) * axes[0]
    rim = rng.uniform(1.5, 3.0)
    bulge, rough = SolidNoise.random(rng, 35.0, 8.0), SolidNoise.random(rng, 6.0, 2.0)
    roughness = rng.uniform(0.0, 0.12)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        inside = (1 - np.sqrt(np.square(points / axes).sum(1))) * axes.min() + 1.2 * bulge(points)
        for center, radius in solids:
            inside = _cut(inside, np.linalg.norm(points - center, axis=1) - radius, 1.0)
        across = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2)
        low = points[:, 2] + floor
        inside = _cut(inside, low + dish * across**2 / axes[0], 1.0)
        meniscus = np.sqrt((across - crescent) ** 2 + (low - 0.4 * rim) ** 2) - rim
        inside = _cut(inside, np.where(points[:, 1] > -0.3 * axes[1], meniscus, np.abs(meniscus) + 1), 0.7)
        return np.asarray(inside - roughness * rough(points), dtype=np.float32)

    return Shape("joint", clearance, -1.25 * axes, 1.25 * axes, float(axes[2]), False)


def _bladder(rng: np.random.Generator) -> Shape:
    axes = rng.uniform(24, 42, 3)
    bulge, ridges = SolidNoise.random(rng, 90.0, 30.0), SolidNoise.random(rng, 26.0, 11.0, waves=24)
    height = rng.uniform(0, 2.6) * (rng.random() < 0.6)
    width = rng.uniform(0.15, 0.4)
    rough = SolidNoise.random(rng, 8.0, 3.0)
    roughness = rng.uniform(0.0, 0.15)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        inside = (1 - np.sqrt(np.square(points / axes).sum(1))) * axes.min() + 2.5 * bulge(points)
        net = np.exp(-np.square(ridges(points) / width))
        return np.asarray(inside - height * net - roughness * rough(points), dtype=np.float32)

    return Shape("bladder", clearance, -1.25 * axes, 1.25 * axes, float(axes.min()), False)


_MAKERS: dict[Kind, Callable[[np.random.Generator], Shape]] = {
    "colon": _colon,
    "sac": _sac,
    "oesophagus": _oesophagus,
    "airways": _airways,
    "sinus": _sinus,
    "joint": _joint,
    "bladder": _bladder,
    "field": _field,
}


def _library_shape(
    kind: Literal["colon", "sac", "airways", "field"], rng: np.random.Generator, scale_mm: float
) -> tuple[Cavities, Clearance]:
    """A shape of the depth network's cavities, in mm."""
    scene = Cavities(kind, 1, torch.Generator().manual_seed(int(rng.integers(1 << 62))))

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        with torch.no_grad():
            found = scene.clearance(torch.from_numpy((points / scale_mm).astype(np.float32))[None])
        return np.asarray(scale_mm * found[0].numpy(), dtype=np.float32)

    return scene, clearance


def _middle(scene: Cavities, z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    return np.asarray(
        scene.center_line(torch.from_numpy(z.astype(np.float32))[None])[0].numpy(), dtype=np.float64
    )


def _to_segment(
    points: Float[np.ndarray, "n 3"], first: Float[np.ndarray, "3"], last: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    along = (last - first).astype(np.float32)
    offset = points - first.astype(np.float32)
    share = np.clip((offset * along).sum(axis=1) / np.square(along).sum(), 0, 1)
    return np.asarray(np.sqrt(np.square(offset - share[:, None] * along).sum(axis=1)))


def _cut(
    inside: Float[np.ndarray, "n"], outside_solid: Float[np.ndarray, "n"], foot_mm: float
) -> Float[np.ndarray, "n"]:
    """Free space less a solid: a smooth minimum, so that solids have a foot."""
    share = np.clip(0.5 + 0.5 * (outside_solid - inside) / foot_mm, 0, 1)
    return np.asarray(outside_solid * (1 - share) + inside * share - foot_mm * share * (1 - share))


def _joined(
    inside: Float[np.ndarray, "n"], more: Float[np.ndarray, "n"], foot_mm: float
) -> Float[np.ndarray, "n"]:
    """Free space and more of it: a smooth maximum."""
    return -_cut(-inside, -more, foot_mm)
