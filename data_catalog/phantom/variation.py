"""Variation of phantom scenes about the standard colon; for pretraining only, never for evaluation.

Every number here is a factor or a value that the standard scenes have too; with `variation` 0 a scene is
a standard one, bit by bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_catalog.phantom.config import PhantomConfig, stream

__all__ = ["Variation", "vary"]


@dataclass(frozen=True)
class Variation:
    """What differs from the standard colon.

    Args:
        radius: factor of the tube's radius.
        curvature: factor of the bends; more than the standard's bends would fold the wall over itself.
        fold_height: factor of the height of the folds.
        fold_spacing: factor of the distance between folds.
        roughness: factor of the wall's slow undulation.
        tint: factors of the mucosa's red, green and blue.
        paleness: added to the share of pale mucosa.
        mottling: factor of blotches and mottling.
        vessels: factor of the vessels' contrast.
        relief: factor of the fine relief.
        lamp_offset: factor of the lamps' distance from the lens.
        lamp_balance: intensity of the second lamp.
        lamp_exponent: how fast the lamps get darker to the side.
        around: share of light that comes back from the wall.
        specular: factor of the specular reflectance.
        specular_roughness: alpha of GGX.
        vignetting: loss of signal in the corners.
        gamma: of the tone curve.
        brightness: factor of the exposure.
    """

    radius: float = 1.0
    curvature: float = 1.0
    fold_height: float = 1.0
    fold_spacing: float = 1.0
    roughness: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    paleness: float = 0.0
    mottling: float = 1.0
    vessels: float = 1.0
    relief: float = 1.0
    lamp_offset: float = 1.0
    lamp_balance: float = 0.86
    lamp_exponent: float = 1.8
    around: float = 0.11
    specular: float = 1.0
    specular_roughness: float = 0.13
    vignetting: float = 0.22
    gamma: float = 1.95
    brightness: float = 1.0


def vary(config: PhantomConfig) -> Variation:
    """The variation of a scene; depends on its index and on how much variation is asked for."""
    if config.variation == 0:
        return Variation()
    rng = stream(config.scene, "variation")
    strength = config.variation

    def factor(spread: float) -> float:
        return float(np.exp(strength * spread * rng.uniform(-1, 1)))

    def between(standard: float, low: float, high: float) -> float:
        return float(standard + strength * (rng.uniform(low, high) - standard))

    common = factor(0.25)
    return Variation(
        radius=factor(0.22),
        curvature=between(1.0, 0.2, 1.0),
        fold_height=between(1.0, 0.1, 1.25),
        fold_spacing=factor(0.35),
        roughness=between(1.0, 0.3, 1.8),
        tint=(common * factor(0.12), common * factor(0.4), common * factor(0.5)),
        paleness=between(0.0, -0.35, 0.4),
        mottling=between(1.0, 0.2, 2.0),
        vessels=between(1.0, 0.0, 1.4),
        relief=between(1.0, 0.2, 1.8),
        lamp_offset=between(1.0, 0.2, 1.6),
        lamp_balance=between(0.86, 0.4, 1.0),
        lamp_exponent=between(1.8, 0.5, 3.0),
        around=between(0.11, 0.0, 0.3),
        specular=between(1.0, 0.0, 2.0),
        specular_roughness=between(0.13, 0.08, 0.3),
        vignetting=between(0.22, 0.0, 0.4),
        gamma=between(1.95, 1.2, 2.4),
        brightness=factor(0.35),
    )
