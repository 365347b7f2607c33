"""Agreement: what neighbouring restored views have invented, brought nearer to each other.

A restorer invents each view alone, and two views that show one place disagree about it. Here every view is
shown what its neighbours say of the surface that it sees, as bright as it would be from its own place, and
follows their mean where it is invented itself: the better its pixel can be known from what surrounds it, the
less. Only what is coarse is changed: depths are guesses there, and the mean of what stands a few pixels apart
is blurred. Errors of views have little in common, so that the mean is not only steadier.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.restoration.clips import FEATHER_RADIUS_PX, FEATHER_SIGMA_PX
from extrags.restoration.surface_texture import invented_share
from extrags.threads import in_threads, one_torch_thread
from extrags.view_synthesis.invented import border_trust, evidence
from extrags.view_synthesis.references import LightTransfer, ReferenceViews
from extrags.view_synthesis.warp import covisibility, seen_by_others

__all__ = ["agreed_views", "feathered_invented_share"]

NEIGHBOURS = 4
"""Views that a view is compared with, at most: those that see most of the same surface."""
DEPTH_TOLERANCE = 0.2
"""Relative difference at which two invented depths are taken for the same surface by 1/e."""
COARSE_SHARE = 0.02
"""Standard deviation of the window that the change is smoothed with, as a share of a view's width."""
LEAST_SHARE = 1e-3
"""Less is not divided by."""


def feathered_invented_share(unconfirmed: Float[Tensor, "v 1 h w"]) -> Float[Tensor, "v 1 h w"]:
    """How much of a pixel counts as invented, without a seam to what is known.

    Args:
        unconfirmed: share of each pixel that neither the rendering nor a real view confirms.
    """
    window = gaussian_weights(FEATHER_SIGMA_PX, FEATHER_RADIUS_PX)
    return filter_separable(invented_share(unconfirmed), window, window)


@one_torch_thread()
def agreed_views(
    rgb: Float[Tensor, "v 3 h w"],
    depth_mm: Float[Tensor, "v 1 h w"],
    unconfirmed: Float[Tensor, "v 1 h w"],
    cameras: Cameras,
    exposure: Float[np.ndarray, "v"] | None,
    transfer: LightTransfer,
) -> Float[Tensor, "v 3 h w"]:
    """Restored views that agree better on what they have invented; a view alone stays as it is.

    Args:
        rgb: in [0, 1].
        depth_mm: z-depth without gaps.
        unconfirmed: share of each pixel that neither the rendering nor a real view confirms.
        cameras: of the views.
        exposure: gain of each view; None is 1.
        transfer: how brightness changes with distance.

    Raises:
        ShapeError: when the numbers of views differ.
    """
    gain = torch.ones(len(rgb)) if exposure is None else torch.from_numpy(exposure).to(rgb.dtype)
    counts = {len(rgb), len(depth_mm), len(unconfirmed), len(cameras), len(gain)}
    if len(counts) != 1:
        raise ShapeError(f"the parts of views that shall agree have different lengths: {sorted(counts)}")
    count, share = len(rgb), feathered_invented_share(unconfirmed)
    if count < 2 or not bool((share > 0).any()):
        return rgb
    knowledge = evidence(unconfirmed)
    trust = knowledge * border_trust(cameras.height, cameras.width)
    packed = torch.cat([rgb, trust, 1 / depth_mm.clamp_min(1e-9), torch.ones_like(trust)], dim=1)
    nothing = torch.zeros(count, 0, dtype=torch.bool)
    views = ReferenceViews(np.arange(count), cameras, packed.contiguous(), gain, nothing, transfer)
    common = covisibility(views, cameras, depth_mm, DEPTH_TOLERANCE)
    common.fill_diagonal_(-1.0)
    neighbours = torch.argsort(common, dim=1, descending=True, stable=True)[:, : min(NEIGHBOURS, count - 1)]
    sigma = COARSE_SHARE * cameras.width
    window = gaussian_weights(sigma, math.ceil(3 * sigma))

    def agreed(view: int) -> Tensor:
        if not bool((share[view] > 0).any()):
            return rgb[view]
        theirs, weight = seen_by_others(
            views,
            cameras[[view]],
            depth_mm[view],
            neighbours[view],
            gain=gain[view],
            depth_tolerance=DEPTH_TOLERANCE,
        )
        all_weights = weight.sum(dim=0) + knowledge[view]
        change = (weight[:, None] * (theirs - rgb[view])).sum(dim=0) / all_weights
        coarse = filter_separable((change * share[view])[None], window, window)[0]
        coarse = coarse / filter_separable(share[view][None], window, window)[0].clamp_min(LEAST_SHARE)
        return torch.where(share[view] > 0, (rgb[view] + share[view] * coarse).clamp(0, 1), rgb[view])

    return torch.stack(in_threads(agreed, range(count)))
