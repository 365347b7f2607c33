r"""Conditional diffusion along straight paths (rectified flow): prediction and sampling.

With the clean image z_0 and noise e, both normalised, :math:`z_t = (1 - t) z_0 + t e` for t from 0 to 1,
and the network predicts z_0 as a residual to the base image. This is the diffusion prior of [ExtraGS, eq. 4
and 5] in another parametrisation of the same Gaussian family: a signal-to-noise ratio per t, and a
prediction from which the noise follows. At t = 1 there is no signal, so a single step is a regression;
several steps are DDIM's deterministic sampler in terms of the path. A generative network that is asked for
one of the plausible views gives a whole one at any t; its steps mix the view with noise anew each time, as
those of consistency models do.

Source of the latter: [SongConsistency2023, algorithm 1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.restoration.diffusion.network import SIZE_MULTIPLE, RestorationNetwork
from extrags.restoration.diffusion.texture_transfer import PatchFeatures
from extrags.view_synthesis.conditioning import COLOR_CENTER, COLOR_SCALE, Conditioning

__all__ = ["DEPTH_LIMIT", "Predicted", "Sampled", "predict", "sample"]

DEPTH_LIMIT = 1.5
"""Largest correction of a log-depth, and largest error that counts in the loss."""
DEPTH_TRUST = 0.5
"""Weight of the network's depth against the smooth filling. In the holes of virtual views each is wrong by
14 %, with different errors; their mean is better."""
TYPICAL_ERROR = 0.05
NOISE_SHIFT_PX = (97, 61)
LOG_ERROR_LIMIT = 4.0
"""The expected error starts at the typical one and stays within a factor of e to this power."""


@dataclass(frozen=True)
class Predicted:
    """Output of the network.

    Args:
        rgb: clean colours, about [0, 1], [N, 3, H, W].
        log_depth: of the true z-depth, in the logarithm of millimetres, [N, 1, H, W].
        log_error: logarithm of the expected absolute error of a pixel's colours, [N, 1, H, W].
    """

    rgb: Float[Tensor, "n 3 h w"]
    log_depth: Float[Tensor, "n 1 h w"]
    log_error: Float[Tensor, "n 1 h w"]


@dataclass(frozen=True)
class Sampled:
    """Restored views.

    Args:
        rgb: in [0, 1], [N, 3, H, W].
        depth_mm: z-depth without gaps, [N, 1, H, W].
        error: expected absolute error of a pixel's colours, as predicted by the network, [N, 1, H, W].
    """

    rgb: Float[Tensor, "n 3 h w"]
    depth_mm: Float[Tensor, "n 1 h w"]
    error: Float[Tensor, "n 1 h w"]


def sample(
    network: RestorationNetwork,
    conditioning: Conditioning,
    noise: Float[Tensor, "n 3 h w"],
    *,
    steps: int,
    half_precision: bool,
    drawing: bool = False,
    patches: PatchFeatures | None = None,
) -> Sampled:
    """Restore views in a fixed number of steps.

    Args:
        network: trained.
        conditioning: of N views; any size, padded inside to what the network needs.
        noise: where the path starts; the same noise gives the same image.
        steps: 1 is a regression, more draw texture.
        half_precision: convolutions in bfloat16.
        drawing: one of the plausible views instead of their mean; for generative networks.
        patches: features of patches of the scene's frames.
    """
    height, width = conditioning.base.shape[-2:]
    padding = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)

    def padded(images: Tensor) -> Tensor:
        return functional.pad(images, padding, mode="replicate") if any(padding) else images

    whole = Conditioning(
        padded(conditioning.channels), padded(conditioning.base), padded(conditioning.depth_mm)
    )
    state = padded(noise)
    drawn = torch.full((len(state),), float(drawing), device=state.device)
    answers: list[Predicted] = []
    with torch.no_grad():
        for step in range(steps):
            now, then = 1 - step / steps, 1 - (step + 1) / steps
            time = torch.full((len(state),), now, device=state.device)
            answers.append(
                predict(
                    network, whole, state, time, half_precision=half_precision, drawing=drawn, patches=patches
                )
            )
            clean = (answers[-1].rgb - COLOR_CENTER) / COLOR_SCALE
            if drawing:
                # White noise shifted is white noise anew, and each sample has its own.
                shifts = ((step + 1) * NOISE_SHIFT_PX[0], (step + 1) * NOISE_SHIFT_PX[1])
                state = then * padded(noise.roll(shifts, (-2, -1))) + (1 - then) * clean
            else:
                # The noise implied by the prediction, at the next point of the path.
                state = (then / now) * state + (1 - then / now) * clean
    # Later steps treat texture they drew themselves as observed: depth and error are those of the first.
    return Sampled(
        answers[-1].rgb[..., :height, :width].clamp(0, 1),
        _between(whole.depth_mm, answers[0].log_depth)[..., :height, :width],
        answers[0].log_error[..., :height, :width].exp(),
    )


def _between(filled_mm: Tensor, log_depth: Tensor) -> Tensor:
    """Weighted geometric mean of the smooth filling and the network's depth."""
    filled = filled_mm.clamp_min(1e-6).log()
    return (filled + DEPTH_TRUST * (log_depth - filled)).exp()


def predict(
    network: RestorationNetwork,
    conditioning: Conditioning,
    noisy: Float[Tensor, "n 3 h w"],
    time: Float[Tensor, "n"],
    *,
    half_precision: bool,
    drawing: Float[Tensor, "n"] | None = None,
    patches: PatchFeatures | None = None,
) -> Predicted:
    """What the network says of the clean views, in their units.

    Args:
        network: trained or not.
        conditioning: of N views whose sides are multiples of `SIZE_MULTIPLE`.
        noisy: points of their paths.
        time: where on the paths.
        half_precision: convolutions in bfloat16.
        drawing: 1 for one of the plausible views, 0 for their mean; None is 0.
        patches: features of patches of the scenes' frames.
    """
    with torch.autocast(noisy.device.type, torch.bfloat16, enabled=half_precision):
        answer: Tensor = network(conditioning.channels, noisy, time, drawing, patches)
    color, depth, error = answer.float().split((3, 1, 1), dim=1)
    return Predicted(
        conditioning.base + COLOR_SCALE * color,
        conditioning.depth_mm.clamp_min(1e-6).log() + depth.clamp(-DEPTH_LIMIT, DEPTH_LIMIT),
        math.log(TYPICAL_ERROR) + error.clamp(-LOG_ERROR_LIMIT, LOG_ERROR_LIMIT),
    )
