"""The smallest size a Gaussian may have: what the training views can resolve.

Nothing in the loss holds a Gaussian that is smaller than a pixel: it may shrink, and nearer or shifted views
look through the gaps it leaves. In long optimisations from few frames this is one way in which held-out views
get worse while training views get better.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras, unproject_pixels

__all__ = ["APPLIED_EVERY", "SmallestFootprint"]

APPLIED_EVERY = 100
"""Iterations between two applications: positions and sizes change little in between."""

MAX_CAMERAS = 64
"""Of more training views, so many are used, evenly spread: neighbours resolve the same."""


class SmallestFootprint:
    """Lower bound on the two larger axes of each Gaussian, from the training view that resolves it best.

    The third axis is free: Gaussians on a surface are flat.

    Args:
        cameras: the training views.
        pixels: the bound, as a standard deviation in pixels of the nearest view that has the Gaussian in its
            image.

    Source: the sampling limit of [Yu2024], section 4.1, as a bound instead of a filter; see
    docs/references.md.
    """

    def __init__(self, cameras: Cameras, pixels: float) -> None:
        chosen = np.unique(
            np.linspace(0, len(cameras) - 1, min(len(cameras), MAX_CAMERAS)).round().astype(int)
        )
        self._cameras = cameras[chosen]
        self._pixels = pixels

    def smallest(self, means: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """The bound of Gaussians at these positions, in world units; 0 where no view sees the position."""
        nearest = np.full(len(means), np.inf)
        for index in range(len(self._cameras)):
            (pixels,), (z,) = self._cameras[index].project(means)
            inside = self._cameras.contains(pixels)
            focal_px = min(self._cameras.K[index, 0, 0], self._cameras.K[index, 1, 1])
            if self._cameras.lens is not None:
                # A lens packs its rim: there a pixel is wider, across the radius, than on its axis.
                rays = unproject_pixels(pixels[inside], self._cameras.K[index], self._cameras.lens)
                slope = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-6)
                z[inside] *= slope / self._cameras.lens.radius(np.arctan(slope))
            nearest[inside] = np.minimum(nearest[inside], z[inside] / focal_px)
        return np.where(np.isfinite(nearest), self._pixels * nearest, 0.0)

    @torch.no_grad()
    def apply(self, parameters: dict[str, Tensor]) -> None:
        """Raise the logarithmic `scales` of Gaussians below the bound, in place."""
        scales = parameters["scales"]
        bound = self.smallest(parameters["means"].detach().double().cpu().numpy())
        tiny = torch.finfo(scales.dtype).tiny
        logarithm = torch.from_numpy(bound).to(scales).clamp_min(tiny).log()[:, None]
        raised = torch.maximum(scales, logarithm)
        thinnest = scales.argmin(dim=1, keepdim=True)
        raised.scatter_(1, thinnest, scales.gather(1, thinnest))
        scales.copy_(raised)
