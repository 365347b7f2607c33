r"""Texture of a cavern's wall: cells round points of the wall, with vessels between them and in spirals.

For a point of the wall, :math:`F_1` and :math:`F_2` are its distances to the nearest and the second nearest
feature point. Cells have tones of their own; along their borders, where :math:`F_2 - F_1` is small, runs a
net of vessels; about some of the larger cells' points vessels wind in logarithmic spirals.

Source: Worley, "A cellular texture basis function", SIGGRAPH 1996.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from data_catalog.caverns.config import stream
from data_catalog.cavities.skin import SkinValues
from data_catalog.cavities.surface import Wall, unit

__all__ = ["CellTexture", "make_texture"]

# Pairs of linear reflectance that cells mix, and what runs between them.
_TONES = (
    ((0.66, 0.26, 0.16), (0.50, 0.14, 0.08)),
    ((0.74, 0.40, 0.26), (0.60, 0.24, 0.15)),
    ((0.58, 0.18, 0.13), (0.70, 0.34, 0.25)),
    ((0.72, 0.44, 0.20), (0.58, 0.26, 0.12)),
    ((0.50, 0.12, 0.07), (0.62, 0.24, 0.15)),
)
_BLOOD = np.array([0.35, 1.05, 0.85], dtype=np.float32)
_SMALL_MM, _LARGE_MM = (1.6, 3.6), (9.0, 16.0)
_GRAIN_MM = (0.9, 0.4, 0.18)


@dataclass(frozen=True)
class _Cells:
    """Feature points with a random number, a normal and two tangents each."""

    tree: Any
    tone: Float[np.ndarray, "s"]
    normals: Float[np.ndarray, "s 3"]
    tangents: Float[np.ndarray, "s 2 3"]
    size_mm: float

    @classmethod
    def of(cls, rng: np.random.Generator, wall: Wall, size_mm: float) -> _Cells:
        from scipy.spatial import cKDTree

        corner = wall.vertices[wall.triangles]
        double_area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.sqrt(np.square(double_area.astype(np.float64)).sum(axis=1))
        count = max(8, round(float(area.sum()) / 2 / size_mm**2))
        triangle = rng.choice(len(area), count, p=area / area.sum())
        points = corner[triangle].mean(axis=1) + 0.2 * size_mm * rng.standard_normal((count, 3))
        normals = wall.normals[wall.triangles[triangle, 0]]
        first = unit(np.cross(normals, rng.standard_normal((count, 3))))
        tangents = np.stack([first, unit(np.cross(normals, first))], axis=1)
        tone = rng.standard_normal(count).astype(np.float32)
        return cls(cKDTree(points), tone, normals.astype(np.float32), tangents, size_mm)

    def nearest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, "n 2"]]:
        """Distances to the two nearest feature points, in mm, and which they are."""
        distance, index = self.tree.query(points, k=2, workers=1)
        return distance.astype(np.float32), index


@dataclass(frozen=True)
class CellTexture:
    """A cavern's texture.

    Args:
        small: cells whose borders are the net.
        large: cells of tone, about some of which vessels wind.
        tones: two reflectances, [2, 3].
        net: strength of the net of vessels.
        net_width_mm: half its width.
        winding: which large cells have spirals.
        arms: of a spiral.
        pitch: how fast it winds.
        bump: slope of the small cells' domes.
        grain: strength of the finest mottling.
        wetness: factor of the gloss.
        lattice: random numbers of the mottling, [16, 16, 16].
        at_vertices: nothing is interpolated between vertices, [V, 0].
    """

    small: _Cells
    large: _Cells
    tones: Float[np.ndarray, "2 3"]
    net: float
    net_width_mm: float
    winding: Bool[np.ndarray, "s"]
    arms: int
    pitch: float
    bump: float
    grain: float
    wetness: float
    lattice: Float[np.ndarray, "16 16 16"]
    at_vertices: Float[np.ndarray, "v 0"]

    def at(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        slow: Float[np.ndarray, "n 0"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> SkinValues:
        """The wall at points.

        Args:
            points: in mm.
            normals: unit normals there.
            slow: nothing.
            footprint_mm: side of the patch that one ray stands for.
        """
        near, which = self.small.nearest(points)
        far, patch = self.large.nearest(points)
        # Tones go over into each other at the borders of the large cells.
        beside = 0.5 + 0.5 * np.clip((far[:, 1] - far[:, 0]) / 2.5, 0, 1)
        tone = beside * self.large.tone[patch[:, 0]] + (1 - beside) * self.large.tone[patch[:, 1]]
        visible = np.clip(1.4 - footprint_mm / (0.6 * self.small.size_mm), 0, 1)
        tone = 0.5 + 0.28 * tone + 0.10 * visible * self.small.tone[which[:, 0]]
        mixed = np.clip(tone, 0, 1)[:, None]
        albedo = mixed * self.tones[0] + (1 - mixed) * self.tones[1]
        mottle = np.zeros(len(points), dtype=np.float32)
        for size in _GRAIN_MM:
            mottle += np.clip(1.5 - 1.5 * footprint_mm / size, 0, 1) * self._value_noise(
                points / np.float32(size)
            )
        # Where F2 - F1 is small the border is half of it away.
        border = 0.5 * (near[:, 1] - near[:, 0])
        blood = self.net * _line(border, self.net_width_mm, footprint_mm)
        blood = np.maximum(blood, self._spirals(points, patch[:, 0], footprint_mm))
        albedo = albedo * np.exp(self.grain * mottle[:, None] - blood[:, None] * _BLOOD)
        toward = points - self.small.tree.data[which[:, 0]].astype(np.float32)
        toward -= (toward * normals).sum(axis=1)[:, None] * normals
        # Domes end softly, without a crease along the border.
        dome = self.bump * visible / self.small.size_mm * np.clip(4 * border / self.small.size_mm, 0, 1)
        slope = dome[:, None] * toward
        lost = np.square(self.bump) * 0.2 * (1 - visible)
        wet = np.full(len(points), self.wetness, dtype=np.float32)
        return SkinValues(
            np.clip(albedo, 0.01, 0.95).astype(np.float32),
            unit(normals + slope),
            wet,
            lost.astype(np.float32),
        )

    def _spirals(
        self,
        points: Float[np.ndarray, "n 3"],
        cell: Int[np.ndarray, "n"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> Float[np.ndarray, "n"]:
        blood = np.zeros(len(points), dtype=np.float32)
        chosen = np.flatnonzero(self.winding[cell])
        offset = points[chosen] - self.large.tree.data[cell[chosen]].astype(np.float32)
        x, y = np.einsum("nkj,nj->kn", self.large.tangents[cell[chosen]], offset)
        radius = np.maximum(np.sqrt(x**2 + y**2), 0.15)
        phase = self.arms * np.arctan2(y, x) + self.pitch * np.log(radius)
        # Along the radius an arm comes back after 2 pi r / pitch.
        away = np.abs(np.angle(np.exp(1j * phase))) * radius / np.hypot(self.arms, self.pitch)
        ends = np.clip(1.6 - radius / (0.42 * self.large.size_mm), 0, 1)
        width = 0.10 + 0.028 * radius
        blood[chosen] = 1.1 * ends * _line(away.astype(np.float32), width, footprint_mm[chosen])
        return blood

    def _value_noise(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Random numbers on a lattice, blended smoothly between its nodes; repeats after sixteen."""
        base = np.floor(places)
        share = (places - base).astype(np.float32)
        share = share * share * (3 - 2 * share)
        node = base.astype(np.int64)
        total = np.zeros(len(places), dtype=np.float32)
        for corner in range(8):
            step = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            i, j, k = ((node + step) % 16).T
            weight = np.where(step == 1, share, 1 - share).prod(axis=1)
            total += weight * self.lattice[i, j, k]
        return total


