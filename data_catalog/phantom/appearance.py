"""Mucosa of the phantom: colour, vessels and fine relief, painted on the wall's own coordinates.

The texture is an atlas over the wall's grid (`TEXELS_PER_CELL` texels per grid cell), sampled through a
pyramid of halved resolutions so that far walls do not flicker. Colours are linear, not sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_catalog.phantom.config import PhantomConfig, stream
from data_catalog.phantom.geometry import GRID_STEP_MM, Wall
from data_catalog.phantom.variation import vary

__all__ = ["TEXEL_MM", "Texture", "paint"]

TEXELS_PER_CELL = 4
TEXEL_MM = GRID_STEP_MM / TEXELS_PER_CELL
_LEVELS = 7

# Linear reflectance of well and of poorly perfused mucosa, of vessels and of polyps.
_MUCOSA_RED = (0.56, 0.175, 0.095)
_MUCOSA_PALE = (0.70, 0.325, 0.195)
_VESSEL_TINT = (0.62, 0.24, 0.27)
_POLYP_TINT = (1.06, 0.80, 0.78)

CHANNELS = 6
"""Albedo (3), slope of the relief along u and round the axis (2), wetness (1)."""


@dataclass(frozen=True)
class Texture:
    """A pyramid of atlases.

    Args:
        levels: arrays [rows, columns, 6], float32, each half the size of the one before.
    """

    levels: tuple[Float[np.ndarray, "_ _ 6"], ...]

    def sample(
        self,
        row: Float[np.ndarray, "n"],
        column: Float[np.ndarray, "n"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> Float[np.ndarray, "n 6"]:
        """Trilinear look-up at grid coordinates.

        Args:
            row: row of the wall's grid, real-valued.
            column: column of the wall's grid, real-valued, periodic.
            footprint_mm: side of the wall patch that one ray stands for.
        """
        level = np.clip(np.log2(np.maximum(footprint_mm, 1e-6) / TEXEL_MM), 0, len(self.levels) - 1)
        values = np.zeros((row.size, CHANNELS), dtype=np.float32)
        lower = np.minimum(level.astype(np.int64), len(self.levels) - 2)
        weight = (level - lower).astype(np.float32)
        for k, atlas in enumerate(self.levels):
            for chosen, share in ((lower == k, 1 - weight), (lower == k - 1, weight)):
                if chosen.any():
                    scale = TEXELS_PER_CELL / 2**k
                    found = bilinear(atlas, row[chosen] * scale - 0.5, column[chosen] * scale - 0.5)
                    values[chosen] += share[chosen, None] * found
        return values


def bilinear(
    atlas: Float[np.ndarray, "r c k"], row: Float[np.ndarray, "n"], column: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n k"]:
    """Values between array elements: rows are clamped, columns wrap round."""
    rows, columns = atlas.shape[:2]
    row = np.clip(row, 0, rows - 1)
    i = np.minimum(row.astype(np.int64), rows - 2)
    j_floor = np.floor(column)
    a = (row - i).astype(np.float32)[:, None]
    b = (column - j_floor).astype(np.float32)[:, None]
    j = j_floor.astype(np.int64) % columns
    j_next = (j + 1) % columns
    flat = atlas.reshape(rows * columns, -1)
    upper, lower = i * columns, (i + 1) * columns
    return np.asarray(
        (1 - a) * ((1 - b) * flat[upper + j] + b * flat[upper + j_next])
        + a * ((1 - b) * flat[lower + j] + b * flat[lower + j_next])
    )


def paint(config: PhantomConfig, wall: Wall) -> Texture:
    """The texture of a scene; depends on the scene's index only."""
    import cv2

    rng = stream(config.scene, "mucosa")
    variation = vary(config)
    rows = (wall.points.shape[0] - 1) * TEXELS_PER_CELL
    columns = wall.points.shape[1] * TEXELS_PER_CELL
    shape = (rows, columns)
    crest = _to_atlas(wall.crest, shape)
    bump = _to_atlas(wall.bump, shape)

    blotches = _noise(rng, shape, 22.0) + 0.6 * _noise(rng, shape, 9.0)
    mottling = _noise(rng, shape, 3.5) + 0.7 * _noise(rng, shape, 1.6)
    grain = _noise(rng, shape, 0.55)
    mottled = variation.mottling
    middle = 0.42 + variation.paleness
    paleness = np.clip(middle + 0.16 * mottled * blotches + 0.07 * mottled * mottling + 0.25 * crest, 0, 1)
    paleness = paleness[..., None]
    albedo = (1 - paleness) * np.array(_MUCOSA_RED, np.float32) + paleness * np.array(
        _MUCOSA_PALE, np.float32
    )
    albedo *= (1 + 0.05 * mottled * mottling + 0.03 * grain)[..., None]
    albedo *= np.array(variation.tint, np.float32)
    albedo *= 1 + bump[..., None] * (np.array(_POLYP_TINT, np.float32) - 1)

    coarse, fine = _vessels(config, shape)
    # Vessels shine through less where the wall is lifted into a fold or a polyp.
    cover = (1 - 0.45 * crest) * (1 - 0.7 * bump)
    density = np.clip((0.80 * coarse + 0.55 * fine * (1 - coarse)) * cover * variation.vessels, 0, 1)
    density = density * np.clip(0.85 + 0.25 * _noise(rng, shape, 7.0), 0.3, 1)
    albedo *= 1 + density[..., None] * (np.array(_VESSEL_TINT, np.float32) - 1)
    albedo = np.clip(albedo, 0.02, 0.95)

    # Relief in mm: soft bumps, fine pits, and vessels slightly raised. It bends normals only.
    relief = 0.055 * _noise(rng, shape, 2.6) + 0.020 * _noise(rng, shape, 1.0) + 0.004 * grain
    relief = variation.relief * (relief + 0.03 * coarse)
    relief = cv2.GaussianBlur(_wrapped(relief.astype(np.float32), 8), (0, 0), 0.8)[8:-8, 8:-8]
    slope_u = np.gradient(relief, TEXEL_MM, axis=0)
    slope_x = (np.roll(relief, -1, axis=1) - np.roll(relief, 1, axis=1)) / (2 * TEXEL_MM)
    wetness = np.clip(0.55 + 0.45 * _noise(rng, shape, 6.0) + 0.2 * _noise(rng, shape, 1.5), 0.05, 1.3)

    atlas = np.concatenate(
        [albedo, slope_u[..., None], slope_x[..., None], wetness[..., None]], axis=2, dtype=np.float32
    )
    levels = [np.ascontiguousarray(atlas)]
    for _ in range(_LEVELS - 1):
        height, width = levels[-1].shape[:2]
        # Not exactly a half for odd sizes; the look-up scales by the nominal half, and the
        # difference (one texel over the whole atlas) is far below what these levels resolve.
        size = (max(2, (width + 1) // 2), max(2, (height + 1) // 2))
        halves = [  # OpenCV takes at most four channels
            cv2.resize(np.ascontiguousarray(levels[-1][..., part]), size, interpolation=cv2.INTER_AREA)
            for part in (slice(0, 3), slice(3, 6))
        ]
        levels.append(np.concatenate(halves, axis=2))
    return Texture(tuple(levels))


def _to_atlas(grid: Float[np.ndarray, "u t"], shape: tuple[int, int]) -> Float[np.ndarray, "r c"]:
    """Upsample a grid quantity to texel centres."""
    row = (np.arange(shape[0]) + 0.5) / TEXELS_PER_CELL
    column = (np.arange(shape[1]) + 0.5) / TEXELS_PER_CELL
    rows, columns = (part.ravel() for part in np.meshgrid(row, column, indexing="ij"))
    return bilinear(grid[..., None].astype(np.float32), rows, columns).reshape(shape)


def _wrapped(array: Float[np.ndarray, "r c"], margin: int) -> Float[np.ndarray, "r2 c2"]:
    """Pad: rows by their edge, columns by wrapping round."""
    array = np.pad(array, ((margin, margin), (0, 0)), mode="edge")
    return np.pad(array, ((0, 0), (margin, margin)), mode="wrap")


def _noise(
    rng: np.random.Generator, shape: tuple[int, int], wavelength_mm: float
) -> Float[np.ndarray, "r c"]:
    """Smooth noise of unit variance and one scale, periodic round the axis."""
    import cv2

    cells = (
        int(np.ceil(shape[0] * TEXEL_MM / (0.5 * wavelength_mm))) + 4,
        max(4, round(shape[1] * TEXEL_MM / (0.5 * wavelength_mm))),
    )
    lattice = rng.standard_normal(cells).astype(np.float32)
    lattice = cv2.GaussianBlur(_wrapped(lattice, 4), (0, 0), 0.9)[4:-4, 4:-4]
    margin = 4
    padded = np.pad(lattice, ((0, 0), (margin, margin)), mode="wrap")
    scale = shape[1] / cells[1]
    width = round((cells[1] + 2 * margin) * scale)
    height = max(shape[0], round(cells[0] * scale))
    large = cv2.resize(padded, (width, height), interpolation=cv2.INTER_CUBIC)
    left = round(margin * scale)
    field = large[: shape[0], left : left + shape[1]]
    return np.asarray((field - field.mean()) / field.std(), dtype=np.float32)


def _vessels(
    config: PhantomConfig, shape: tuple[int, int]
) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
    """Coverage by arcades (0.3 to 1 mm wide) and by the fine net between them, each 0 to 1."""
    rng = stream(config.scene, "vessels")
    size_mm = (shape[0] * TEXEL_MM, shape[1] * TEXEL_MM)
    area = size_mm[0] * size_mm[1]
    arcades = _grow(rng, size_mm, int(area / 1300), width_range=(0.5, 0.9), step_mm=0.7)
    net = _grow(rng, size_mm, int(area / 75), width_range=(0.17, 0.32), step_mm=0.45)
    return _draw(arcades, shape, 0.7), _draw(net, shape, 0.5)


_MAX_STEPS = 24
_GENERATIONS = 14
_FORK_SHARE = 0.72

Vessels = list[tuple[Float[np.ndarray, "_ k 2"], Float[np.ndarray, "_"]]]


def _grow(
    rng: np.random.Generator,
    size_mm: tuple[float, float],
    trees: int,
    *,
    width_range: tuple[float, float],
    step_mm: float,
) -> Vessels:
    """Random branching growth, generation by generation.

    A vessel wanders with a swinging heading, then forks into two (Murray's law: the cubes of the
    children's widths add up to the parent's) or goes on thinner, until it is too thin.

    Returns:
        Per generation: polylines (u, x) in mm, [N, K, 2], and their widths in mm, [N].
    """
    point = np.stack([rng.uniform(0, size_mm[0], trees), rng.uniform(0, size_mm[1], trees)], axis=1)
    heading = rng.uniform(0, 2 * np.pi, trees)
    width = rng.uniform(*width_range, trees)
    generations: Vessels = []
    for _ in range(_GENERATIONS):
        count = len(point)
        if not count:
            break
        steps = rng.integers(5, _MAX_STEPS + 1, count)
        swing = np.zeros(count)
        track = np.empty((count, _MAX_STEPS + 1, 2))
        track[:, 0] = point
        for k in range(_MAX_STEPS):
            going = k < steps
            swing = 0.75 * swing + rng.normal(0, 0.13, count)
            heading = heading + swing * going
            move = step_mm * np.stack([np.sin(heading), np.cos(heading)], axis=1)
            track[:, k + 1] = track[:, k] + move * going[:, None]
        generations.append((track, width))
        end = track[:, -1]
        forks = rng.uniform(size=count) < _FORK_SHARE
        share = rng.uniform(0.25, 0.75, count)
        angle = rng.uniform(0.35, 0.9, count) * np.where(rng.uniform(size=count) < 0.5, 1, -1)
        first_width = np.where(forks, width * np.cbrt(1 - share), 0.85 * width)
        second_width = width * np.cbrt(share)
        first, second = first_width > 0.5 * width_range[0], forks & (second_width > 0.5 * width_range[0])
        point = np.concatenate([end[first], end[second]])
        heading = np.concatenate([(heading - 0.4 * angle * forks)[first], (heading + angle)[second]])
        width = np.concatenate([first_width[first], second_width[second]])
    return generations


def _draw(vessels: Vessels, shape: tuple[int, int], softness: float) -> Float[np.ndarray, "r c"]:
    """Coverage, 0 to 1, on the atlas; columns wrap round."""
    import cv2

    fraction_bits = 4
    # Wider than the longest polyline: what sticks out is folded back on the other side.
    margin = 192
    by_thickness: dict[int, list[Float[np.ndarray, "_ k 2"]]] = {}
    for tracks, widths in vessels:
        thicknesses = np.maximum(1, np.round(widths / TEXEL_MM)).astype(int)
        for value in np.unique(thicknesses):
            by_thickness.setdefault(int(value), []).append(tracks[thicknesses == value])
    empty = np.ones(shape, dtype=np.float32)
    for thickness, groups in sorted(by_thickness.items()):
        texels = np.concatenate(groups) / TEXEL_MM
        start = texels[:, :1, 1]
        x = texels[..., 1] - np.floor(start / shape[1]) * shape[1] + margin
        lines = np.round(np.stack([x, texels[..., 0]], axis=2) * 2**fraction_bits).astype(np.int32)
        layer = np.zeros((shape[0], shape[1] + 2 * margin), dtype=np.uint8)
        cv2.polylines(layer, list(lines), False, 255, thickness, cv2.LINE_AA, fraction_bits)
        inside = layer[:, margin:-margin]
        np.maximum(inside[:, -margin:], layer[:, :margin], out=inside[:, -margin:])
        np.maximum(inside[:, :margin], layer[:, -margin:], out=inside[:, :margin])
        padded = np.pad(inside, ((0, 0), (8, 8)), mode="wrap").astype(np.float32) / 255
        blurred = cv2.GaussianBlur(padded, (0, 0), softness * (0.6 + 0.25 * thickness))[:, 8:-8]
        empty *= 1 - np.clip(blurred * 1.15, 0, 1)
    return np.asarray(1 - empty)
