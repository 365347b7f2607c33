r"""Conditional diffusion on a straight path, and its training.

With the clean image z_0 and noise e, both normalised, :math:`z_t = (1 - t) z_0 + t e` for t from 0 to 1,
and the network predicts z_0 as a residual to the base image. This is the paper's prior (equations 3 and
4) in another parametrisation of the same Gaussian family: a signal-to-noise ratio per t, and a
prediction from which the noise follows. At t = 1 there is no signal, so a single step is a regression;
several steps are DDIM's deterministic sampler in terms of the path.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.enhance.conditioning import COLOR_CENTER, COLOR_SCALE, Conditioning
from extrags.enhance.network import SIZE_MULTIPLE, RestorationNetwork
from extrags.errors import DivergedError
from extrags.events import Progress, emit
from extrags.metrics.image import ssim_map

__all__ = ["Batch", "TrainingSettings", "restoration_loss", "sample", "train_network"]

PURE_NOISE_SHARE = 0.7
"""Share of training samples at t = 1 exactly: they alone make the one-step result."""
TIME_LOGIT_MEAN = 0.3
TIME_LOGIT_DEVIATION = 1.2
STRUCTURE_WEIGHT = 0.1
CHARBONNIER_EPS = 1e-3
WARM_UP = 30
GRADIENT_LIMIT = 1.0
EMA_DECAY = 0.995
REPORT_EVERY = 10


@dataclass(frozen=True)
class Batch:
    """Crops to learn from.

    Args:
        conditioning: network input and base image.
        clean: what the view really looked like, in [0, 1], [N, 3, H, W].
        weight: of each pixel's error, [N, 1, H, W].
    """

    conditioning: Conditioning
    clean: Float[Tensor, "n 3 h w"]
    weight: Float[Tensor, "n 1 h w"]


@dataclass(frozen=True)
class TrainingSettings:
    """Budget and rate of a training.

    Args:
        iterations: steps.
        learning_rate: the peak, after the warm-up.
        half_precision: convolutions in bfloat16.
    """

    iterations: int
    learning_rate: float
    half_precision: bool


def train_network(
    network: RestorationNetwork,
    draw: Callable[[], Batch],
    settings: TrainingSettings,
    generator: torch.Generator,
    *,
    stage: str = "enhance",
) -> tuple[RestorationNetwork, list[dict[str, float]]]:
    """Fit the network; returns its running mean, and the loss every few steps.

    AdamW with warm-up and cosine decay, gradients clipped, exponential mean of the weights with a short
    memory at the start.

    Args:
        network: changed in place.
        draw: gives the next batch.
        settings: budget and rate.
        generator: of times and noise.
        stage: named in progress events.

    Raises:
        DivergedError: when the loss stops being finite.
    """
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=1e-4)
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    history: list[dict[str, float]] = []
    for iteration in range(settings.iterations):
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * _rate(iteration, settings.iterations)
        batch = draw()
        loss = _diffusion_loss(network, batch, generator, half_precision=settings.half_precision)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DivergedError(
                f"{stage}: the restorer's loss is {value} at iteration {iteration} (parameter group: network)"
            )
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_LIMIT)
        optimiser.step()
        decay = min(EMA_DECAY, (1 + iteration) / (10 + iteration))
        with torch.no_grad():
            for name, current in network.state_dict().items():
                mean[name].lerp_(current, 1 - decay)
        if (iteration + 1) % REPORT_EVERY == 0 or iteration == settings.iterations - 1:
            history.append({"iteration": float(iteration), "loss": value})
            emit(Progress(stage, iteration + 1, settings.iterations, {"loss": value}))
    network.load_state_dict(mean)
    network.eval()
    return network, history


def _rate(iteration: int, iterations: int) -> float:
    warm_up = min(WARM_UP, max(1, iterations // 5))
    if iteration < warm_up:
        return (iteration + 1) / warm_up
    share = (iteration - warm_up) / max(1, iterations - warm_up)
    return 0.5 * (1 + math.cos(math.pi * share))


def _diffusion_loss(
    network: RestorationNetwork, batch: Batch, generator: torch.Generator, *, half_precision: bool
) -> Tensor:
    count = len(batch.clean)
    clean = (batch.clean - COLOR_CENTER) / COLOR_SCALE
    logits = TIME_LOGIT_MEAN + TIME_LOGIT_DEVIATION * torch.randn(count, generator=generator)
    pure = torch.rand(count, generator=generator) < PURE_NOISE_SHARE
    time = torch.where(pure, torch.ones(()), logits.sigmoid())
    noise = torch.randn(clean.shape, generator=generator)
    mix = time[:, None, None, None]
    noisy = (1 - mix) * clean + mix * noise
    predicted = _predict(network, batch.conditioning, noisy, time, half_precision=half_precision)
    return restoration_loss(predicted * COLOR_SCALE + COLOR_CENTER, batch.clean, batch.weight)


def restoration_loss(
    predicted: Float[Tensor, "n 3 h w"], clean: Float[Tensor, "n 3 h w"], weight: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, ""]:
    """Charbonnier on normalised colours plus a tenth of 1 - SSIM, both averaged over weighted pixels."""
    total = weight.sum().clamp_min(1e-6)
    difference = (predicted - clean) / COLOR_SCALE
    charbonnier = ((difference.square() + CHARBONNIER_EPS**2).sqrt().mean(dim=1, keepdim=True) * weight).sum()
    similarity = ssim_map(predicted.permute(0, 2, 3, 1), clean.permute(0, 2, 3, 1))
    structure = ((1 - similarity) * weight[:, 0]).sum()
    return (charbonnier + STRUCTURE_WEIGHT * structure) / total


def sample(
    network: RestorationNetwork,
    conditioning: Conditioning,
    noise: Float[Tensor, "n 3 h w"],
    *,
    steps: int,
    half_precision: bool,
) -> Float[Tensor, "n 3 h w"]:
    """Restore images in a fixed number of steps.

    Args:
        network: trained.
        conditioning: of N views; any size, padded inside to what the network needs.
        noise: where the path starts; the same noise gives the same image.
        steps: 1 is a regression, more draw texture.
        half_precision: convolutions in bfloat16.

    Returns:
        Colours in [0, 1].
    """
    height, width = conditioning.base.shape[-2:]
    padding = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)

    def padded(images: Tensor) -> Tensor:
        return functional.pad(images, padding, mode="replicate") if any(padding) else images

    whole = Conditioning(
        padded(conditioning.channels), padded(conditioning.base), padded(conditioning.depth_mm)
    )
    state = padded(noise)
    clean = state
    with torch.no_grad():
        for step in range(steps):
            now, then = 1 - step / steps, 1 - (step + 1) / steps
            time = torch.full((len(state),), now)
            clean = _predict(network, whole, state, time, half_precision=half_precision)
            # The noise implied by the prediction, at the next point of the path.
            state = (then / now) * state + (1 - then / now) * clean
    return (clean[..., :height, :width] * COLOR_SCALE + COLOR_CENTER).clamp(0, 1)


def _predict(
    network: RestorationNetwork,
    conditioning: Conditioning,
    noisy: Tensor,
    time: Tensor,
    *,
    half_precision: bool,
) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16, enabled=half_precision):
        residual: Tensor = network(conditioning.channels, noisy, time)
    return (conditioning.base - COLOR_CENTER) / COLOR_SCALE + residual.float()
