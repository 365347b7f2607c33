"""Colours of tissue, as linear reflectance under the endoscope's own light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Palette", "draw_palette"]

_NARROW_BAND_SHARE = 0.1
# Base and pale reflectance, and how often.
_MUCOSAE = (
    ((0.62, 0.21, 0.13), (0.78, 0.41, 0.28), 3.0),
    ((0.60, 0.16, 0.08), (0.74, 0.31, 0.18), 3.0),
    ((0.70, 0.31, 0.19), (0.84, 0.52, 0.37), 2.0),
    ((0.46, 0.095, 0.06), (0.62, 0.22, 0.15), 2.0),
    ((0.66, 0.38, 0.15), (0.80, 0.54, 0.27), 1.0),
    ((0.58, 0.23, 0.22), (0.74, 0.43, 0.40), 1.5),
    ((0.76, 0.55, 0.43), (0.88, 0.75, 0.63), 0.7),
)
_CARTILAGE = ((0.72, 0.66, 0.56), (0.88, 0.85, 0.78))
_NARROW_BAND = ((0.40, 0.37, 0.28), (0.56, 0.58, 0.47))


@dataclass(frozen=True)
class Palette:
    """Colours of one scene.

    Args:
        base: of ordinary mucosa.
        pale: of mucosa with little blood.
        absorbed: what blood takes from red, green and blue.
        narrow_band: whether the light is blue and green alone.
    """

    base: Float[np.ndarray, "3"]
    pale: Float[np.ndarray, "3"]
    absorbed: Float[np.ndarray, "3"]
    narrow_band: bool

    def seen(
        self, color: tuple[float, float, float] | Float[np.ndarray, "*s 3"]
    ) -> Float[np.ndarray, "*s 3"]:
        """Colours of white light under this scene's light."""
        red, green, blue = np.moveaxis(np.asarray(color, dtype=np.float64), -1, 0)
        if not self.narrow_band:
            return np.array(color, dtype=np.float32)
        shown = (0.85 * green + 0.1 * red, 0.25 * green + 0.55 * blue, 0.2 * green + 0.55 * blue)
        return np.stack(shown, axis=-1).astype(np.float32)


def draw_palette(kind: str, rng: np.random.Generator) -> Palette:
    """Colours for a kind of cavity."""
    narrow_band = bool(rng.random() < _NARROW_BAND_SHARE) and kind not in ("field", "joint")
    weights = np.array([one[2] for one in _MUCOSAE])
    drawn = int(rng.choice(len(_MUCOSAE), p=weights / weights.sum()))
    base, pale = _MUCOSAE[drawn][:2]
    if kind == "joint" and rng.random() < 0.8:
        base, pale = _CARTILAGE
    if narrow_band:
        base, pale = _NARROW_BAND
    jitter = np.exp(rng.normal(0, 0.09, 3) * np.array([0.6, 1.2, 1.2])) * np.exp(rng.normal(0, 0.12))
    absorbed = np.array([0.75, 1.1, 0.95] if narrow_band else [0.30, 1.0, 0.75])
    # Tissue under white light is never bluer than it is green.
    jitter[2] = min(jitter[2], jitter[1] * min(1.0, base[1] / base[2]))
    return Palette(
        np.clip(np.array(base) * jitter, 0.03, 0.92).astype(np.float32),
        np.clip(np.array(pale) * jitter, 0.03, 0.95).astype(np.float32),
        (absorbed * np.exp(rng.normal(0, 0.1, 3))).astype(np.float32),
        narrow_band,
    )
