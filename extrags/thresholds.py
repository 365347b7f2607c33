"""Levels that mean the same wherever pixels are told apart; the evaluation protocol writes down its own."""

from __future__ import annotations

__all__ = ["HOLE_ALPHA", "SATURATED"]

SATURATED = 250
"""A channel at or above this, of 255, no longer follows the brightness."""

HOLE_ALPHA = 0.5
"""A rendered pixel below this alpha is a hole; from it on it shows a surface, whose depth counts."""
