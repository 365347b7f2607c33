"""What else than matching tells of depth: brightness, and a monocular network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.depth.frames import PosedFrames
from extrags.depth.monocular import MonocularFit, aligned, fit_monocular
from extrags.depth.prior import DepthPrior
from extrags.depth.shading import ShadingFit, fit_shading, smoothed_brightness

__all__ = ["Cues", "fitted_cues", "shading_prior"]


@dataclass(frozen=True)
class Cues:
    """What else than matching tells of depth.

    Args:
        prior: all cues together.
        weight: of the prior; 0 where there is no cue.
        shading: the fit of brightness, one per recording.
        monocular: that of a monocular network; empty without one.
    """

    prior: DepthPrior
    weight: float
    shading: list[ShadingFit]
    monocular: list[MonocularFit]

    def silent(self, part: Tensor) -> Bool[Tensor, "b"]:
        """Which frames of a part no cue tells anything of."""
        if self.weight > 0:
            return ~torch.isfinite(self.prior.scatter[part])
        return torch.ones(len(part), dtype=torch.bool, device=part.device)


def fitted_cues(
    frames: PosedFrames,
    depth: Float[Tensor, "f h w"],
    sure: Bool[Tensor, "f h w"],
    recording: Int[Tensor, "f"],
    *,
    shading: bool,
    monocular: Float[Tensor, "f h w"] | None,
    weight: float,
) -> Cues:
    """Fit brightness, and a monocular network's inverse depth, to the depth of sure pixels.

    Args:
        frames: frames with poses.
        depth: z-depth of a first sweep.
        sure: pixels whose depth the fits rest on.
        recording: recording of each frame, numbered from zero.
        shading: whether what brightness predicts is part of the prior.
        monocular: inverse depth of each frame up to scale and shift; None without a network.
        weight: of the prior, where there is one.
    """
    brightness, log_depth = smoothed_brightness(frames), depth.log()
    fits = fit_shading(brightness, log_depth, sure, recording)
    prior = shading_prior(fits, brightness, recording)
    if not shading:
        # Not only without weight: what completes stereo would look at it.
        prior = DepthPrior(prior.log_depth, torch.full_like(prior.scatter, torch.inf))
    if monocular is None:
        return Cues(prior, weight if shading else 0.0, fits, [])
    monocular_fits = fit_monocular(monocular, log_depth, sure, recording)
    other = DepthPrior(*aligned(monocular_fits, monocular, recording))
    return Cues(prior & other if shading else other, weight, fits, monocular_fits)


def shading_prior(
    fits: list[ShadingFit], brightness: Float[Tensor, "f h w"], recording: Int[Tensor, "f"]
) -> DepthPrior:
    """What brightness predicts of all frames, by their recordings' fits."""
    log_depth = torch.empty_like(brightness)
    for g, fit in enumerate(fits):
        log_depth[recording == g] = fit.log_depth(brightness[recording == g])
    scatter = torch.tensor([fit.scatter for fit in fits], device=brightness.device)[recording]
    return DepthPrior(log_depth, scatter)
