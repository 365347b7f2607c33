"""The judging family: caverns that no training ever sees, with exact ground truth (see `recording`).

Geometry and textures are made otherwise than those of the phantom and of the pretraining cavities: chains of
soft balls instead of tubes and organs, cellular textures with reticulate and spiral vessels instead of
painted tiles.
"""

from __future__ import annotations

from data_catalog.caverns.config import GENERATOR_VERSION, CavernConfig

__all__ = ["GENERATOR_VERSION", "CavernConfig"]
