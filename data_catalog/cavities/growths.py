"""What grows on a wall, hollows it out or lies before it: polyps, diverticula, fat, bowel, instruments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.shapes import Kind
from data_catalog.cavities.surface import Lattice, Wall, unit

__all__ = ["Growth", "Tissue", "draw_growths", "stamp", "tissue_shares"]

Tissue = Literal["lump", "hollow", "fat", "bowel", "metal"]
_Vector = Float[np.ndarray, "3"]
TISSUES: tuple[Tissue, ...] = ("lump", "hollow", "fat", "bowel", "metal")


@dataclass(frozen=True)
class Growth:
    """A thick polyline, added to the wall or taken from it.

    Args:
        tissue: what it is made of.
        line: its corners, in mm, at least one.
        radius_mm: of its round section.
        foot_mm: over this length it goes over into the wall.
    """

    tissue: Tissue
    line: Float[np.ndarray, "k 3"]
    radius_mm: float
    foot_mm: float

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """To its surface, negative within it."""
        line = self.line.astype(np.float32)
        if len(line) == 1:
            return np.asarray(np.sqrt(np.square(points - line[0]).sum(axis=1)) - self.radius_mm)
        nearest = np.full(len(points), np.inf, dtype=np.float32)
        for first, last in pairwise(line):
            along = last - first
            offset = points - first
            share = np.clip((offset * along).sum(axis=1) / np.square(along).sum(), 0, 1)
            square = np.square(offset - share[:, None] * along).sum(axis=1)
            np.minimum(nearest, square, out=nearest)
        return np.asarray(np.sqrt(nearest) - self.radius_mm)


def draw_growths(kind: Kind, wall: Wall, radius_mm: float, rng: np.random.Generator) -> list[Growth]:
    """Growths on places of a wall, as the kind of cavity has them.

    Args:
        kind: of the cavity.
        wall: without growths.
        radius_mm: typical radius of the cavity.
        rng: source of randomness.
    """
    growths: list[Growth] = []

    def place() -> _Place:
        vertex = int(rng.integers(len(wall.vertices)))
        return wall.vertices[vertex].astype(np.float64), wall.normals[vertex].astype(np.float64)

    if kind == "field":
        growths += [_bowel(*_facing_up(place), rng) for _ in range(int(rng.integers(0, 4)))]
        for _ in range(int(rng.integers(0, 7))):
            growths += _fat(*_facing_up(place), rng)
    else:
        for _ in range(int(rng.integers(0, 6)) if rng.random() < 0.7 else 0):
            growths += _polyp(*place(), rng, min(1.0, radius_mm / 18))
    if kind in ("colon", "bladder", "oesophagus", "sac") and rng.random() < 0.35:
        for _ in range(int(rng.integers(1, 9))):
            point, normal = place()
            size = rng.uniform(1.2, 4.0)
            growths.append(
                Growth(
                    "hollow",
                    np.stack([point + normal, point - normal * size * rng.uniform(0.3, 1.2)]),
                    size,
                    0.4 * size,
                )
            )
    share = {"field": 0.7, "joint": 0.4, "bladder": 0.2, "colon": 0.12, "sac": 0.12, "sinus": 0.2}.get(
        kind, 0.05
    )
    if rng.random() < share:
        for _ in range(int(rng.integers(1, 3))):
            growths += _instrument(*place(), wall, rng, radius_mm)
    return growths


_Place = tuple[_Vector, _Vector]
"""A point and the normal there."""


def _facing_up(place: Callable[[], _Place]) -> _Place:
    """A place whose normal points at the lens of a field, or the last of twenty."""
    for _ in range(20):
        point, normal = place()
        if normal[2] < -0.5:
            break
    return point, normal


def _polyp(point: _Vector, normal: _Vector, rng: np.random.Generator, size: float) -> list[Growth]:
    radius = size * rng.uniform(0.8, 4.5)
    if rng.random() < 0.3:
        lean = unit(normal + 0.5 * rng.standard_normal(3)).astype(np.float64)
        top = point + lean * radius * rng.uniform(1.5, 2.5)
        stalk = Growth(
            "lump",
            np.stack([point, point + 0.6 * (top - point) + 0.3 * rng.standard_normal(3), top]),
            0.4 * radius,
            radius,
        )
        return [stalk, Growth("lump", top[None], radius, 0.5 * radius)]
    across = np.cross(normal, rng.standard_normal(3))
    across = across / max(float(np.linalg.norm(across)), 1e-6) * radius
    depth = rng.uniform(-0.7, 0.4) * radius
    line = np.stack([point + normal * depth, point + normal * depth + across * rng.uniform(0, 1.5)])
    return [Growth("lump", line, radius, rng.uniform(0.4, 1.2) * radius)]


def _fat(point: _Vector, normal: _Vector, rng: np.random.Generator) -> list[Growth]:
    """A heap of lobules."""
    spread, size = rng.uniform(5, 16), rng.uniform(2.5, 6)
    found = []
    for _ in range(int(rng.integers(6, 22))):
        offset = rng.standard_normal(3) * spread
        offset -= normal * (offset @ normal) * 0.6
        radius = size * np.exp(rng.normal(0, 0.3))
        second = point + offset + rng.standard_normal(3) * radius * 0.8
        found.append(Growth("fat", np.stack([point + offset, second]), radius, 0.35 * radius))
    return found


def _bowel(point: _Vector, normal: _Vector, rng: np.random.Generator) -> Growth:
    """A loop that lies on the wall and winds."""
    radius = rng.uniform(6, 13)
    across = np.cross(normal, rng.standard_normal(3))
    heading = across / max(float(np.linalg.norm(across)), 1e-6)
    line = [point + normal * radius * rng.uniform(-0.3, 0.6) - heading * 30]
    curl = rng.normal(0, 0.25)
    for _ in range(11):
        curl = 0.8 * curl + rng.normal(0, 0.2)
        heading = heading + curl * np.cross(normal, heading) + 0.15 * rng.standard_normal(3)
        heading /= np.linalg.norm(heading)
        line.append(line[-1] + 0.8 * radius * heading)
    return Growth("bowel", np.stack(line), radius, 0.15 * radius)


def _instrument(
    point: _Vector,
    normal: _Vector,
    wall: Wall,
    rng: np.random.Generator,
    radius_mm: float,
) -> list[Growth]:
    """A shaft that comes from outside and ends before the wall, with two jaws."""
    tip = point + normal * rng.uniform(0.1, 0.6) * radius_mm
    aim = unit(normal + 0.9 * rng.standard_normal(3)).astype(np.float64)
    shaft = min(2.5, 0.12 * radius_mm) * rng.uniform(0.6, 1.2)
    rear = tip + aim * 6 * radius_mm
    across = np.cross(aim, rng.standard_normal(3))
    across /= max(float(np.linalg.norm(across)), 1e-6)
    opening = rng.uniform(0.5, 2.5) * shaft
    jaw = rng.uniform(3, 7) * shaft
    found = [Growth("metal", np.stack([tip, rear]), shaft, 0.2)]
    for side in (-1, 1):
        bent = tip - aim * 0.5 * jaw + side * across * opening
        found.append(
            Growth(
                "metal",
                np.stack([tip, bent, tip - aim * jaw + side * across * 0.6 * opening]),
                0.45 * shaft,
                0.2,
            )
        )
    return found


def stamp(lattice: Lattice, growths: list[Growth]) -> Lattice:
    """The lattice with growths: only nodes near them change."""
    values = lattice.values.copy()
    for growth in growths:
        reach = growth.radius_mm + growth.foot_mm + 2 * lattice.step_mm
        low = np.floor((growth.line.min(axis=0) - reach - lattice.low_mm) / lattice.step_mm).astype(int)
        high = np.ceil((growth.line.max(axis=0) + reach - lattice.low_mm) / lattice.step_mm).astype(int) + 1
        low, high = np.clip(low, 1, None), np.clip(high, None, np.array(values.shape) - 1)
        if (high <= low).any():
            continue
        block = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        index = np.stack(
            np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1
        )
        distance = growth.distance(lattice.positions(index.reshape(-1, 3))).reshape(index.shape[:3])
        inside = values[block]
        sign = -1.0 if growth.tissue == "hollow" else 1.0
        share = np.clip(0.5 + 0.5 * (distance - sign * inside) / growth.foot_mm, 0, 1)
        mixed = sign * (distance * (1 - share) + sign * inside * share - growth.foot_mm * share * (1 - share))
        values[block] = mixed
    return Lattice(lattice.low_mm, lattice.step_mm, values)


def tissue_shares(
    vertices: Float[np.ndarray, "v 3"], growths: list[Growth], step_mm: float
) -> Float[np.ndarray, "v t"]:
    """How far each vertex belongs to growths of each tissue, 0 to 1, [V, len(TISSUES)]."""
    shares = np.zeros((len(vertices), len(TISSUES)), dtype=np.float32)
    for growth in growths:
        margin = growth.radius_mm + growth.foot_mm + 3 * step_mm
        near = (
            (vertices > growth.line.min(axis=0) - margin) & (vertices < growth.line.max(axis=0) + margin)
        ).all(axis=1)
        index = np.flatnonzero(near)
        if not len(index):
            continue
        distance = growth.distance(vertices[index])
        if growth.tissue == "hollow":
            # Its ground: what lies on the hollow's own surface.
            distance = np.abs(distance)
            soft = 0.4 * growth.radius_mm
        else:
            soft = 0.7 * step_mm if growth.tissue == "metal" else max(0.5 * growth.foot_mm, step_mm)
        column = TISSUES.index(growth.tissue)
        share = np.clip(1 - (distance - 0.3 * step_mm) / soft, 0, 1)
        shares[index, column] = np.maximum(shares[index, column], share)
    return shares
