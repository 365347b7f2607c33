"""Materials painted on square tiles: mucosa in many states, and what lies on it.

Each painter returns reflectance (3), wetness, height in mm and noise for edges, [S, S, 6].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.canvas import Canvas, VesselSize
from data_catalog.cavities.palettes import Palette

__all__ = ["MATERIALS", "paint"]

_VESSELS: tuple[tuple[VesselSize, float, float], ...] = (
    ("arcades", 0.6, 1.3),
    ("twigs", 0.65, 1.1),
    ("net", 0.5, 0.8),
)
"""Sizes of vessels, how often they show, and how much light they take at most."""
Material = Float[np.ndarray, "s s 6"]


def paint(material: str, palette: Palette, rng: np.random.Generator, side: int) -> Material:
    """A tile of a material in the colours of a scene, so many texels along its side."""
    return MATERIALS[material](Canvas(rng, side), palette)


def mucosa(canvas: Canvas, palette: Palette, *, blood: float = 1.0) -> Material:
    """Ordinary mucosa: blotches, mottling, vessels of three sizes, pits, villi or points."""
    rng = canvas.rng
    density = canvas.octaves((20.0, 9.0, 4.0), (0.6, 1.0, 1.0))
    mottle = canvas.octaves((1.8, 0.9, 0.45, 0.2), (1.0, 0.9, 0.8, 0.7))
    blotched, mottled = rng.uniform(0.2, 1.4), rng.uniform(0.0, 1.0) ** 1.5
    pale = np.clip(rng.uniform(0.1, 0.7) + 0.15 * blotched * density + 0.05 * mottled * mottle, 0, 1)[
        ..., None
    ]
    albedo = (1 - pale) * palette.base + pale * palette.pale
    # Blood varies at all scales: it takes more green and blue than red.
    haze = 0.05 * blotched * density + 0.09 * mottled * mottle
    albedo = albedo * np.exp(haze[..., None] * (0.3 + 0.7 * palette.absorbed))
    cover = np.clip(0.75 + 0.3 * density, 0.15, 1.2)
    absorbed = np.zeros_like(density)
    for size, often, most in _VESSELS:
        if rng.random() < often:
            shown = np.float32(most * rng.uniform(0.2, 1.0) * blood)
            absorbed = absorbed + shown * cover * canvas.vessels(size)
    albedo = albedo * np.exp(-np.clip(absorbed, 0, 1.4)[..., None] * palette.absorbed)
    height = canvas.octaves((4.0, 1.8, 0.8), (1.0, 0.45, 0.2)) + 0.03 * mottled * mottle + 0.3 * absorbed
    style = rng.choice(4, p=(0.4, 0.2, 0.2, 0.2))
    if style == 1:
        relief, _ = canvas.cells(rng.uniform(0.5, 1.3))
        groove = np.clip(1.1 - 2 * relief, 0, 1)[..., None]
        albedo = albedo * (1 - rng.uniform(0.05, 0.28) * groove * (0.4 + 0.6 * palette.absorbed))
        height = height + rng.uniform(0.1, 0.5) * relief
    elif style == 2:
        villi = canvas.octaves((0.7, 0.4), (1.0, 0.7))
        albedo = albedo * np.exp(rng.uniform(0.02, 0.09) * villi[..., None])
        height = height + rng.uniform(0.03, 0.15) * villi
    elif style == 3:
        points = np.clip(canvas.octaves((0.9, 0.4), (1.0, 0.4)) - rng.uniform(1.3, 2.2), 0, 1)
        albedo = albedo * np.exp(-1.1 * points[..., None] * palette.absorbed)
    wet = np.clip(0.75 + 0.3 * density * rng.uniform(0, 1) + 0.1 * mottle, 0.05, 1.5)
    return canvas.packed(albedo, wet, height, slope=rng.uniform(0.04, 0.22))


def inflamed(canvas: Canvas, palette: Palette) -> Material:
    """Red, swollen mucosa with points of blood, its vessels veiled."""
    red = palette.base * np.array([0.92, 0.58, 0.62], np.float32)
    painted = mucosa(canvas, Palette(red, palette.base, palette.absorbed, palette.narrow_band), blood=0.4)
    points = np.clip(canvas.octaves((0.9, 0.5), (1.0, 0.6)) - canvas.rng.uniform(1.3, 2.2), 0, 1)[..., None]
    painted[..., :3] *= np.exp(-1.3 * points * palette.absorbed)
    return painted


def pale(canvas: Canvas, palette: Palette) -> Material:
    """Pale or scarred mucosa: whitish strands, few vessels."""
    white = np.clip(0.5 * palette.pale + 0.42, 0, 0.92).astype(np.float32)
    painted = mucosa(canvas, Palette(palette.pale, white, palette.absorbed, palette.narrow_band), blood=0.6)
    strands = np.exp(-np.square(canvas.noise(9.0, stretch=(1.0, 0.35)) / 0.35)) * canvas.rng.uniform(0, 0.25)
    painted[..., :3] = np.clip(painted[..., :3] * (1 + strands[..., None]), 0, 0.97)
    return painted


def ulcer(canvas: Canvas, palette: Palette) -> Material:
    """A fibrin coat: white to yellow, matt, with streaks of blood."""
    rng = canvas.rng
    coat = canvas.octaves((4.0, 2.0, 0.9, 0.4), (1.0, 1.0, 0.6, 0.35))
    color = palette.seen((0.78, 0.68, 0.44)) * np.exp(rng.normal(0, 0.1, 3)).astype(np.float32)
    albedo = color * np.exp(0.12 * coat[..., None])
    blood = np.clip(canvas.octaves((3.0, 1.2), (1.0, 0.7)) - 1.3, 0, 1)[..., None]
    albedo = albedo * np.exp(-1.5 * blood * palette.absorbed)
    return canvas.packed(albedo, np.clip(0.4 + 0.2 * coat, 0.05, 1), coat, slope=rng.uniform(0.1, 0.3))


def residue(canvas: Canvas, palette: Palette) -> Material:
    """Stool, bile or mucus: brown to yellow-green, lumpy or filmy, with bubbles in it."""
    rng = canvas.rng
    colors = (
        (0.34, 0.20, 0.06),
        (0.50, 0.36, 0.10),
        (0.44, 0.40, 0.14),
        (0.70, 0.66, 0.52),
        (0.60, 0.42, 0.2),
    )
    base = palette.seen(colors[int(rng.integers(len(colors)))])
    lumps = canvas.octaves((4.0, 1.8, 0.8, 0.35), (1.0, 0.8, 0.5, 0.3))
    albedo = base * np.exp(rng.uniform(0.05, 0.3) * lumps[..., None])
    wet, height = np.clip(0.9 + 0.3 * lumps, 0.1, 1.5), 0.1 * rng.uniform(0.2, 1.0) * lumps
    if rng.random() < 0.5:
        albedo, wet, height = canvas.bubbles(albedo, wet, height)
    return canvas.packed(albedo, wet, height)


def foam(canvas: Canvas, palette: Palette) -> Material:
    """Bubbles on mucosa."""
    painted = mucosa(canvas, palette)
    return canvas.packed(*canvas.bubbles(painted[..., :3], painted[..., 3], painted[..., 4]))


def fat(canvas: Canvas, palette: Palette) -> Material:
    """Yellow lobules with fine vessels between them."""
    rng = canvas.rng
    relief, tone = canvas.cells(rng.uniform(2.0, 5.0))
    soft = canvas.octaves((2.5, 1.2, 0.5), (1.0, 0.6, 0.4))
    color = palette.seen((0.78, 0.58, 0.25)) * np.exp(rng.normal(0, 0.12, 3)).astype(np.float32)
    albedo = color * np.exp(0.06 * tone + 0.05 * soft)[..., None] * (0.88 + 0.16 * relief[..., None])
    absorbed = rng.uniform(0.2, 0.9) * canvas.vessels("twigs") + rng.uniform(0, 0.5) * canvas.vessels("net")
    redness = np.clip(canvas.octaves((12.0, 5.0), (1.0, 1.0)) * 0.3 + rng.uniform(-0.3, 0.3), 0, 0.6)
    albedo = albedo * np.exp(-np.clip(absorbed + redness, 0, 1.3)[..., None] * palette.absorbed)
    height = relief + 0.15 * soft
    return canvas.packed(albedo, np.clip(0.8 + 0.3 * relief, 0.1, 1.3), height, slope=rng.uniform(0.15, 0.35))


def serosa(canvas: Canvas, palette: Palette) -> Material:
    """The smooth outside of bowel and wall: pale pink, clear vessels, fibres that run across."""
    rng = canvas.rng
    middle = 0.5 * (palette.base + palette.pale)
    painted = mucosa(canvas, Palette(middle, palette.pale, palette.absorbed, palette.narrow_band), blood=0.8)
    fibres = canvas.noise(1.2, stretch=(1.0, 0.08)) + canvas.noise(3.0, stretch=(1.0, 0.15))
    painted[..., :3] *= np.exp(rng.uniform(0.0, 0.06) * fibres[..., None])
    height = painted[..., 4] + rng.uniform(0, 0.02) * fibres
    return canvas.packed(painted[..., :3], painted[..., 3], height, slope=rng.uniform(0.03, 0.15))


def blood(canvas: Canvas, palette: Palette) -> Material:
    """Blood that lies on tissue: dark, smooth and shining."""
    clots = canvas.octaves((6.0, 2.5, 1.0), (1.0, 0.6, 0.3))
    albedo = palette.seen((0.26, 0.020, 0.016)) * np.exp(0.3 * clots[..., None])
    return canvas.packed(albedo, np.clip(1.3 + 0.2 * clots, 0.6, 1.8), clots, slope=0.06)


def char(canvas: Canvas, palette: Palette) -> Material:
    """Coagulated tissue: black, brown and yellow."""
    burnt = canvas.octaves((4.0, 1.8, 0.8, 0.35), (1.0, 1.0, 0.7, 0.5))
    share = 1 / (1 + np.exp(-2.2 * (burnt + canvas.rng.uniform(-0.8, 0.8))))[..., None]
    albedo = share * palette.seen((0.07, 0.045, 0.03)) + (1 - share) * palette.seen((0.52, 0.36, 0.16))
    return canvas.packed(albedo, np.clip(0.4 - 0.2 * burnt, 0.02, 0.9), burnt, slope=0.35)


def cartilage(canvas: Canvas, palette: Palette) -> Material:
    """White, smooth, with faint fibres and frayed places."""
    rng = canvas.rng
    fibres = canvas.noise(5.0, stretch=(1.0, 0.12)) + canvas.noise(1.5, stretch=(1.0, 0.12))
    frayed = np.clip(canvas.octaves((7.0, 3.0), (1.0, 0.6)) - rng.uniform(0.4, 2.0), 0, 1)
    fine = canvas.octaves((0.8, 0.4, 0.2), (1.0, 0.8, 0.5))
    tone = canvas.octaves((15.0, 6.0), (1.0, 0.6))
    albedo = palette.pale * np.exp(0.05 * tone + 0.02 * fibres + 0.1 * frayed * fine)[..., None]
    if rng.random() < 0.5:
        seen = rng.uniform(0.1, 0.5) * np.clip(canvas.vessels("twigs") * tone, 0, 1)
        albedo = albedo * np.exp(-seen[..., None] * palette.absorbed)
    height = 0.1 * fibres + frayed * fine + 0.5 * tone
    return canvas.packed(albedo, np.clip(0.9 - 0.4 * frayed, 0.1, 1.2), height, slope=rng.uniform(0.02, 0.1))


def metal(canvas: Canvas, palette: Palette) -> Material:
    """Steel or black coating, brushed, with smears."""
    brushed = canvas.noise(0.6, stretch=(1.0, 0.05))
    smear = canvas.octaves((6.0, 2.5), (1.0, 0.6))
    shade = canvas.rng.choice([0.03, 0.09, 0.18])
    color = palette.seen((1.0, 0.97, 0.95))
    albedo = shade * np.exp(0.08 * brushed + 0.15 * smear)[..., None] * color
    return canvas.packed(albedo, np.clip(1.6 + 0.3 * smear, 0.6, 2.4), brushed, slope=0.03)


MATERIALS: dict[str, Callable[[Canvas, Palette], Material]] = {
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
