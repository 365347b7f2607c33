"""The dark surround of an endoscope's picture is cut off where it takes much of the frame."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Shaped

from extrags.config import IngestConfig
from extrags.frame_stacks import stacked
from extrags.sequence import EndoscopicSequence

__all__ = ["LEAST_SIDE_PX", "MOST_KEPT_SHARE", "cropped_to_picture"]

_log = logging.getLogger(__name__)

MOST_KEPT_SHARE = 0.75
"""Of the frame's pixels: where the box round the picture has more, frames stay as they are."""

LEAST_SIDE_PX = 64
"""Of the box: a smaller one is hardly that of a picture."""

_STACKS = ("rgb", "mask", "depth_mm", "withheld_depth_mm", "depth_error", "observed", "specular")


def cropped_to_picture(sequence: EndoscopicSequence, config: IngestConfig) -> EndoscopicSequence:
    """The sequence, its frames cut to the box of all pixels that a mask keeps in any of them.

    A round picture in a wide frame is a third to a half of it. What lies round it costs time and memory in
    every stage, and networks that look at a frame at a fixed size would see less of the tissue. Frames of a
    source with poses stay as they are: others render these at the size that their source has. So do frames
    of a width that the settings name, and those whose principal point lies outside the box.

    Args:
        sequence: as its reader has it.
        config: as it was given, `crop_surround` and `width`.
    """
    if not config.crop_surround or config.width is not None or sequence.world_from_camera is not None:
        return sequence
    shown = np.zeros((sequence.height, sequence.width), dtype=bool)
    for mask in sequence.mask:
        shown |= mask
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    if not len(rows):
        return sequence
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    height, width = int(bottom - top), int(right - left)
    if height * width > MOST_KEPT_SHARE * shown.size or min(height, width) < LEAST_SIDE_PX:
        return sequence
    centers = sequence.K[:, :2, 2]
    if (centers <= [left, top]).any() or (centers >= [right, bottom]).any():
        # No camera has its axis beside its image, by what COLMAP and most other programs ask.
        return sequence

    def cut(stack: Shaped[np.ndarray, "f h w *c"]) -> Shaped[np.ndarray, "f h2 w2 *c"]:
        return stacked((frame[top:bottom, left:right] for frame in stack), len(stack))

    _log.info(
        "%s: frames of %d x %d px are cut to the picture, %d x %d px from column %d and row %d on "
        "(ingest.crop_surround)",
        sequence.name,
        sequence.width,
        sequence.height,
        width,
        height,
        left,
        top,
    )
    K = sequence.K.copy()
    K[:, :2, 2] -= [left, top]
    changed: dict[str, Any] = {"K": K}
    for name in _STACKS:
        if getattr(sequence, name) is not None:
            changed[name] = cut(getattr(sequence, name))
    return replace(sequence, **changed)