def make_texture(scene: int, wall: Wall) -> CellTexture:
    """The texture of a cavern's wall."""
    rng = stream(scene, "texture")
    first, second = _TONES[int(rng.integers(len(_TONES)))]
    tint = np.exp(rng.normal(0, 0.07, 3) * np.array([0.5, 1.0, 1.0]))
    large = _Cells.of(rng, wall, float(rng.uniform(*_LARGE_MM)))
    return CellTexture(
        small=_Cells.of(rng, wall, float(rng.uniform(*_SMALL_MM))),
        large=large,
        tones=(np.array([first, second]) * tint).astype(np.float32),
        net=float(rng.uniform(0.25, 0.9)),
        net_width_mm=float(rng.uniform(0.05, 0.12)),
        winding=rng.random(len(large.tone)) < rng.uniform(0.3, 0.7),
        arms=int(rng.integers(2, 5)),
        pitch=float(rng.uniform(3, 6) * rng.choice([-1, 1])),
        bump=float(rng.uniform(0.1, 0.5)),
        grain=float(rng.uniform(0.06, 0.16)),
        wetness=float(rng.uniform(0.6, 1.3)),
        lattice=rng.standard_normal((16, 16, 16)).astype(np.float32),
        at_vertices=np.zeros((len(wall.vertices), 0), dtype=np.float32),
    )


def _line(
    distance_mm: Float[np.ndarray, "n"],
    half_width_mm: float | Float[np.ndarray, "n"],
    footprint_mm: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n"]:
    """A line's profile, widened by the footprint and weakened as much, so that it never flickers."""
    wide = np.sqrt(np.square(half_width_mm) + np.square(0.6 * footprint_mm))
    return np.asarray(half_width_mm / wide * np.exp(-np.square(distance_mm / wide)), dtype=np.float32)
