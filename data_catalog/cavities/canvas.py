"""A square that tiles, to paint materials on: noise, cells, vessels, bubbles."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.noise import tile_noise
from data_catalog.cavities.vessels import grown_vessels

__all__ = ["TEXEL_MM", "Canvas", "Plane", "VesselSize"]

TEXEL_MM = 0.06
Plane = Float[np.ndarray, "s s"]
VesselSize = Literal["arcades", "twigs", "net"]
_MOST_SLOPE = 0.45


class Canvas:
    """A square with a stream of randomness; lengths are in mm.

    Args:
        rng: source of randomness.
        side: in texels, a power of two.
    """

    def __init__(self, rng: np.random.Generator, side: int) -> None:
        self.rng, self.side, self.size_mm = rng, side, side * TEXEL_MM

    def noise(self, size_mm: float, *, stretch: tuple[float, float] = (1.0, 1.0)) -> Plane:
        """Smooth noise of unit variance whose features are about this large; stretched ones are fibres."""
        return tile_noise(self.rng, self.side, round(2 * self.size_mm / size_mm), stretch=stretch)

    def octaves(self, sizes_mm: tuple[float, ...], weights: tuple[float, ...]) -> Plane:
        """A weighted sum of noises, of unit variance."""
        total = sum(weight * self.noise(size) for size, weight in zip(sizes_mm, weights, strict=True))
        return np.asarray(total / np.sqrt(np.square(weights).sum()), dtype=np.float32)

    def vessels(self, size: VesselSize) -> Plane:
        """Coverage by vessels of a size, 0 to 1."""
        rng, area = self.rng, (self.size_mm / 60) ** 2
        trees, width, step, tortuosity = {
            "arcades": (rng.uniform(1.5, 5), rng.uniform(0.45, 1.1), 0.9, rng.uniform(0.04, 0.14)),
            "twigs": (rng.uniform(3, 18), rng.uniform(0.2, 0.42), 0.45, rng.uniform(0.05, 0.2)),
            "net": (rng.uniform(20, 140), rng.uniform(0.1, 0.17), 0.24, rng.uniform(0.08, 0.35)),
        }[size]
        return grown_vessels(
            rng,
            self.side,
            trees=max(1, round(trees * area)),
            width_texels=width / TEXEL_MM,
            step_texels=step / TEXEL_MM,
            tortuosity=tortuosity,
        )

    def cells(self, size_mm: float) -> tuple[Plane, Plane]:
        """Cells round random points: height (0 on the borders, to one inside), and a tone per cell."""
        import cv2

        count = max(4, round((self.size_mm / size_mm) ** 2))
        margin = min(self.side // 2, int(4 * size_mm / TEXEL_MM) + 4)
        seeds = self.rng.integers(0, self.side, (count, 2))
        image = np.full((self.side, self.side), 255, dtype=np.uint8)
        image[seeds[:, 0], seeds[:, 1]] = 0
        padded = np.pad(image, margin, mode="wrap")
        _, labels = cv2.distanceTransformWithLabels(padded, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        border = (cv2.Laplacian(labels.astype(np.float32), cv2.CV_32F, ksize=1) == 0).astype(np.uint8)
        inner = cv2.GaussianBlur(
            cv2.distanceTransform(border, cv2.DIST_L2, 5), (0, 0), 0.06 * size_mm / TEXEL_MM + 0.5
        )
        inside = slice(margin, margin + self.side)
        height = np.tanh(inner[inside, inside] / (0.3 * size_mm / TEXEL_MM))
        # Labels number the padded image; the tone must be that of the seed on the square.
        where = np.argwhere(padded == 0)
        tones = self.rng.standard_normal((self.side, self.side)).astype(np.float32)
        of_label = np.zeros(labels.max() + 1, dtype=np.float32)
        row, column = ((where - margin) % self.side).T
        of_label[labels[where[:, 0], where[:, 1]]] = tones[row, column]
        return height.astype(np.float32), of_label[labels[inside, inside]]

    def bubbles(
        self, albedo: Float[np.ndarray, "s s 3"], wet: Plane, height: Plane
    ) -> tuple[Float[np.ndarray, "s s 3"], Plane, Plane]:
        """Bubbles on something: round, with a bright rim, each a small dome that shines."""
        albedo, wet, height = albedo.copy(), wet.copy(), height.copy()
        rng, side = self.rng, self.side
        for _ in range(int(rng.integers(60, 500) * (self.size_mm / 60) ** 2)):
            radius = float(np.clip(np.exp(rng.normal(1.9, 0.6)), 3, 36))
            row, column = rng.integers(0, side, 2)
            reach = int(radius) + 2
            span = np.arange(-reach, reach + 1)
            rho = np.sqrt(span[:, None] ** 2 + span**2) / radius
            dome = np.sqrt(np.clip(1 - rho**2, 0, 1)).astype(np.float32)
            rim = np.exp(-np.square((rho - 0.93) / 0.12)).astype(np.float32)[..., None]
            block = np.ix_((row + span) % side, (column + span) % side)
            under = albedo[block] * (1 - 0.12 * (dome > 0)[..., None])
            albedo[block] = under + 0.35 * rim * (0.9 - under)
            height[block] += 0.25 * radius * TEXEL_MM * dome
            wet[block] = np.where(dome > 0, 1.5, wet[block])
        return albedo, wet, height

    def packed(
        self, albedo: Float[np.ndarray, "s s 3"], wet: Plane, height: Plane, *, slope: float | None = None
    ) -> Float[np.ndarray, "s s 6"]:
        """All of a material: reflectance (3), wetness, height in mm and noise for edges.

        Args:
            albedo: linear reflectance.
            wet: factor of the gloss.
            height: of the relief, in mm or, where a slope is given, in any unit.
            slope: root mean square of the relief's slope; None leaves the height as it is, up to a limit.
        """
        found = (
            np.sqrt(np.square(np.diff(height, axis=0)).mean() + np.square(np.diff(height, axis=1)).mean())
            / TEXEL_MM
        )
        wanted = min(float(found), _MOST_SLOPE) if slope is None else slope
        height = height * (wanted / max(float(found), 1e-9))
        edge = self.octaves((5.0, 2.0, 0.9, 0.4), (1.0, 0.8, 0.6, 0.4))
        parts = [np.clip(albedo, 0.01, 0.97), wet[..., None], height[..., None], edge[..., None]]
        return np.concatenate(parts, axis=2, dtype=np.float32)
