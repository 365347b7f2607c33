"""Frames that nothing matches: which these are, and how far their depth may be off."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.depth.stereo import StereoDepth

__all__ = ["scale_error", "unmatched_frames"]

UNKNOWN_SCALE_ERROR = 0.4
"""Expected relative error of the scale of a frame that no other could be matched with, where brightness does
not tell it: in a recording without any stereo to fit it to, and of a picture that shows something else than
its pose says. Frames of phantoms and caverns that were made black, red, noise or mirrored are off by 0.42 in
the mean of their log-depth (32 frames, 0.20 to 0.78)."""

MATCHED_COST = 0.5
"""Matching cost below which windows show the same: a correlation of one half. Depths alone do not tell it: in
the last sweep, which is narrow, those of a black or noisy frame meet those of others at up to 44 % of its
pixels by chance."""

MATCHED_SHARE = 0.05
"""Share of a frame's pixels that must match with other frames. It is at most 2 % where the picture is black,
of one colour, noise, or mirrored, and 11 % and more in ordinary frames of 80 pixels' width or more."""


def unmatched_frames(stereo: StereoDepth, mask: Bool[Tensor, "f h w"]) -> Bool[Tensor, "f"]:
    """Frames whose depth no other frame confirms.

    These have no source, or sources by their poses alone: hardly any pixel has both the depth that another
    frame has there and a window that looks like that of the other frame.

    Args:
        stereo: of the last sweep.
        mask: pixels that count; a frame without any is unmatched.
    """
    confirmed = (stereo.agrees * stereo.seen > 0) & (stereo.cost < MATCHED_COST) & mask
    share = confirmed.flatten(1).sum(1) / mask.flatten(1).sum(1).clamp_min(1)
    return (stereo.n_sources == 0) | (share < MATCHED_SHARE)


def scale_error(stereo: StereoDepth, unmatched: Bool[Tensor, "f"]) -> Float[Tensor, "f"]:
    """Expected relative error of the scale of each frame; zero where other frames tell it.

    A frame without sources is one whose pose sees what no other does: it has the mean intercept of its
    recording's fit of brightness, and is as wrong as the intercepts of matched frames differ. A frame that
    has sources and matches none shows something else, or nothing, and its brightness tells nothing either.

    Args:
        stereo: of the last sweep.
        unmatched: from `unmatched_frames`.
    """
    error = torch.zeros(len(stereo.n_sources), device=stereo.n_sources.device)
    for number, fit in enumerate(stereo.fits):
        own = torch.nonzero(stereo.recording == number)[:, 0]
        matched = ~unmatched[own]
        known = math.isfinite(fit.scatter) and int(matched.sum()) >= 2
        spread = float(fit.intercepts[matched].std()) if known else UNKNOWN_SCALE_ERROR
        error[own[stereo.n_sources[own] == 0]] = min(spread, UNKNOWN_SCALE_ERROR)
    error[unmatched & (stereo.n_sources > 0)] = UNKNOWN_SCALE_ERROR
    return error
