"""Vessels grown on a square that tiles: trees that wander, fork and thin out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["grown_vessels"]

_STEPS = 22
_GENERATIONS = 11
_FRACTION_BITS = 4


def grown_vessels(
    rng: np.random.Generator,
    side: int,
    *,
    trees: int,
    width_texels: float,
    step_texels: float,
    tortuosity: float,
) -> Float[np.ndarray, "s s"]:
    """Coverage by vessels, 0 to 1.

    Args:
        rng: source of randomness.
        side: of the square, in texels.
        trees: how many start.
        width_texels: of the widest.
        step_texels: length of one straight piece.
        tortuosity: standard deviation of what is added to the bend at each piece, in radians.
    """
    import cv2

    # Lines start within the square and may leave it by half a side at most.
    step_texels = min(step_texels, 0.5 * side / _STEPS)
    start = rng.uniform(0, side, (trees, 2))
    heading = rng.uniform(0, 2 * np.pi, trees)
    width = width_texels * rng.uniform(0.45, 1.0, trees)
    coverage = np.zeros((side, side), dtype=np.float32)
    margin = side // 2
    canvases: dict[int, list[np.ndarray]] = {}
    for _ in range(_GENERATIONS):
        if not len(start):
            break
        count = len(start)
        length = rng.integers(5, _STEPS + 1, count)
        # A change of direction lasts for some pieces, so that vessels bend instead of trembling.
        bends = rng.normal(0, tortuosity, (count, _STEPS))
        for piece in range(1, _STEPS):
            bends[:, piece] += 0.8 * bends[:, piece - 1]
        turns = np.cumsum(bends, axis=1)
        turns -= 0.4 * np.cumsum(turns, axis=1) / np.arange(1, _STEPS + 1)
        course = heading[:, None] + turns
        moves = step_texels * np.stack([np.cos(course), np.sin(course)], axis=2)
        moves *= (np.arange(_STEPS) < length[:, None])[..., None]
        line = np.concatenate([start[:, None], start[:, None] + np.cumsum(moves, axis=1)], axis=1)
        pixels = np.maximum(1, np.round(2 * width)).astype(int)
        for value in np.unique(pixels):
            canvases.setdefault(int(value), []).extend(line[pixels == value])
        last = course[np.arange(count), length - 1]
        forks = rng.random(count) < 0.75
        share = rng.uniform(0.25, 0.75, count)
        angle = rng.uniform(0.3, 1.0, count) * rng.choice([-1.0, 1.0], count)
        # Murray's law: the cubes of the children's widths add up to the parent's.
        children = [(width * np.where(forks, np.cbrt(1 - share), 0.85), last - 0.5 * angle * forks)]
        children.append((width * np.cbrt(share) * forks, last + angle))
        kept = [child > max(0.22, 0.16 * width_texels) for child, _ in children]
        start = np.concatenate([line[keep, -1] % side for keep in kept])
        heading = np.concatenate([way[keep] for keep, (_, way) in zip(kept, children, strict=True)])
        width = np.concatenate([child[keep] for keep, (child, _) in zip(kept, children, strict=True)])
    for half_pixels, lines in canvases.items():
        layer = np.zeros((2 * side, 2 * side), dtype=np.uint8)
        corners = [np.round((line + margin) * 2**_FRACTION_BITS).astype(np.int32) for line in lines]
        cv2.polylines(layer, corners, False, 255, max(1, round(half_pixels / 2)), cv2.LINE_AA, _FRACTION_BITS)
        folded = np.maximum.reduce(
            [
                np.roll(layer[a : a + side, b : b + side], (a - margin, b - margin), axis=(0, 1))
                for a in (0, side)
                for b in (0, side)
            ]
        ).astype(np.float32)
        # Widths between whole texels as fainter lines; a soft edge, as tissue scatters light.
        faint = min(1.0, half_pixels / 2)
        soft = cv2.GaussianBlur(np.pad(folded, 8, mode="wrap"), (0, 0), 0.45 + 0.12 * half_pixels)[8:-8, 8:-8]
        np.maximum(coverage, np.clip(soft / 255 * 1.15, 0, 1) * (0.4 + 0.6 * faint), out=coverage)
    return coverage
