"""Stretches of a real colon from CT, lined with real tissue: anatomy that nobody here made.

The surface and the line through its middle are those of `EdinGCA_3D_00090` (CC BY 4.0, see docs/licences.md).
CT shows no mucosa: the wall is lined with patches of those laparoscopy frames that no training takes
(`data_catalog.cavities.real_textures`). Cameras, lamps and sensor are those of the caverns.
"""

from __future__ import annotations

from data_catalog.ct_colon.config import GENERATOR_VERSION, CtColonConfig

__all__ = ["GENERATOR_VERSION", "CtColonConfig"]
