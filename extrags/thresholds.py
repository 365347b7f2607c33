"""Pixel thresholds that all stages share; the evaluation protocol defines its own."""

from __future__ import annotations

__all__ = ["HOLE_ALPHA", "RELIABLE_DEPTH_ERROR", "SATURATED"]

SATURATED = 250
"""Saturation level of an 8-bit channel: at or above it, the value no longer follows the brightness."""

HOLE_ALPHA = 0.5
"""A rendered pixel below this alpha is a hole; at or above it, the pixel shows a surface with valid depth."""

RELIABLE_DEPTH_ERROR = 0.05
"""Expected relative error up to which estimated depth counts as a surface that was seen. Most of what
exceeds it lies at the edges of folds, between the depths of what is in front and what is behind."""
