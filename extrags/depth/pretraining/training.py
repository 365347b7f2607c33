"""Optimisation of the completion network on examples, and its scores."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from extrags.depth.completion import MASK, RAYS, RGB, SOURCES, STEREO, CompletionNetwork, completion_loss
from extrags.depth.pretraining.examples import Examples
from extrags.errors import DivergedError

__all__ = [
    "CompletionTraining",
    "ExampleBank",
    "Scores",
    "matched",
    "mix_weights",
    "score",
    "train_completion",
    "unmatched",
]


Loss = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], dict[str, Tensor]]
"""From channels, log-depth, log-error, truth, and where that is known: terms of the loss."""


@dataclass(frozen=True)
class CompletionTraining:
    """Budget and rates.

    Args:
        iterations: optimisation steps.
        batch: frames per step.
        learning_rate: peak, after the warm-up; it falls as a cosine.
        slope_weight: of the term `slope` of `completion_loss`.
        error_weight: of its term `error`.
        ema_decay: memory of the running mean of the weights, which is the result.
        seconds: wall time after which it ends if the iterations are not done; the rate falls in time.
    """

    iterations: int = 20_000
    batch: int = 48
    learning_rate: float = 1.5e-3
    slope_weight: float = 1.0
    error_weight: float = 0.1
    ema_decay: float = 0.999
    seconds: float = math.inf


class ExampleBank:
    """Examples of several sizes, drawn at random with flips and changes of colour.

    Args:
        generator: source of randomness, on the examples' device.
    """

    def __init__(self, generator: torch.Generator) -> None:
        self._generator = generator
        self._parts: dict[tuple[int, int], list[Examples]] = {}
        self._joined: dict[tuple[int, int], Examples] = {}

    def __len__(self) -> int:
        return sum(len(part.truth) for parts in self._parts.values() for part in parts)

    def add(self, examples: Examples) -> None:
        """Take in more examples."""
        size = (int(examples.truth.shape[1]), int(examples.truth.shape[2]))
        self._parts.setdefault(size, []).append(examples)
        self._joined.pop(size, None)

    def all_of_size(self) -> list[Examples]:
        """All examples, one entry per size."""
        for size, parts in self._parts.items():
            if size not in self._joined:
                self._joined[size] = Examples(
                    *(torch.cat([getattr(p, name) for p in parts]) for name in ("channels", "truth", "known"))
                )
                self._parts[size] = [self._joined[size]]
        return [self._joined[size] for size in self._parts]

    def draw(self, batch: int) -> tuple[Tensor, Tensor, Tensor]:
        """A batch of one size: channels, truth, known."""
        groups = self.all_of_size()
        device = self._generator.device
        shares = torch.tensor([float(len(group.truth)) for group in groups], device=device)
        group = groups[int(torch.multinomial(shares, 1, generator=self._generator))]
        rows = torch.randint(len(group.truth), (batch,), generator=self._generator, device=device)
        channels = group.channels[rows].float()
        truth, known = group.truth[rows].float(), group.known[rows].float()
        flips = torch.rand(2, generator=self._generator, device=device).tolist()
        for axis, (dim, coin) in enumerate(zip((3, 2), flips, strict=True)):
            if coin < 0.5:
                channels = channels.flip(dim)
                truth, known = truth.flip(dim - 1), known.flip(dim - 1)
                channels[:, RAYS.start + axis] *= -1
        if float(torch.rand(1, generator=self._generator, device=device)) < 0.3:
            channels = channels.transpose(2, 3)
            truth, known = truth.transpose(1, 2), known.transpose(1, 2)
            channels = torch.cat(
                [channels[:, : RAYS.start], channels[:, RAYS].flip(1), channels[:, RAYS.stop :]], dim=1
            )
        return self._recolored(channels).contiguous(), truth.contiguous(), known.contiguous()

    def _recolored(self, channels: Tensor) -> Tensor:
        n, device = len(channels), channels.device

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(*shape, generator=self._generator, device=device)

        rgb = (channels[:, RGB] + 0.5).clamp(1e-4, 1)
        order = torch.randperm(3, generator=self._generator, device=device)
        rgb = rgb[:, order] if float(uniform(0.0, 1.0, 1)) < 0.3 else rgb
        rgb = (rgb * uniform(0.7, 1.2, n, 3, 1, 1)).clamp(1e-4, 1) ** uniform(0.7, 1.4, n, 1, 1, 1)
        inside = channels[:, MASK : MASK + 1]
        return torch.cat([(rgb - 0.5) * inside, channels[:, RGB.stop :]], dim=1)


def train_completion(
    bank: ExampleBank,
    settings: CompletionTraining,
    network: CompletionNetwork | None = None,
    *,
    told: Callable[[int, dict[str, float]], None] | None = None,
    half: bool = False,
    loss: Loss | None = None,
) -> CompletionNetwork:
    """Train on examples; the running mean of the weights is returned.

    Args:
        bank: the examples.
        settings: budget and rates.
        network: to train further; None starts anew.
        told: called every hundred iterations with the mean loss terms since.
        half: compute in bfloat16 where it is safe.
        loss: terms of the loss, from the channels and what `completion_loss` is given, which is the default.

    Raises:
        DivergedError: when the loss stops being finite, or a weight is not finite at the end.
    """
    device = bank.all_of_size()[0].truth.device
    network = CompletionNetwork() if network is None else network
    network = network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(network)
    optimiser = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=1e-4)

    begun = time.monotonic()
    sums: dict[str, Tensor] = {}
    for iteration in range(settings.iterations):
        spent = max(iteration / settings.iterations, (time.monotonic() - begun) / settings.seconds)
        if spent >= 1:
            break
        warm = min(1.0, (iteration + 1) / 300)
        falling = warm * 0.5 * (1 + math.cos(math.pi * spent)) + 1e-3
        optimiser.param_groups[0]["lr"] = settings.learning_rate * falling
        channels, truth, known = bank.draw(settings.batch)
        channels = channels.contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            log_depth, log_error = network(channels)
        if loss is None:
            terms = completion_loss(log_depth, log_error, truth, known)
        else:
            terms = loss(channels, log_depth, log_error, truth, known)
        total = (
            terms["depth"] + settings.slope_weight * terms["slope"] + settings.error_weight * terms["error"]
        )
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        with torch.no_grad():
            decay = min(settings.ema_decay, (iteration + 1) / (iteration + 10))
            torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1 - decay)
        for name, value in terms.items():
            sums[name] = sums.get(name, torch.zeros((), device=device)) + value.detach()
        if (iteration + 1) % 100 == 0:
            means = {name: float(value) / 100 for name, value in sums.items()}
            if not all(mean == mean and abs(mean) < 1e6 for mean in means.values()):
                raise DivergedError(f"pretraining of the depth completion: loss {means} at {iteration + 1}")
            sums = {}
            if told is not None:
                told(iteration + 1, means)
    # The loss was looked at every hundred iterations, and not at all of what the last one made.
    for name, value in average.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise DivergedError(f"pretraining of the depth completion: {name} is not finite at the end")
    return average


@torch.no_grad()
def mix_weights(network: CompletionNetwork, start: dict[str, Tensor], keep: float) -> None:
    """Move a network's weights back towards those that its training started from.

    On scenes unlike the practice of either training, the mean of both is better than both.

    Args:
        network: trained; changed in place.
        start: weights that it started from, by name.
        keep: share of these in the result, in [0, 1].

    Source: M. Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022.
    """
    for name, value in network.state_dict().items():
        value.lerp_(start[name].to(value), keep)


@dataclass(frozen=True)
class Scores:
    """How good a completion is on examples.

    Args:
        absrel: mean relative error of the completed depth, each frame as it is.
        stereo_absrel: of the stereo that went in.
        within: share of pixels with a relative error below 5 %.
        rank_correlation: Spearman's, of expected and true error over pixels.
        calibration: mean true error over mean expected error.
    """

    absrel: float
    stereo_absrel: float
    within: float
    rank_correlation: float
    calibration: float


@torch.no_grad()
def score(network: CompletionNetwork, examples: list[Examples], chunk: int = 32) -> Scores:
    """Score a network on examples that it was not trained on."""
    errors, stereo, expected = [], [], []
    for group in examples:
        for rows in torch.arange(len(group.truth), device=group.truth.device).split(chunk):
            channels = group.channels[rows].float()
            log_depth, log_error = network(channels)
            known = group.known[rows] > 0
            truth = group.truth[rows].float()
            errors.append(((log_depth - truth).exp() - 1).abs()[known])
            stereo.append(((channels[:, STEREO] - truth).exp() - 1).abs()[known])
            expected.append(log_error.exp()[known])
    error, before, told = torch.cat(errors), torch.cat(stereo), torch.cat(expected)
    ranks = [values.argsort().argsort().double() for values in (error, told)]
    correlation = torch.corrcoef(torch.stack(ranks))[0, 1]
    return Scores(
        float(error.mean()),
        float(before.mean()),
        float((error < 0.05).float().mean()),
        float(correlation),
        float(error.mean() / told.mean()),
    )


def matched(examples: list[Examples]) -> list[Examples]:
    """Those of frames that have sources."""
    return [_chosen(group, ~_alone(group)) for group in examples]


def unmatched(examples: list[Examples]) -> list[Examples]:
    """Those of frames that nothing was matched with."""
    return [_chosen(group, _alone(group)) for group in examples]


def _alone(group: Examples) -> Tensor:
    return group.channels[:, SOURCES].flatten(1).amax(dim=1) == 0


def _chosen(group: Examples, rows: Tensor) -> Examples:
    return Examples(group.channels[rows], group.truth[rows], group.known[rows])
