"""Materials painted on square tiles: mucosa in many states, and what lies on it.

Each painter returns reflectance (3), wetness, height in mm and noise for edges, [S, S, 6].
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.noise import tile_noise
from data_catalog.cavities.palettes import Palette
from data_catalog.cavities.vessels import grown_vessels

__all__ = ["MATERIALS", "SIDE", "TEXEL_MM", "cells", "paint"]

SIDE = 1024
TEXEL_MM = 0.055
_MM = SIDE * TEXEL_MM
Painted = Float[np.ndarray, "s s 6"]


def paint(material: str, palette: Palette, rng: np.random.Generator) -> Painted:
    """A tile of a material in the colours of a scene."""
    return MATERIALS[material](palette, rng)


def mucosa(palette: Palette, rng: np.random.Generator, *, blood: float = 1.0) -> Painted:
    """Ordinary mucosa: blotches, mottling, vessels of three sizes, pits or villi."""
    density = _octaves(rng, (18, 8, 3.5), (0.6, 1.0, 1.0))
    mottle = _octaves(rng, (1.8, 0.9, 0.45, 0.22), (0.9, 1.0, 1.0, 0.9))
    grain = _octaves(rng, (0.22, 0.12), (1, 1))
    pale = np.clip(rng.uniform(0.15, 0.65) + 0.16 * density * rng.uniform(0.3, 1.6) + 0.06 * mottle, 0, 1)[
        ..., None
    ]
    albedo = (1 - pale) * palette.base + pale * palette.pale
    strength = rng.uniform(0.1, 1.0)
    # Blood varies at all scales: it takes more green and blue than red.
    haze = strength * (0.05 * density + 0.065 * mottle + 0.045 * grain * rng.uniform(0.2, 1.5))
    albedo = albedo * np.exp(haze[..., None] * (0.35 + 0.65 * palette.absorbed))
    arcades, twigs, net = (_vessels(rng, size) for size in ("arcades", "twigs", "net"))
    cover = np.clip(0.75 + 0.3 * density, 0.15, 1.2)
    shown = rng.uniform(0.0, 1.0, 3) ** np.array([0.8, 0.7, 0.9]) * blood
    absorbed = (1.1 * shown[0] * arcades + 0.9 * shown[1] * twigs + 0.8 * shown[2] * net) * cover
    albedo = albedo * np.exp(-np.clip(absorbed, 0, 1.6)[..., None] * palette.absorbed * 1.15)
    height = rng.uniform(0.2, 1.2) * (0.06 * _octaves(rng, (3.2, 1.6, 0.8), (1, 0.7, 0.4)) + 0.012 * mottle)
    height = height + 0.03 * rng.uniform(-0.3, 1) * arcades
    style = rng.choice(4, p=(0.35, 0.25, 0.2, 0.2))
    if style == 1:
        relief, _ = cells(rng, rng.uniform(0.4, 1.1))
        albedo = albedo * (
            1
            - 0.28
            * rng.uniform(0.2, 1)
            * np.clip(1.2 - 2 * relief, 0, 1)[..., None]
            * (0.4 + 0.6 * palette.absorbed)
        )
        height = height + rng.uniform(0.02, 0.09) * np.clip(relief, 0, 0.6)
    elif style == 2:
        villi = _octaves(rng, (0.55, 0.35), (1, 0.8))
        albedo = albedo * np.exp(0.10 * rng.uniform(0.3, 1) * villi[..., None])
        height = height + rng.uniform(0.02, 0.06) * villi
    elif style == 3:
        dots = np.clip(_octaves(rng, (0.6, 0.3), (1, 0.5)) - rng.uniform(1.2, 2.2), 0, 1)
        albedo = albedo * np.exp(-1.2 * dots[..., None] * palette.absorbed)
    wet = np.clip(0.6 + 0.35 * density * rng.uniform(0, 1) + 0.2 * mottle, 0.05, 1.4)
    return _packed(albedo, wet, height, rng)


def inflamed(palette: Palette, rng: np.random.Generator) -> Painted:
    """Red, swollen mucosa with points of blood, its vessels veiled."""
    red = Palette(
        palette.base * np.array([0.92, 0.55, 0.6], np.float32),
        palette.base,
        palette.absorbed,
        palette.narrow_band,
    )
    painted = mucosa(red, rng, blood=0.35)
    points = np.clip(_octaves(rng, (0.9, 0.5), (1, 0.6)) - 1.5, 0, 1)[..., None]
    painted[..., :3] *= np.exp(-1.5 * points * palette.absorbed)
    painted[..., 4] *= 1.6
    return painted


def pale(palette: Palette, rng: np.random.Generator) -> Painted:
    """Pale or scarred mucosa: whitish strands, few vessels."""
    light = Palette(
        palette.pale,
        np.clip(0.45 * palette.pale + 0.5, 0, 0.95).astype(np.float32),
        palette.absorbed,
        palette.narrow_band,
    )
    painted = mucosa(light, rng, blood=0.6)
    strands = np.exp(-np.square(tile_noise(rng, SIDE, int(_MM / 5), stretch=(1, 0.35)) / 0.35))
    painted[..., :3] = np.clip(painted[..., :3] * (1 + 0.25 * strands[..., None]), 0, 0.97)
    return painted


def ulcer(palette: Palette, rng: np.random.Generator) -> Painted:
    """A fibrin coat: white to yellow, matt, with streaks of blood."""
    coat = _octaves(rng, (4, 2, 0.9, 0.4), (1, 1, 0.7, 0.5))
    colour = palette.seen((0.80, 0.70, 0.44)) * np.exp(rng.normal(0, 0.1, 3)).astype(np.float32)
    albedo = colour * np.exp(0.12 * coat[..., None])
    blood = np.clip(_octaves(rng, (3, 1.2), (1, 0.7)) - 1.1, 0, 1)[..., None]
    albedo = albedo * np.exp(-1.8 * blood * palette.absorbed)
    return _packed(albedo, np.clip(0.35 + 0.2 * coat, 0.05, 1), 0.08 * coat, rng)


def residue(palette: Palette, rng: np.random.Generator) -> Painted:
    """Stool, bile or mucus: brown to yellow-green, lumpy or filmy, with bubbles in it."""
    base = palette.seen(
        ((0.34, 0.20, 0.05), (0.52, 0.38, 0.08), (0.42, 0.42, 0.10), (0.70, 0.68, 0.55))[int(rng.integers(4))]
    )
    lumps = _octaves(rng, (3, 1.4, 0.7, 0.3), (1, 1, 0.8, 0.5))
    albedo = base * np.exp(rng.uniform(0.1, 0.4) * lumps[..., None])
    height = rng.uniform(0.03, 0.3) * lumps
    wet = np.clip(0.7 + 0.3 * lumps, 0.1, 1.5)
    if rng.random() < 0.5:
        albedo, height, wet = _with_bubbles(albedo, height, wet, rng)
    return _packed(albedo, wet, height, rng)


def foam(palette: Palette, rng: np.random.Generator) -> Painted:
    """Bubbles on mucosa."""
    painted = mucosa(palette, rng)
    albedo, height, wet = _with_bubbles(painted[..., :3], painted[..., 4], painted[..., 3], rng)
    return _packed(albedo, wet, height, rng)


def fat(palette: Palette, rng: np.random.Generator) -> Painted:
    """Yellow lobules with fine vessels between them."""
    relief, tone = cells(rng, rng.uniform(2.0, 5.0))
    fine, _ = cells(rng, rng.uniform(0.7, 1.4))
    colour = palette.seen((0.80, 0.60, 0.24)) * np.exp(rng.normal(0, 0.1, 3)).astype(np.float32)
    albedo = (
        colour
        * np.exp(0.12 * tone[..., None])
        * (0.86 + 0.2 * relief[..., None])
        * (0.94 + 0.1 * fine[..., None])
    )
    absorbed = np.clip(
        _vessels(rng, "twigs") * rng.uniform(0.2, 1) + _vessels(rng, "net") * rng.uniform(0, 0.6), 0, 1.3
    )
    redness = np.clip(_octaves(rng, (12, 5), (1, 1)) * 0.3 + rng.uniform(-0.3, 0.3), 0, 0.6)
    albedo = albedo * np.exp(-(absorbed + redness)[..., None] * palette.absorbed)
    height = 0.35 * np.clip(relief, 0, 0.7) + 0.08 * np.clip(fine, 0, 0.7)
    return _packed(albedo, np.clip(0.7 + 0.3 * relief, 0.1, 1.3), height, rng)


def serosa(palette: Palette, rng: np.random.Generator) -> Painted:
    """The smooth outside of bowel and wall: pale pink, clear vessels that run across."""
    light = Palette(0.5 * (palette.base + palette.pale), palette.pale, palette.absorbed, palette.narrow_band)
    painted = mucosa(light, rng, blood=0.8)
    fibres = tile_noise(rng, SIDE, int(_MM / 0.7), stretch=(1, 0.08)) + tile_noise(
        rng, SIDE, int(_MM / 2), stretch=(1, 0.15)
    )
    painted[..., :3] *= np.exp(0.05 * rng.uniform(0.2, 1.5) * fibres[..., None])
    painted[..., 4] = 0.6 * painted[..., 4] + 0.012 * fibres
    return painted


def blood(palette: Palette, rng: np.random.Generator) -> Painted:
    """Blood that lies on tissue: dark, smooth and shining."""
    clots = _octaves(rng, (6, 2.5, 1), (1, 0.7, 0.4))
    albedo = palette.seen((0.30, 0.025, 0.02)) * np.exp(0.25 * clots[..., None])
    return _packed(albedo, np.clip(1.2 + 0.2 * clots, 0.6, 1.6), 0.04 * clots, rng)


def char(palette: Palette, rng: np.random.Generator) -> Painted:
    """Coagulated tissue: black, brown and yellow."""
    burnt = _octaves(rng, (2.5, 1, 0.4, 0.2), (1, 1, 0.8, 0.7))
    share = 1 / (1 + np.exp(-2.2 * (burnt + rng.uniform(-0.8, 0.8))))[..., None]
    albedo = share * palette.seen((0.07, 0.045, 0.03)) + (1 - share) * palette.seen((0.52, 0.36, 0.16))
    return _packed(albedo, np.clip(0.3 - 0.15 * burnt, 0.02, 0.7), 0.12 * burnt, rng)


def cartilage(palette: Palette, rng: np.random.Generator) -> Painted:
    """White, smooth, with faint fibres and frayed places."""
    fibres = sum(tile_noise(rng, SIDE, int(_MM / size), stretch=(1, 0.12)) for size in (3.0, 1.2, 0.5))
    frayed = np.clip(_octaves(rng, (7, 3), (1, 0.6)) - rng.uniform(0.2, 1.8), 0, 1)
    fine = _octaves(rng, (0.6, 0.3, 0.15), (1, 1, 0.8))
    tone = _octaves(rng, (15, 6), (1, 0.6))
    albedo = palette.pale * np.exp(
        0.05 * tone[..., None] + 0.02 * fibres[..., None] + (0.1 * frayed * fine)[..., None]
    )
    albedo = albedo * np.exp(
        -rng.uniform(0, 0.5) * np.clip(_vessels(rng, "twigs") * tone, 0, 1)[..., None] * palette.absorbed
    )
    return _packed(
        albedo, np.clip(0.8 - 0.4 * frayed, 0.1, 1.2), 0.004 * fibres + 0.1 * frayed * fine + 0.02 * tone, rng
    )


def metal(palette: Palette, rng: np.random.Generator) -> Painted:
    """Steel or black coating, brushed, with smears."""
    brushed = tile_noise(rng, SIDE, int(_MM / 0.3), stretch=(1, 0.05))
    smear = _octaves(rng, (6, 2.5), (1, 0.6))
    shade = rng.choice([0.05, 0.16, 0.32])
    albedo = (
        shade * np.exp(0.08 * brushed + 0.15 * smear)[..., None] * np.array([1.0, 0.97, 0.95], np.float32)
    )
    return _packed(albedo, np.clip(2.2 + 0.3 * smear, 1.0, 3.0), 0.0015 * brushed, rng)


MATERIALS = {
    "mucosa": mucosa,
    "inflamed": inflamed,
    "pale": pale,
    "ulcer": ulcer,
    "residue": residue,
    "foam": foam,
    "fat": fat,
    "serosa": serosa,
    "blood": blood,
    "char": char,
    "cartilage": cartilage,
    "metal": metal,
}


def cells(
    rng: np.random.Generator, size_mm: float
) -> tuple[Float[np.ndarray, "s s"], Float[np.ndarray, "s s"]]:
    """Cells round random points that tile: height (0 on the borders, about one inside), and a tone per cell.

    Args:
        rng: source of randomness.
        size_mm: distance from cell to cell.
    """
    import cv2

    count = max(4, round((_MM / size_mm) ** 2))
    margin = min(SIDE // 2, int(4 * size_mm / TEXEL_MM) + 4)
    seeds = rng.integers(0, SIDE, (count, 2))
    image = np.full((SIDE, SIDE), 255, dtype=np.uint8)
    image[seeds[:, 0], seeds[:, 1]] = 0
    padded = np.pad(image, margin, mode="wrap")
    distance, labels = cv2.distanceTransformWithLabels(padded, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    border = (cv2.Laplacian(labels.astype(np.float32), cv2.CV_32F, ksize=1) == 0).astype(np.uint8)
    inner = cv2.distanceTransform(border, cv2.DIST_L2, 5)
    inside = slice(margin, margin + SIDE)
    height = inner[inside, inside] / (0.32 * size_mm / TEXEL_MM)
    # Labels number the padded image; the tone must be that of the seed on the square.
    where = np.argwhere(padded == 0)
    tones = rng.standard_normal((SIDE, SIDE)).astype(np.float32)
    of_label = np.zeros(labels.max() + 1, dtype=np.float32)
    of_label[labels[where[:, 0], where[:, 1]]] = tones[
        (where[:, 0] - margin) % SIDE, (where[:, 1] - margin) % SIDE
    ]
    del distance
    return np.tanh(height).astype(np.float32), of_label[labels[inside, inside]]


def _octaves(
    rng: np.random.Generator, sizes_mm: tuple[float, ...], weights: tuple[float, ...]
) -> Float[np.ndarray, "s s"]:
    total = sum(
        w * tile_noise(rng, SIDE, int(2 * _MM / size)) for size, w in zip(sizes_mm, weights, strict=True)
    )
    return np.asarray(total / np.sqrt(np.square(weights).sum()), dtype=np.float32)


def _vessels(rng: np.random.Generator, size: str) -> Float[np.ndarray, "s s"]:
    trees, width, step, tortuosity = {
        "arcades": (int(rng.integers(2, 7)), rng.uniform(0.5, 1.3), 1.1, rng.uniform(0.1, 0.3)),
        "twigs": (int(rng.integers(8, 40)), rng.uniform(0.2, 0.42), 0.55, rng.uniform(0.15, 0.5)),
        "net": (int(rng.integers(60, 300)), rng.uniform(0.09, 0.17), 0.24, rng.uniform(0.2, 0.7)),
    }[size]
    return grown_vessels(
        rng,
        SIDE,
        trees=trees,
        width_texels=width / TEXEL_MM,
        step_texels=step / TEXEL_MM,
        tortuosity=tortuosity,
    )


def _with_bubbles(
    albedo: Float[np.ndarray, "s s 3"],
    height: Float[np.ndarray, "s s"],
    wet: Float[np.ndarray, "s s"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "s s 3"], Float[np.ndarray, "s s"], Float[np.ndarray, "s s"]]:
    """Bubbles: round, with a bright rim, each a small dome that shines."""
    albedo, height, wet = albedo.copy(), height.copy(), wet.copy()
    for _ in range(int(rng.integers(60, 500))):
        radius = float(np.clip(np.exp(rng.normal(1.9, 0.6)), 3, 36))
        row, column = rng.integers(0, SIDE, 2)
        reach = int(radius) + 2
        rows, columns = (
            np.arange(row - reach, row + reach + 1) % SIDE,
            np.arange(column - reach, column + reach + 1) % SIDE,
        )
        y, x = np.ogrid[-reach : reach + 1, -reach : reach + 1]
        rho = np.sqrt(x**2 + y**2) / radius
        dome = np.sqrt(np.clip(1 - rho**2, 0, 1)).astype(np.float32)
        rim = np.exp(-np.square((rho - 0.93) / 0.12)).astype(np.float32)
        block = np.ix_(rows, columns)
        albedo[block] = albedo[block] * (1 - 0.12 * (dome > 0)[..., None]) + 0.35 * rim[..., None] * (
            0.9 - albedo[block]
        )
        height[block] += 0.5 * radius * TEXEL_MM * dome
        wet[block] = np.where(dome > 0, 1.5, wet[block])
    return albedo, height, wet


def _packed(
    albedo: Float[np.ndarray, "s s 3"],
    wet: Float[np.ndarray, "s s"],
    height: Float[np.ndarray, "s s"],
    rng: np.random.Generator,
) -> Painted:
    edge = _octaves(rng, (5, 2, 0.9, 0.4), (1, 0.8, 0.6, 0.4))
    whole = np.concatenate(
        [np.clip(albedo, 0.01, 0.97), wet[..., None], height[..., None], edge[..., None]], axis=2
    )
    return np.asarray(whole, dtype=np.float32)
