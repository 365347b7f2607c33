"""All rows, in the order of the pipeline."""

from __future__ import annotations

from extrags.stress import (
    faulty_recordings,
    geometry,
    later_stages,
    optimiser,
    repeats,
    scores,
    steps,
    training,
    views,
)
from extrags.stress.rows import Row

__all__ = ["ROWS"]

PARTS = (
    "rasteriser",
    "unlit step",
    "lit step",
    "Adam",
    "densification",
    "training",
    "rendering",
    "reconstruction",
    "TSDF",
    "carving",
    "poses",
    "lens",
    "depth",
    "assessment",
    "exploration",
    "warp",
    "filling",
    "restorer",
    "restored views",
    "fine-tuning",
    "judge",
    "metrics",
    "evaluation",
    "pipeline",
)
"""In this order, whichever module has a part's rows."""

MODULES = (steps, optimiser, training, geometry, views, scores, faulty_recordings, later_stages, repeats)

ROWS: tuple[Row, ...] = tuple(
    sorted((row for module in MODULES for row in module.ROWS), key=lambda row: PARTS.index(row.part))
)
