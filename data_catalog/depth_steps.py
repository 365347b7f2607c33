"""Depth that was rounded coarsely before it was written, such as to whole millimetres."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float

__all__ = ["DepthSteps"]

logger = logging.getLogger(__name__)

_LARGEST_SHARE = 0.01
"""Steps above this share of the median depth show in the surface."""
_FEWEST_LEVELS = 4
"""Of fewer values nothing tells whether they are steps."""
_LOOKED_AT = 1 << 16
_EXACT = 1e-3


class DepthSteps:
    """Looks at the first depth map of a source that tells, as it lies on disk, and warns of coarse steps."""

    def __init__(self) -> None:
        self._looked = False

    def see(self, depth: Float[np.ndarray, "h w"], file: Path) -> None:
        """Look at a map, unless one has told already.

        Args:
            depth: [h, w], in the sequence's unit; 0 where unknown.
            file: named in the warning.
        """
        if self._looked:
            return
        known = depth[depth > 0]
        levels = np.unique(known[:: 1 + len(known) // _LOOKED_AT]).astype(np.float64)
        if len(levels) < _FEWEST_LEVELS:
            return
        self._looked = True
        step, median = float(np.diff(levels).min()), float(np.median(known))
        multiples = (levels - levels[0]) / step
        if step <= _LARGEST_SHARE * median or np.abs(multiples - np.round(multiples)).max() > _EXACT:
            return
        logger.warning(
            "%s: depth in steps of %.3g, %.1f %% of its median of %.3g, makes stairs of surfaces; expected "
            "finer values, as of float .npy or TIFF files",
            file,
            step,
            100 * step / median,
            median,
            extra={"topic": "depth resolution", "field": "depth"},
        )
