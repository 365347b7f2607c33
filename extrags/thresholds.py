"""Pixel thresholds that all stages share; the evaluation protocol defines its own."""

from __future__ import annotations

__all__ = ["HOLE_ALPHA", "SATURATED"]

SATURATED = 250
"""Saturation level of an 8-bit channel: at or above it, the value no longer follows the brightness."""

HOLE_ALPHA = 0.5
"""A rendered pixel below this alpha is a hole; at or above it, the pixel shows a surface with valid depth."""
