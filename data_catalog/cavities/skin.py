"""What a wall looks like at a point: materials laid over each other, softly and with ragged borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.canvas import TEXEL_MM
from data_catalog.cavities.growths import TISSUES, Growth, tissue_shares
from data_catalog.cavities.materials import paint
from data_catalog.cavities.noise import SolidNoise
from data_catalog.cavities.palettes import draw_palette
from data_catalog.cavities.shapes import Kind
from data_catalog.cavities.surface import Wall, unit
from data_catalog.cavities.tiles import Tile, lay

__all__ = ["Skin", "SkinValues", "make_skin"]

_ORDINARY: dict[Kind, str] = {"joint": "cartilage", "field": "serosa"}
# What lies over the ordinary mucosa in patches, and how often.
_PATCHES: dict[Kind, dict[str, float]] = {
    "colon": {"inflamed": 0.4, "pale": 0.4, "ulcer": 0.25, "residue": 0.45, "foam": 0.2, "blood": 0.1},
    "sac": {"inflamed": 0.5, "pale": 0.4, "ulcer": 0.25, "residue": 0.25, "foam": 0.3, "blood": 0.15},
    "oesophagus": {"inflamed": 0.5, "pale": 0.5, "ulcer": 0.25, "residue": 0.2, "foam": 0.35},
    "airways": {"inflamed": 0.45, "pale": 0.6, "residue": 0.25, "foam": 0.25, "blood": 0.1},
    "sinus": {"inflamed": 0.5, "pale": 0.5, "residue": 0.3, "blood": 0.2},
    "joint": {"mucosa": 0.7, "inflamed": 0.3, "pale": 0.2, "fat": 0.2},
    "bladder": {"inflamed": 0.4, "pale": 0.4, "foam": 0.15, "blood": 0.15, "ulcer": 0.1},
    "field": {"mucosa": 0.6, "fat": 0.5, "blood": 0.4, "char": 0.3, "inflamed": 0.3, "pale": 0.3},
}
_MOST_PATCHES = 3
_GROUND_SIDE, _PATCH_SIDE = 1024, 512
_DETAIL_SCALE = 5.3


@dataclass(frozen=True)
class SkinValues:
    """The wall at N points.

    Args:
        albedo: linear reflectance, [N, 3].
        normal: unit normals bent by the relief, [N, 3].
        wetness: multiplies the gloss, [N].
        slope_variance: of relief too fine to be seen, [N].
    """

    albedo: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    wetness: Float[np.ndarray, "n"]
    slope_variance: Float[np.ndarray, "n"]


@dataclass(frozen=True)
class _Layer:
    tile: Tile
    axes: Float[np.ndarray, "3 3"]
    column: int
    """Of the vertex values: where it lies. Below zero: everywhere."""
    threshold: float
    softness: float
    raggedness: float
    rim: float


@dataclass(frozen=True)
class Skin:
    """The materials of one wall.

    Args:
        layers: from the ground up.
        at_vertices: slow values at the wall's vertices: shift of the pattern (3), brightness (1), redness
            (1), share of each tissue, and where each patch lies.
        absorbed: what blood takes from red, green and blue.
        relief: factor of all heights.
        detail: strength of what is finer than the tiles.
        pattern_scale: factor of all patterns' size; narrow cavities have finer ones.
    """

    layers: tuple[_Layer, ...]
    at_vertices: Float[np.ndarray, "v c"]
    absorbed: Float[np.ndarray, "3"]
    relief: float
    detail: float
    pattern_scale: float

    def at(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        slow: Float[np.ndarray, "n c"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> SkinValues:
        """The skin at points of the wall.

        Args:
            points: in mm.
            normals: unit normals there.
            slow: `at_vertices`, interpolated.
            footprint_mm: side of the patch that one ray stands for.
        """
        places = (points + slow[:, :3]) / np.float32(self.pattern_scale)
        footprint_mm = footprint_mm / np.float32(self.pattern_scale)
        values, gradient = lay(self.layers[0].tile, places, normals, footprint_mm, self.layers[0].axes)
        edge = values[:, 7].copy()
        for layer in self.layers[1:]:
            # Tissue has its own outline; patches fray.
            level = slow[:, layer.column] + layer.raggedness * edge - layer.threshold
            share = 1 / (1 + np.exp(-np.clip(level / layer.softness, -30, 30)))
            chosen = np.flatnonzero(share > 0.02)
            if not len(chosen):
                continue
            found, slope = lay(layer.tile, places[chosen], normals[chosen], footprint_mm[chosen], layer.axes)
            weight = share[chosen, None].astype(np.float32)
            if layer.rim > 0:
                around = np.clip(4 * weight * (1 - weight), 0, 1) * layer.rim
                values[chosen, :3] *= np.exp(-around * self.absorbed)
            values[chosen] += weight * (found - values[chosen])
            gradient[chosen] += weight * (slope - gradient[chosen])
        tone = np.exp(slow[:, 3:4] - np.clip(slow[:, 4:5], -0.5, 1.5) * self.absorbed)
        albedo = (
            values[:, :3] * tone * np.exp(self.detail * self._fine(places, normals, footprint_mm))[:, None]
        )
        gradient = self.relief * gradient
        lost = self.relief**2 * values[:, 6] - np.square(gradient).sum(axis=1)
        along = np.einsum("ij,ij->i", gradient, normals)[:, None]
        bent = unit(normals - (gradient - along * normals))
        return SkinValues(
            np.clip(albedo, 0.008, 0.96).astype(np.float32),
            bent,
            np.clip(values[:, 3], 0, 3),
            np.clip(lost, 0, 1).astype(np.float32),
        )

    def _fine(
        self,
        places: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> Float[np.ndarray, "n"]:
        """Noise where the lens is so near that texels would show."""
        fine = np.zeros(len(places), dtype=np.float32)
        fade = np.clip(1.5 - footprint_mm / TEXEL_MM, 0, 1)
        near = np.flatnonzero(fade > 0)
        if len(near):
            ground = self.layers[0]
            found, _ = lay(
                ground.tile,
                places[near] * _DETAIL_SCALE,
                normals[near],
                footprint_mm[near] * _DETAIL_SCALE,
                ground.axes,
            )
            fine[near] = fade[near] * found[:, 7]
        return fine


def make_skin(
    kind: Kind,
    wall: Wall,
    growths: list[Growth],
    step_mm: float,
    rng: np.random.Generator,
    radius_mm: float,
    photograph: Float[np.ndarray, "s s 6"] | None = None,
    *,
    patches: bool = True,
) -> Skin:
    """The skin of a wall, drawn.

    Args:
        kind: of the cavity.
        wall: with its growths.
        growths: which are of tissue of their own.
        step_mm: of the lattice that the wall was contoured on.
        rng: source of randomness.
        radius_mm: typical radius of the cavity.
        photograph: a tile made of a real frame, which takes the place of the ordinary tissue.
        patches: whether something may lie over the ordinary tissue in places.
    """
    palette = draw_palette(kind, rng)
    size = 0.6 if kind in ("airways", "oesophagus", "joint", "sinus") else 1.0
    columns = [SolidNoise.random(rng, 70.0, 22.0)(wall.vertices) for _ in range(3)]
    columns.append(rng.uniform(0.03, 0.16) * SolidNoise.random(rng, 90.0 * size, 18.0 * size)(wall.vertices))
    columns.append(rng.uniform(0.0, 0.3) * SolidNoise.random(rng, 70.0 * size, 9.0 * size)(wall.vertices))
    shares = tissue_shares(wall.vertices, growths, step_mm)
    columns += list(shares.T)
    ordinary = _ORDINARY.get(kind, "mucosa")
    ground = paint(ordinary, palette, rng, _GROUND_SIDE)
    if photograph is not None:
        # It was taken in white light, which is not the light of every scene.
        ground = np.concatenate([palette.seen(photograph[..., :3]), photograph[..., 3:]], axis=2)
    layers = [_layer(ground, rng, -1, 0.0, 1.0, 0.0, 0.0)]
    found = [name for name, share in _PATCHES[kind].items() if patches and rng.random() < share]
    rng.shuffle(found)
    for name in found[:_MOST_PATCHES]:
        field = SolidNoise.random(rng, rng.uniform(25.0, 80.0) * size, rng.uniform(6, 14) * size)(
            wall.vertices
        )
        sharp = name in ("residue", "blood", "ulcer", "fat", "char")
        threshold = rng.uniform(1.3, 2.4) if sharp else rng.uniform(0.2, 1.8)
        softness = rng.uniform(0.04, 0.2) if sharp else rng.uniform(0.08, 0.5)
        rim = rng.uniform(0.2, 0.9) if name == "ulcer" else 0.0
        layers.append(
            _layer(
                paint(name, palette, rng, _PATCH_SIDE),
                rng,
                len(columns),
                threshold,
                softness,
                rng.uniform(0.2, 0.5),
                rim,
            )
        )
        columns.append(field)
    for column, tissue in enumerate(TISSUES):
        if not (shares[:, column] > 0.5).any():
            continue
        name = _tissue_material(tissue, kind, rng)
        own = palette if rng.random() < 0.6 else draw_palette(kind, rng)
        if palette.narrow_band:
            own = palette
        ragged = 0.0 if tissue == "metal" else 0.12
        soft = 0.03 if tissue == "metal" else rng.uniform(0.04, 0.15)
        layers.append(_layer(paint(name, own, rng, _PATCH_SIDE), rng, 5 + column, 0.5, soft, ragged, 0.0))
    return Skin(
        tuple(layers),
        np.stack(columns, axis=1).astype(np.float32),
        palette.absorbed,
        float(rng.uniform(0.4, 1.4)),
        float(rng.uniform(0.02, 0.08)),
        float(np.clip(radius_mm / 18, 0.4, 1.3) * rng.uniform(0.7, 1.2)),
    )


def _tissue_material(tissue: str, kind: Kind, rng: np.random.Generator) -> str:
    if tissue == "lump":
        return str(rng.choice(["inflamed", "mucosa", "pale"])) if kind != "joint" else "pale"
    return {
        "hollow": "residue" if rng.random() < 0.5 else "inflamed",
        "fat": "fat",
        "bowel": "serosa",
        "metal": "metal",
    }[tissue]


def _layer(
    painted: Float[np.ndarray, "s s 6"],
    rng: np.random.Generator,
    column: int,
    threshold: float,
    softness: float,
    raggedness: float,
    rim: float,
) -> _Layer:
    axes, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return _Layer(
        Tile.of(painted, TEXEL_MM), axes.astype(np.float32), column, threshold, softness, raggedness, rim
    )
