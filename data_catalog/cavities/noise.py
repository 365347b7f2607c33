"""Random smooth functions: solid ones as sums of plane waves, and flat ones that tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["SolidNoise", "stream", "tile_noise"]

_STREAMS = (
    *("scene", "shape", "growths", "skin", "paint", "path", "targets", "lamps", "sensor", "noise"),
    "depth",
)
_CHUNK = 1 << 16


def stream(scene: int, purpose: str, *indices: int) -> np.random.Generator:
    """The random stream of a scene for one purpose; streams do not influence each other.

    No index and the index 0 give the same stream: numpy fills a short seed up with zeros.
    """
    return np.random.default_rng([0xCA517, scene, _STREAMS.index(purpose), *indices])


@dataclass(frozen=True)
class SolidNoise:
    """A smooth random function of space with unit variance: a sum of plane waves.

    Args:
        wave_vectors: angular frequencies in radians per mm, [M, 3].
        phases: [M].
        amplitudes: [M]; their squares sum to two.
    """

    wave_vectors: Float[np.ndarray, "m 3"]
    phases: Float[np.ndarray, "m"]
    amplitudes: Float[np.ndarray, "m"]

    @classmethod
    def random(
        cls, rng: np.random.Generator, longest_mm: float, shortest_mm: float, *, waves: int = 16
    ) -> SolidNoise:
        """Waves whose lengths are spread evenly in logarithm, longer ones higher.

        Args:
            rng: source of randomness.
            longest_mm: longest wave.
            shortest_mm: shortest wave.
            waves: how many.
        """
        direction = rng.standard_normal((waves, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = shortest_mm * (longest_mm / shortest_mm) ** rng.uniform(size=waves)
        amplitude = length**0.7 * rng.uniform(0.5, 1.5, waves)
        amplitude *= np.sqrt(2 / np.square(amplitude).sum())
        vectors = direction * (2 * np.pi / length)[:, None]
        return cls(
            vectors.astype(np.float32),
            rng.uniform(0, 2 * np.pi, waves).astype(np.float32),
            amplitude.astype(np.float32),
        )

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Values at points in mm, float32."""
        result = np.zeros(len(points), dtype=np.float32)
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK].astype(np.float32)
            x, y, z = np.ascontiguousarray(part.T)
            total = np.zeros(len(part), dtype=np.float32)
            for (a, b, c), phase, amplitude in zip(
                self.wave_vectors, self.phases, self.amplitudes, strict=True
            ):
                total += amplitude * np.sin(a * x + b * y + c * z + phase)
            result[start : start + _CHUNK] = total
        return result


def tile_noise(
    rng: np.random.Generator, side: int, cells: int, *, stretch: tuple[float, float] = (1.0, 1.0)
) -> Float[np.ndarray, "s s"]:
    """Smooth noise of one scale and unit variance that continues over the edges of a square.

    Args:
        rng: source of randomness.
        side: in texels.
        cells: lattice cells along the side: a feature is about two of them long.
        stretch: factors of the number of cells down and across.
    """
    import cv2

    down, across = (max(3, min(side, round(cells * factor))) for factor in stretch)
    lattice = rng.standard_normal((down, across)).astype(np.float32)
    # Smooth to this factor: what is coarse is interpolated twice, which is cheaper.
    factor = 1
    while side // (2 * factor) >= 6 * max(down, across) and side // (2 * factor) >= 64:
        factor *= 2
    small = side // factor
    margin = 3
    padded = np.pad(lattice, margin, mode="wrap")
    # The pitch is exact, so that both edges meet: the padded lattice is sampled at texel centres.
    rows = (np.arange(small, dtype=np.float32) + 0.5) * (down / small) - 0.5 + margin
    columns = (np.arange(small, dtype=np.float32) + 0.5) * (across / small) - 0.5 + margin
    grid_x, grid_y = np.meshgrid(columns, rows)
    field = cv2.remap(padded, grid_x, grid_y, cv2.INTER_CUBIC)
    field = (field - field.mean()) / max(float(field.std()), 1e-6)
    if factor > 1:
        large = (small + 2) * factor
        field = cv2.resize(np.pad(field, 1, mode="wrap"), (large, large), interpolation=cv2.INTER_LINEAR)
        field = field[factor:-factor, factor:-factor]
    return np.ascontiguousarray(field, dtype=np.float32)
