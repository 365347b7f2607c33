"""All rows, in the order of the pipeline."""

from __future__ import annotations

from extrags.stress import geometry, optimiser, steps, training, views
from extrags.stress.rows import Row

__all__ = ["ROWS"]

ROWS: tuple[Row, ...] = (*steps.ROWS, *optimiser.ROWS, *training.ROWS, *geometry.ROWS, *views.ROWS)
