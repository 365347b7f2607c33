"""Facts on the cues of estimated depth, for manifests and reports."""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool
from torch import Tensor

from extrags.depth.stereo import StereoDepth
from extrags.depth.unmatched import unmatched_frames
from extrags.depth.weights import BUNDLED, NONE, completion_digest

__all__ = ["depth_report"]

MOST_SCATTER = 9.0
"""Bound of what is reported of scatters, since JSON knows no infinity."""


def depth_report(stereo: StereoDepth, mask: Bool[Tensor, "f h w"], completion: str) -> dict[str, Any]:
    """What stereo found, how well other cues fit it, and what completed it, ready for JSON.

    Args:
        stereo: the last sweep.
        mask: pixels that show tissue.
        completion: the setting `depth.completion`.
    """
    confirmed = (stereo.agrees * stereo.seen > 0) & mask
    return {
        "sources_median": float(stereo.n_sources.median()),
        "frames_alone": int(unmatched_frames(stereo, mask).sum()),
        "agreeing_share": float(confirmed.sum() / mask.sum().clamp_min(1)),
        "shading": [
            {
                "slope": fit.slope,
                "scatter": min(fit.scatter, MOST_SCATTER),
                "spread": min(fit.spread, MOST_SCATTER),
                "pixels": fit.n_pixels,
            }
            for fit in stereo.fits
        ],
        "monocular": [
            {
                "scatter": min(float(fit.scatter.min()), MOST_SCATTER),
                "frames_aligned": int(fit.own.sum()),
                "pixels": fit.n_pixels,
            }
            for fit in stereo.monocular
        ],
        # Never a path: the same weights elsewhere make the same artefact.
        "completion": completion
        if completion in (BUNDLED, NONE)
        else f"weights {completion_digest(completion)}",
    }
