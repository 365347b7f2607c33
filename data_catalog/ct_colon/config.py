"""Settings of a recording of a stretch of the colon."""

from __future__ import annotations

from data_catalog.caverns.config import CavernConfig

__all__ = ["GENERATOR_VERSION", "CtColonConfig"]

GENERATOR_VERSION = 1
"""Raised by hand whenever the same settings give other pixels; part of every cache key."""
_FIRST_SEED = 100_000


class CtColonConfig(CavernConfig):
    """One stretch, recorded in one setting; `scene` says where along the colon it lies."""

    @property
    def seed(self) -> int:
        """Other random numbers than those of any cavern in use."""
        return _FIRST_SEED + self.scene

    @property
    def aside(self) -> float:
        """A colon is narrower than the caverns: so near to its wall a lamp would blind the sensor."""
        return 0.5
