r"""Training of the restorer's network: losses, and the loop.

The mean of all plausible views and one of them are two tasks of one network. For the mean, every pixel is
compared with the truth. A drawn view is compared pixel by pixel only where something confirms it; what is to
be invented has to agree with the truth in its coarse colours and depth, and to look like it: by a perceptual
distance, and to an adversary (`extrags.restoration.diffusion.adversary`) that learns beside it.
"""

from __future__ import annotations

import json
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
from extrags.restoration.diffusion.adversary import Adversary, Scene
from extrags.restoration.diffusion.network import RestorationNetwork
from extrags.restoration.diffusion.rectified_flow import DEPTH_LIMIT, Predicted, predict
from extrags.restoration.training_data.augmentation import Batch
from extrags.view_synthesis.conditioning import COLOR_CENTER, COLOR_SCALE

__all__ = ["NetworkTraining", "TrainingSettings", "restoration_loss", "train_network"]

PURE_NOISE_SHARE = 0.7
"""Share of training samples at t = 1 exactly, on which the one-step result depends alone."""
TIME_LOGIT_MEAN = 0.3
TIME_LOGIT_DEVIATION = 1.2
STRUCTURE_WEIGHT = 0.1
DEPTH_WEIGHT = 0.1
CHARBONNIER_EPS = 1e-3
COARSE_PX = 8
"""Drawn views are compared with the truth in means over blocks of so many pixels a side."""
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
        drawn_share: share of the steps that train drawing; for generative networks.
        drawn_perceptual_weight: of the perceptual distance in these.
        adversarial_weight: pull of the adversary at invented colours, relative to that of all else in these.
        adversary_rate: learning rate of the adversary.
        drawn_pixel_weight: of the errors of single invented pixels in these, relative to confirmed ones.
        adversary_every: the adversary judges, and learns, in one of so many steps: it takes longer than all
            else.
        adversary_half_precision: its convolutions in bfloat16.
    """

    iterations: int
    learning_rate: float
    half_precision: bool
    perceptual: Lpips | None = None
    perceptual_weight: float = 0.15
    error_weight: float = 0.02
    deterministic: bool = False
    ema_decay: float = 0.995
    drawn_share: float = 0.0
    drawn_perceptual_weight: float = 1.0
    adversarial_weight: float = 1.0
    adversary_rate: float = 4e-4
    drawn_pixel_weight: float = 0.0
    adversary_every: int = 1
    adversary_half_precision: bool = False


class NetworkTraining:
    """A training under way: the network, its running mean, the optimiser, and the adversary.

    Args:
        network: changed in place; on the device it is trained on.
        settings: budget and rates.
        generator: of times and noise, on the processor whatever the device: the draws are the same.
        stage: named in progress events.

    Raises:
        ValueError: when views are to be drawn without a perceptual distance: the adversary uses its backbone.
    """

    def __init__(
        self,
        network: RestorationNetwork,
        settings: TrainingSettings,
        generator: torch.Generator,
        *,
        stage: str = "enhance",
    ) -> None:
        self.network, self.settings, self.generator, self.stage = network, settings, generator, stage
        self.device = next(network.parameters()).device
        self.optimiser = AdamW(network.parameters(), weight_decay=1e-4)
        self.mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
        self.history: list[dict[str, float]] = []
        self.iteration = 0
        self.adversary: Adversary | None = None
        self._told: dict[str, float] = {}
        """The adversary's last loss, which need not be of the step that is reported."""
        if settings.drawn_share > 0:
            if settings.perceptual is None:
                raise ValueError("drawing views is trained with a perceptual distance; none was given")
            probe = torch.zeros(1, 64, 64, 3, device=self.device)
            channels = [tap.shape[1] for tap in settings.perceptual.activations(probe)]
            self.adversary = Adversary(
                channels, settings.adversary_rate, 0, half_precision=settings.adversary_half_precision
            ).to(self.device)
        network.train()

    def step(self, batch: Batch) -> dict[str, float]:
        """One step; returns its losses by name.

        Raises:
            DivergedError: when the loss is not finite.
        """
        settings = self.settings
        batch = batch.to(self.device)
        drawing = (
            settings.drawn_share > 0 and float(torch.rand(1, generator=self.generator)) < settings.drawn_share
        )
        predicted = self._predicted(batch, drawing=drawing)
        if drawing and self.adversary is not None:
            found = self._drawn_step(predicted, batch, self.adversary)
        else:
            loss = restoration_loss(predicted, batch, settings)
            self._check(loss)
            self._descend([loss], [None])
            found = {"loss": float(loss.detach())}
        decay = min(settings.ema_decay, (1 + self.iteration) / (10 + self.iteration))
        with torch.no_grad():
            for name, current in self.network.state_dict().items():
                self.mean[name].lerp_(current, 1 - decay)
        self.iteration += 1
        done = self.iteration == settings.iterations
        if self.iteration % REPORT_EVERY == 0 or done:
            self.history.append({"iteration": float(self.iteration), **found})
            emit(Progress(self.stage, self.iteration, settings.iterations, found))
        return found

    def finished(self) -> RestorationNetwork:
        """The network with the running mean of its weights, ready for use.

        Raises:
            DivergedError: when a weight is not finite.
        """
        self.check_finite()
        self.network.load_state_dict(self.mean)
        self.network.eval()
        return self.network

    def check_finite(self) -> None:
        """Look at the weights: the loss is that before a step, and says nothing of what the last one made.

        Raises:
            DivergedError: when a weight, or its running mean, is not finite.
        """
        for name, value in (*self.network.state_dict().items(), *self.mean.items()):
            if not bool(torch.isfinite(value).all()):
                raise DivergedError(
                    f"{self.stage}: the restorer's weights are not finite after iteration {self.iteration} "
                    f"(parameter group: network, {name})"
                )

    def state(self) -> dict[str, Tensor]:
        """Everything that goes on with `restore`, as tensors on the processor."""
        parts = {
            "network": self.network.state_dict(),
            "mean": self.mean,
            "optimiser": self.optimiser.state(),
            "adversary": {} if self.adversary is None else self.adversary.state(),
        }
        state = {
            f"{part}/{name}": value.detach().cpu().contiguous()
            for part, values in parts.items()
            for name, value in values.items()
        }
        history = torch.frombuffer(bytearray(json.dumps(self.history).encode()), dtype=torch.uint8)
        return {**state, "iteration": torch.tensor(self.iteration), "history": history}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on where `state` was taken, on this or another device.

        Raises:
            KeyError: when it is of another network.
        """

        def part(name: str) -> dict[str, Tensor]:
            prefix = f"{name}/"
            return {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}

        self.network.load_state_dict(part("network"))
        for name, value in part("mean").items():
            self.mean[name].copy_(value)
        self.optimiser.restore(part("optimiser"))
        if self.adversary is not None:
            self.adversary.restore(part("adversary"))
        self.iteration = int(state["iteration"])
        if "history" in state:
            # Checkpoints of an earlier version have none.
            self.history = json.loads(bytes(state["history"].cpu().numpy()))

    def _predicted(self, batch: Batch, *, drawing: bool) -> Predicted:
        count = len(batch.clean)
        clean = (batch.clean - COLOR_CENTER) / COLOR_SCALE
        logits = TIME_LOGIT_MEAN + TIME_LOGIT_DEVIATION * torch.randn(count, generator=self.generator)
        pure = torch.rand(count, generator=self.generator) < PURE_NOISE_SHARE
        noise = torch.randn(clean.shape, generator=self.generator)
        if self.settings.deterministic:
            pure, noise = torch.ones_like(pure), torch.zeros_like(noise)
        time = torch.where(pure, torch.ones(()), logits.sigmoid()).to(self.device)
        mix = time[:, None, None, None]
        noisy = (1 - mix) * clean + mix * noise.to(self.device)
        half = self.settings.half_precision
        patches, drawn = None, None
        if self.network.generative:
            drawn = torch.full_like(time, float(drawing))
            if batch.patches is not None:
                with torch.autocast(noisy.device.type, torch.bfloat16, enabled=half):
                    patches = self.network.texture.encode((batch.patches - COLOR_CENTER) / COLOR_SCALE)
        return predict(
            self.network, batch.conditioning, noisy, time, half_precision=half, drawing=drawn, patches=patches
        )

    def _drawn_step(self, predicted: Predicted, batch: Batch, adversary: Adversary) -> dict[str, float]:
        """A step of drawing, and the adversary's answer to it."""
        settings = self.settings
        if settings.perceptual is None:
            raise ValueError("drawing views is trained with a perceptual distance; none was given")
        weight, clean = batch.weight, batch.clean
        # Where the truth is unknown, both images are made equal.
        shown = (weight * predicted.rgb + (1 - weight) * clean).clamp(0, 1)
        scene = Scene(batch.conditioning.base, batch.invented * weight)
        with torch.autocast(clean.device.type, torch.bfloat16, enabled=settings.half_precision):
            images = torch.cat([shown, clean]).permute(0, 2, 3, 1)
            activations = [tap.float() for tap in settings.perceptual.activations(images)]
        perceptual = sum(
            (layer.mean((-2, -1)).mean() for layer in settings.perceptual.compared(activations)),
            start=torch.zeros((), device=self.device),
        )
        faithful = (
            drawn_loss(predicted, batch, settings.drawn_pixel_weight)
            + settings.drawn_perceptual_weight * perceptual
        )
        self._check(faithful)
        further = _depth_and_error(predicted, batch, settings)
        found = {"drawn_loss": float(faithful.detach()), "drawn_perceptual": float(perceptual.detach())}
        if self.iteration % settings.adversary_every:
            self._descend([faithful + further], [None])
            return {**found, **self._told}
        own, true = zip(*(tap.chunk(2) for tap in activations), strict=True)
        adversary.requires_grad_(False)
        deceiving = adversary.generator_loss(shown, list(own), scene)
        adversary.requires_grad_(True)
        # Both pull at the colours; where they are invented, as strongly as the settings say, whatever the
        # scale of the adversary's verdicts is at this stage of its own training.
        (towards,) = torch.autograd.grad(faithful, predicted.rgb, retain_graph=True)
        (away,) = torch.autograd.grad(deceiving, predicted.rgb)
        pulls = [(pull * scene.invented).norm() for pull in (towards, away)]
        balance = settings.adversarial_weight * pulls[0] / pulls[1].clamp_min(1e-12)
        self._descend([predicted.rgb, further], [towards + balance * away, None])
        told = adversary.step(
            (shown.detach(), [tap.detach() for tap in own]), (clean, [tap.detach() for tap in true]), scene
        )
        self._told = {"adversary": told}
        return {**found, **self._told}

    def _check(self, loss: Tensor) -> None:
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DivergedError(
                f"{self.stage}: the restorer's loss is {value} at iteration {self.iteration} "
                "(parameter group: network)"
            )

    def _descend(self, outputs: list[Tensor], gradients: list[Tensor | None]) -> None:
        torch.autograd.backward(outputs, gradients)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_LIMIT)
        settings = self.settings
        self.optimiser.step(settings.learning_rate * _rate(self.iteration, settings.iterations))


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
        DivergedError: when the loss or a weight stops being finite.
    """
    training = NetworkTraining(network, settings, generator, stage=stage)
    for _ in range(settings.iterations):
        training.step(draw())
    return training.finished(), training.history


def _rate(iteration: int, iterations: int) -> float:
    warm_up = min(WARM_UP, max(1, iterations // 5))
    if iteration < warm_up:
        return (iteration + 1) / warm_up
    share = (iteration - warm_up) / max(1, iterations - warm_up)
    return 0.5 * (1 + math.cos(math.pi * share))


def restoration_loss(predicted: Predicted, batch: Batch, settings: TrainingSettings) -> Float[Tensor, ""]:
    """Loss of the mean view, averaged over valid pixels; see docs/algorithms/restoration.md."""
    weight, clean = batch.weight, batch.clean
    total = weight.sum().clamp_min(1e-6)
    charbonnier = (_charbonnier(predicted.rgb, clean) * weight).sum()
    similarity = ssim_map(predicted.rgb.permute(0, 2, 3, 1), clean.permute(0, 2, 3, 1), figures=False)
    structure = ((1 - similarity) * weight[:, 0]).sum()
    loss: Tensor = (charbonnier + STRUCTURE_WEIGHT * structure) / total
    loss = loss + _depth_and_error(predicted, batch, settings)
    if settings.perceptual is not None:
        # Where the truth is unknown, both images are made equal.
        shown = (weight * predicted.rgb + (1 - weight) * clean).clamp(0, 1)
        distance = settings.perceptual.distance(shown.permute(0, 2, 3, 1), clean.permute(0, 2, 3, 1))
        loss = loss + settings.perceptual_weight * distance.mean()
    return loss


def drawn_loss(predicted: Predicted, batch: Batch, pixel_weight: float = 0.0) -> Float[Tensor, ""]:
    """What the colours of a drawn view owe to the truth: confirmed pixels, the others in coarse means.

    Args:
        predicted: drawn views.
        batch: with the truth.
        pixel_weight: of single pixels that are invented, relative to confirmed ones.
    """
    weight = batch.weight
    confirmed = weight * (1 - (1 - pixel_weight) * batch.invented)
    difference = _charbonnier(predicted.rgb, batch.clean)
    exact = (difference * confirmed).sum() / weight.sum().clamp_min(1e-6)
    side = min(COARSE_PX, *predicted.rgb.shape[-2:])
    share = functional.avg_pool2d(weight, side)
    means = [functional.avg_pool2d(image * weight, side) for image in (predicted.rgb, batch.clean)]
    apart = _charbonnier(*(mean / share.clamp_min(1e-6) for mean in means))
    coarse = (apart * share).sum() / share.sum().clamp_min(1e-6)
    return exact + coarse


def _charbonnier(first: Tensor, second: Tensor) -> Float[Tensor, "n 1 h w"]:
    difference = (first - second) / COLOR_SCALE
    return (difference.square() + CHARBONNIER_EPS**2).sqrt().mean(dim=1, keepdim=True)


def _depth_and_error(predicted: Predicted, batch: Batch, settings: TrainingSettings) -> Float[Tensor, ""]:
    """Error of the log-depth, and the likelihood of the colours' error under the expected one."""
    weight = batch.weight
    known = (batch.depth_mm > 0).to(weight)
    depth = (predicted.log_depth - batch.depth_mm.clamp_min(1e-6).log()).abs().clamp(max=DEPTH_LIMIT) * known
    error = (predicted.rgb.detach() - batch.clean).abs().mean(dim=1, keepdim=True)
    likelihood = ((error * (-predicted.log_error).exp() + predicted.log_error) * weight).sum()
    loss: Tensor = DEPTH_WEIGHT * depth.sum() / known.sum().clamp_min(1e-6)
    return loss + settings.error_weight * likelihood / weight.sum().clamp_min(1e-6)
