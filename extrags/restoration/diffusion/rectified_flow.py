r"""Conditional diffusion along straight paths (rectified flow): training and sampling.

With the clean image z_0 and noise e, both normalised, :math:`z_t = (1 - t) z_0 + t e` for t from 0 to 1,
and the network predicts z_0 as a residual to the base image. This is the diffusion prior of [ExtraGS, eq. 4
and 5] in another parametrisation of the same Gaussian family: a signal-to-noise ratio per t, and a
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

from extrags.errors import DivergedError
from extrags.events import Progress, emit
from extrags.metrics.image import ssim_map
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion.adamw import AdamW
from extrags.restoration.diffusion.network import SIZE_MULTIPLE, RestorationNetwork
from extrags.restoration.training_data.augmentation import Batch
from extrags.view_synthesis.conditioning import COLOR_CENTER, COLOR_SCALE, Conditioning

__all__ = [
    "Predicted",
    "Sampled",
    "TrainingSettings",
    "restoration_loss",
    "sample",
    "train_network",
]

PURE_NOISE_SHARE = 0.7
"""Share of training samples at t = 1 exactly, on which the one-step result depends alone."""
TIME_LOGIT_MEAN = 0.3
TIME_LOGIT_DEVIATION = 1.2
STRUCTURE_WEIGHT = 0.1
DEPTH_WEIGHT = 0.1
CHARBONNIER_EPS = 1e-3
DEPTH_LIMIT = 1.5
"""Largest correction of a log-depth, and largest error that counts in the loss."""
DEPTH_TRUST = 0.5
"""Weight of the network's depth against the smooth filling. In the holes of virtual views each is wrong by
14 %, with different errors; their mean is better."""
TYPICAL_ERROR = 0.05
LOG_ERROR_LIMIT = 4.0
"""The expected error starts at the typical one and stays within a factor of e to this power."""
WARM_UP = 30
GRADIENT_LIMIT = 1.0
REPORT_EVERY = 10


@dataclass(frozen=True)
class TrainingSettings:
    """Budget and rate of a training.

    Args:
        iterations: steps.
        learning_rate: the peak, after the warm-up.
        half_precision: convolutions in bfloat16.
        perceptual: a perceptual distance added to the loss; None without.
        perceptual_weight: of that distance.
        error_weight: of the expected error's likelihood.
        deterministic: no noise, one step only: the same network as a plain regression.
        ema_decay: memory of the running mean of the weights.
    """

    iterations: int
    learning_rate: float
    half_precision: bool
    perceptual: Lpips | None = None
    perceptual_weight: float = 0.15
    error_weight: float = 0.02
    deterministic: bool = False
    ema_decay: float = 0.995


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
    optimiser = AdamW(network.parameters(), weight_decay=1e-4)
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    history: list[dict[str, float]] = []
    for iteration in range(settings.iterations):
        batch = draw()
        loss = _diffusion_loss(network, batch, generator, settings)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DivergedError(
                f"{stage}: the restorer's loss is {value} at iteration {iteration} (parameter group: network)"
            )
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_LIMIT)
        optimiser.step(settings.learning_rate * _rate(iteration, settings.iterations))
        decay = min(settings.ema_decay, (1 + iteration) / (10 + iteration))
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
    network: RestorationNetwork, batch: Batch, generator: torch.Generator, settings: TrainingSettings
) -> Tensor:
    count = len(batch.clean)
    clean = (batch.clean - COLOR_CENTER) / COLOR_SCALE
    logits = TIME_LOGIT_MEAN + TIME_LOGIT_DEVIATION * torch.randn(count, generator=generator)
    pure = torch.rand(count, generator=generator) < PURE_NOISE_SHARE
    noise = torch.randn(clean.shape, generator=generator)
    if settings.deterministic:
        pure, noise = torch.ones_like(pure), torch.zeros_like(noise)
    time = torch.where(pure, torch.ones(()), logits.sigmoid())
    mix = time[:, None, None, None]
    noisy = (1 - mix) * clean + mix * noise
    predicted = _predict(network, batch.conditioning, noisy, time, half_precision=settings.half_precision)
    return restoration_loss(predicted, batch, settings)


def restoration_loss(predicted: Predicted, batch: Batch, settings: TrainingSettings) -> Float[Tensor, ""]:
    r"""Loss of a prediction, averaged over weighted pixels.

    Charbonnier on normalised colours, a tenth of 1 - SSIM, the absolute error of the log-depth, and for
    the expected error :math:`b` of a pixel with error :math:`e` the negative log-likelihood
    :math:`e / b + \log b` of Laplace; no gradient reaches the colours through :math:`e`. A perceptual
    distance may be added.

    Args:
        predicted: output of the network.
        batch: the truth.
        settings: the perceptual distance, if any, and the weights.

    Source: for the expected error, Kendall and Gal: What Uncertainties Do We Need in Bayesian Deep
    Learning for Computer Vision?, NeurIPS 2017, equation 5 with a Laplace likelihood.
    """
    weight, clean = batch.weight, batch.clean
    total = weight.sum().clamp_min(1e-6)
    difference = (predicted.rgb - clean) / COLOR_SCALE
    charbonnier = ((difference.square() + CHARBONNIER_EPS**2).sqrt().mean(dim=1, keepdim=True) * weight).sum()
    similarity = ssim_map(predicted.rgb.permute(0, 2, 3, 1), clean.permute(0, 2, 3, 1))
    structure = ((1 - similarity) * weight[:, 0]).sum()
    known = (batch.depth_mm > 0).to(weight)
    depth = (predicted.log_depth - batch.depth_mm.clamp_min(1e-6).log()).abs().clamp(max=DEPTH_LIMIT) * known
    error = (predicted.rgb.detach() - clean).abs().mean(dim=1, keepdim=True)
    predicted_error = ((error * (-predicted.log_error).exp() + predicted.log_error) * weight).sum()
    loss: Tensor = (
        charbonnier + STRUCTURE_WEIGHT * structure + settings.error_weight * predicted_error
    ) / total
    loss = loss + DEPTH_WEIGHT * depth.sum() / known.sum().clamp_min(1e-6)
    if settings.perceptual is not None:
        # Where the truth is unknown, both images are made equal.
        shown = (weight * predicted.rgb + (1 - weight) * clean).clamp(0, 1)
        distance = settings.perceptual.distance(shown.permute(0, 2, 3, 1), clean.permute(0, 2, 3, 1))
        loss = loss + settings.perceptual_weight * distance.mean()
    return loss


def sample(
    network: RestorationNetwork,
    conditioning: Conditioning,
    noise: Float[Tensor, "n 3 h w"],
    *,
    steps: int,
    half_precision: bool,
) -> Sampled:
    """Restore views in a fixed number of steps.

    Args:
        network: trained.
        conditioning: of N views; any size, padded inside to what the network needs.
        noise: where the path starts; the same noise gives the same image.
        steps: 1 is a regression, more draw texture.
        half_precision: convolutions in bfloat16.
    """
    height, width = conditioning.base.shape[-2:]
    padding = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)

    def padded(images: Tensor) -> Tensor:
        return functional.pad(images, padding, mode="replicate") if any(padding) else images

    whole = Conditioning(
        padded(conditioning.channels), padded(conditioning.base), padded(conditioning.depth_mm)
    )
    state = padded(noise)
    answers: list[Predicted] = []
    with torch.no_grad():
        for step in range(steps):
            now, then = 1 - step / steps, 1 - (step + 1) / steps
            time = torch.full((len(state),), now)
            answers.append(_predict(network, whole, state, time, half_precision=half_precision))
            # The noise implied by the prediction, at the next point of the path.
            clean = (answers[-1].rgb - COLOR_CENTER) / COLOR_SCALE
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


def _predict(
    network: RestorationNetwork,
    conditioning: Conditioning,
    noisy: Tensor,
    time: Tensor,
    *,
    half_precision: bool,
) -> Predicted:
    with torch.autocast("cpu", torch.bfloat16, enabled=half_precision):
        answer: Tensor = network(conditioning.channels, noisy, time)
    color, depth, error = answer.float().split((3, 1, 1), dim=1)
    return Predicted(
        conditioning.base + COLOR_SCALE * color,
        conditioning.depth_mm.clamp_min(1e-6).log() + depth.clamp(-DEPTH_LIMIT, DEPTH_LIMIT),
        math.log(TYPICAL_ERROR) + error.clamp(-LOG_ERROR_LIMIT, LOG_ERROR_LIMIT),
    )
