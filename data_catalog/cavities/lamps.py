r"""Lamps beside the lens, and what wet tissue makes of their light.

A lamp of intensity :math:`I` sends :math:`E = I \cos^p \beta / r^2` to a point at distance :math:`r`,
:math:`\beta` off its axis. Tissue scatters it, red farther than green and blue, so that red reaches round
edges and into shadows; a wet coat mirrors it in one sharp lobe and one wide one.

Source: GGX after Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from data_catalog.cavities.skin import SkinValues

__all__ = ["Lamps"]

_COATED = 0.08
"""Share of the relief's slope variance that is left in the film of water over it."""
_FARTHEST_SCATTER = np.array([1.0, 0.3, 0.2], dtype=np.float32)


@dataclass(frozen=True)
class Lamps:
    """The lamps of a scene, in camera coordinates.

    Args:
        offsets_mm: of each lamp from the lens.
        intensities: relative.
        angular_exponent: p; the lamps shine less to the side.
        around: share of light that comes back from the surrounding wall.
        reflectance: of the wet coat at normal incidence.
        roughness: alpha of the sharp lobe.
        sheen: strength of the wide lobe, relative to the sharp one.
        scatter: how far light gets round edges, 0 to about 0.4.
    """

    offsets_mm: tuple[tuple[float, float, float], ...]
    intensities: tuple[float, ...]
    angular_exponent: float
    around: float
    reflectance: float
    roughness: float
    sheen: float
    scatter: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> Lamps:
        """One to three lamps off the axis."""
        count = int(rng.choice([1, 2, 3], p=(0.3, 0.5, 0.2)))
        turn, spread = rng.uniform(0, 2 * np.pi), 0.5 + 3.5 * rng.uniform() ** 1.7
        offsets = []
        for k in range(count):
            angle = turn + 2 * np.pi * k / count + rng.normal(0, 0.2)
            offsets.append(
                (float(spread * np.cos(angle)), float(spread * np.sin(angle)), float(rng.uniform(-0.5, 0.4)))
            )
        powers = (1.0, *(float(x) for x in rng.uniform(0.35, 1.0, count - 1)))
        return cls(
            tuple(offsets),
            powers,
            float(rng.uniform(0.3, 3.0)),
            float(rng.uniform(0.02, 0.3)),
            float(rng.uniform(0.02, 0.085)),
            float(np.exp(rng.uniform(np.log(0.035), np.log(0.13)))),
            float(rng.uniform(0.0, 0.5)),
            float(rng.uniform(0.0, 0.4)),
        )

    def radiance(
        self,
        to_camera: Float[np.ndarray, "n 3"],
        to_lights: list[Float[np.ndarray, "n 3"]],
        light_cosines: list[Float[np.ndarray, "n"]],
        visible: list[Bool[np.ndarray, "n"]],
        normals: Float[np.ndarray, "n 3"],
        skin: SkinValues,
    ) -> Float[np.ndarray, "n 3"]:
        """Light sent from wall points to the camera, linear, unit exposure.

        Args:
            to_camera: unit vectors from the wall to the lens.
            to_lights: for each lamp, vectors from the wall to it, in mm.
            light_cosines: for each lamp, cosine between the view's axis and the ray to the wall point.
            visible: for each lamp, false in shadow.
            normals: unit normals of the wall.
            skin: the wall at these points.
        """
        total = np.zeros_like(skin.albedo)
        around = np.zeros(len(total), dtype=np.float32)
        reach = self.scatter * _FARTHEST_SCATTER
        for lamp, intensity in enumerate(self.intensities):
            squared = np.maximum(_dot(to_lights[lamp], to_lights[lamp]), 1.0)
            direction = to_lights[lamp] / np.sqrt(squared)[:, None]
            incident = intensity * np.clip(light_cosines[lamp], 0, None) ** self.angular_exponent / squared
            around += incident
            flat = _dot(normals, direction)
            bent = np.clip((_dot(skin.normal, direction)[:, None] + reach) / (1 + reach), 0, None)
            bent *= np.clip((flat[:, None] + reach) / (0.08 + reach), 0, 1)
            lit = np.maximum(visible[lamp][:, None], 0.35 * reach)
            total += (incident[:, None] * lit) * bent * skin.albedo / np.pi
            lobe = self._gloss(direction, to_camera, skin) * np.clip(flat / 0.05, 0, 1)
            total += (incident * visible[lamp] * lobe)[:, None]
        # Light that bounced once more took the colour of the wall once more.
        tint = skin.albedo * skin.albedo / skin.albedo.max(axis=1, keepdims=True)
        return np.asarray(total + self.around * around[:, None] * tint / np.pi, dtype=np.float32)

    def _gloss(
        self, to_light: Float[np.ndarray, "n 3"], to_camera: Float[np.ndarray, "n 3"], skin: SkinValues
    ) -> Float[np.ndarray, "n"]:
        half = to_light + to_camera
        half = half / np.sqrt(np.maximum(_dot(half, half), 1e-9))[:, None]
        n_half = np.clip(_dot(skin.normal, half), 0, 1)
        n_light = np.clip(_dot(skin.normal, to_light), 1e-3, 1)
        n_camera = np.clip(_dot(skin.normal, to_camera), 5e-2, 1)
        fresnel = self.reflectance + (1 - self.reflectance) * (1 - np.clip(_dot(to_light, half), 0, 1)) ** 5
        total = np.zeros(len(n_half), dtype=np.float32)
        for strength, alpha in ((1.0, self.roughness), (self.sheen, 0.45)):
            squared = alpha**2 + _COATED * skin.slope_variance
            spread = squared / (np.pi * (n_half**2 * (squared - 1) + 1) ** 2)
            k = np.sqrt(squared) / 2
            masking = 1 / ((n_light * (1 - k) + k) * (n_camera * (1 - k) + k))
            total += strength * spread * masking
        return np.asarray(total * fresnel * skin.wetness * n_light / 4)


def _dot(first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.einsum("ij,ij->i", first, second))
