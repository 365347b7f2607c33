"""Rows of the optimiser: Adam and densification, and a whole training in float32 beside float64."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from extrags.config import DensifyConfig
from extrags.raster.adam import SelectiveAdam
from extrags.stress.inputs import LitScene, random_lit_scene
from extrags.stress.rows import (
    EPS,
    EXACT,
    FINITE,
    Effort,
    Row,
    Trial,
    all_finite,
    differs,
    finite_or_refused,
    with_threads,
)
from extrags.stress.steps import autograd_step, native_step
from extrags.training.density import DefaultStrategy
from extrags.training.relocation import MCMCStrategy, compute_relocation

__all__ = ["CHECKPOINTS", "ROWS", "Drift", "training_drift"]

CHECKPOINTS = (1_000, 5_000, 15_000)
"""Iterations at which drift is told."""

RATES = {"means": 1.6e-3, "quats": 1e-3, "scales": 5e-3, "opacities": 2.5e-2, "sh": 2.5e-3}
ADAM_ROUNDINGS = 32.0
"""Roundings of a step of Adam, relative to the step: four of the moments, two of the bias, root, quotient,
with a margin; the value itself is rounded once to its own size."""
SAME_LOSS = 0.01
"""Trainings whose losses differ by this share are equally good."""
OTHER_START = EPS
"""Relative change of a scene by which the starts of the float64 trainings differ."""
OTHERS = 4
"""Float64 trainings beside the exact one: together they tell how far trainings come apart by themselves."""
LOSS_WINDOW_SHARE = 0.05
"""The loss of an iteration is the mean over so many of the iterations before it: with a fixed rate, that of a
single step of Adam leaps."""
FALSE_ALARM = 0.01
"""Chance that a training which is as good as those in float64 fails at any of the iterations told."""


def _steps_of(iterations: int) -> list[int]:
    return [count for count in CHECKPOINTS if count <= iterations] or [iterations]


def _adam(strength: float, effort: Effort) -> Iterator[Trial]:
    """Drift of float32 Adam from float64, in multiples of the bound on rounding, at each checkpoint."""
    generator = torch.Generator().manual_seed(int(1e6 * abs(math.log10(strength))))
    start = torch.randn(64, 3, generator=generator)
    adam = SelectiveAdam({"value": start.clone().requires_grad_()}, {"value": 1e-3})
    exact = start.double().requires_grad_()
    reference = torch.optim.Adam([exact], lr=1e-3, eps=1e-15)
    largest, checkpoints = float(start.abs().max()), _steps_of(effort.iterations)
    for iteration in range(1, checkpoints[-1] + 1):
        gradient = strength * torch.randn(64, 3, generator=generator)
        exact.grad = gradient.double()
        reference.step()
        adam.step(None, {"value": gradient})
        largest = max(largest, float(exact.detach().abs().max()))
        if iteration in checkpoints:
            bound = iteration * (0.5 * EPS * largest + ADAM_ROUNDINGS * EPS * 1e-3)
            drift = float((adam.parameters["value"].detach().double() - exact.detach()).abs().max())
            yield f"{iteration} steps, drift {drift:.1e}", drift / bound


def _adam_extremes(effort: Effort) -> Iterator[Trial]:
    for strength in (0.0, 1e-45, 1e-38, 1e-30, 1e-20, 1e-10, 1.0, 1e10, 1e18):
        for alternating in (False, True):
            adam = SelectiveAdam({"value": torch.ones(8, 3).requires_grad_()}, {"value": 1e-3})
            for iteration in range(50):
                sign = -1.0 if alternating and iteration % 2 else 1.0
                adam.step(None, {"value": torch.full((8, 3), sign * strength)})
            state = [adam.parameters, adam.first_moments, adam.second_moments]
            moved = float((adam.parameters["value"].detach() - 1).abs().max())
            # A step is about a learning rate long at most, whatever the gradient.
            good = all_finite(state) and moved <= 50 * 1e-3 * 1.01
            yield f"gradients {strength:g}{', alternating' if alternating else ''}", 0.0 if good else math.inf


def _adam_repeat(effort: Effort) -> Iterator[Trial]:
    def run() -> Tensor:
        generator = torch.Generator().manual_seed(1)
        adam = SelectiveAdam({"v": torch.randn(20_000, 3, generator=generator).requires_grad_()}, {"v": 1e-3})
        for _ in range(5):
            visible = torch.rand(20_000, generator=generator) < 0.5
            adam.step(visible, {"v": torch.randn(20_000, 3, generator=generator)})
        return adam.parameters["v"].detach()

    first = with_threads(1, run)
    for threads in (1, 2, 3, 8):
        yield f"{threads} threads", differs(with_threads(threads, run), first)


def _exact_relocation(opacity: float, copies: int) -> tuple[float, float]:
    """New opacity and factor of the scales, with 60 digits."""
    with localcontext() as context:
        context.prec = 60
        new = 1 - (1 - Decimal(opacity)) ** (Decimal(1) / copies)
        total = sum(
            (-1) ** (k - 1) * math.comb(copies, k) * new**k / Decimal(k).sqrt() for k in range(1, copies + 1)
        )
        return float(new), float(Decimal(opacity) / total)


def _relocation(effort: Effort) -> Iterator[Trial]:
    for opacity in (1e-30, 1e-6, 0.005, 0.3, 0.9, 0.999, 1 - 2 * EPS, 1 - EPS / 2):
        for copies in (2, 3, 10, 25, 51):
            given = torch.tensor([opacity]), torch.ones(1, 3), torch.tensor([copies])
            new, scales = compute_relocation(*given)
            exact = _exact_relocation(float(given[0]), copies)
            error = max(abs(float(new) / exact[0] - 1), abs(float(scales[0, 0]) / exact[1] - 1))
            yield f"opacity {opacity!r}, {copies} copies", error


def _extreme_parameters(seed: int) -> dict[str, Tensor]:
    """Every parameter from the smallest to the largest that the rasteriser renders."""
    generator = torch.Generator().manual_seed(seed)
    n = 64
    low = torch.empty(n, 3).uniform_(-110, 3, generator=generator)
    # Needles and pancakes: one axis stays of a size that is worth a split.
    low[:, 0] = torch.empty(n).uniform_(-3, 3, generator=generator)
    return {
        "means": torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator)
        * 10 ** torch.empty(n, 1).uniform_(-15, 15, generator=generator),
        "scales": low,
        "opacities": torch.empty(n).uniform_(-120, 120, generator=generator),
        "sh0": torch.randn(n, 1, 3, generator=generator),
    }


def _adam_of(parameters: dict[str, Tensor]) -> SelectiveAdam:
    leaves = {name: value.clone().requires_grad_() for name, value in parameters.items()}
    return SelectiveAdam(leaves, dict.fromkeys(leaves, 1e-3))


def _rounds(effort: Effort) -> Iterator[Trial]:
    """Rounds of both strategies: what they make must be finite."""
    config = DensifyConfig(max_gaussians=1000)
    for seed in range(min(effort.scenes, 100)):
        parameters = _extreme_parameters(seed)
        strategy = DefaultStrategy(config, 2.0, 1000, 64, seed=seed)
        strategy._gradient = torch.full((64,), 1e3)
        strategy._count = torch.ones(64)

        def split(
            strategy: DefaultStrategy = strategy, parameters: dict[str, Tensor] = parameters
        ) -> dict[str, Tensor]:
            adam = _adam_of(parameters)
            strategy.decide(adam.parameters, 500).apply(adam)
            return adam.parameters

        yield f"clone and split, seed {seed}", finite_or_refused(split)
        mcmc = MCMCStrategy(config, 2.0, 1000, seed=seed)

        def relocate(
            mcmc: MCMCStrategy = mcmc, parameters: dict[str, Tensor] = parameters
        ) -> dict[str, Tensor]:
            adam = _adam_of(parameters)
            mcmc.relocate(adam.parameters).apply(adam)
            mcmc.grow(adam.parameters).apply(adam)
            mcmc.shake(adam.parameters, 1e-3)
            return adam.parameters

        yield f"relocate and grow, seed {seed}", finite_or_refused(relocate)
    for logit in (-120.0, 120.0):
        faded = {**_extreme_parameters(0), "opacities": torch.full((64,), logit)}
        mcmc = MCMCStrategy(config, 2.0, 1000, seed=0)

        def grow(mcmc: MCMCStrategy = mcmc, faded: dict[str, Tensor] = faded) -> dict[str, Tensor]:
            adam = _adam_of(faded)
            mcmc.relocate(adam.parameters).apply(adam)
            mcmc.grow(adam.parameters).apply(adam)
            return adam.parameters

        yield f"relocate and grow, all logits {logit:g}", finite_or_refused(grow)


@dataclass(frozen=True)
class Drift:
    """A training in float32 beside float64 ones whose starts differ by a rounding.

    Losses are means over the last twentieth of the iterations.

    Args:
        iteration: how many steps were taken.
        loss: mean of the float64 trainings.
        float32_parameters: distance of the float32 parameters from the exact ones, as a share of the way
            that these have come from their start.
        other_parameters: the largest such distance of the other float64 trainings.
        float32_loss: difference of the float32 training's loss from `loss`, relative to it.
        other_loss: standard deviation of the float64 trainings' losses, relative to `loss`.
    """

    iteration: int
    loss: float
    float32_parameters: float
    other_parameters: float
    float32_loss: float
    other_loss: float


def _drift_scene(lit: bool) -> LitScene:
    scene = random_lit_scene(9)
    generator = torch.Generator().manual_seed(4)
    n, width, height = 24, 16, 12
    depth = 1 + torch.rand(n, generator=generator)
    across = 1.2 * torch.rand(n, 2, generator=generator) - 0.6
    parameters = {
        "means": torch.cat([across * depth[:, None], depth[:, None]], dim=1),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.full((n, 3), math.log(0.2)) + 0.3 * torch.randn(n, 3, generator=generator),
        "opacities": torch.randn(n, generator=generator),
        "sh": 0.3 * torch.randn(n, 1, 3, generator=generator),
    }
    K = torch.tensor([[14.0, 0, 8], [0, 14.0, 6], [0, 0, 1]])
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    target = torch.stack(
        [0.5 + 0.4 * torch.sin(0.7 * columns + c) * torch.cos(0.5 * rows - c) for c in range(3)], -1
    )
    light = (
        torch.tensor(
            [1.2, 1.0, 0.9, 0.05, 1.0, 1.0, 0.6, 0.02, -0.02, 0.0, 0.5, 0.2, 0.15, 0.1, 0.05, 0.07, 1.5]
        )
        if lit
        else None
    )
    truth = 1.2 + 0.03 * columns.float() + 0.02 * rows.float()
    return replace(
        scene, parameters=parameters, viewmat=torch.eye(4), K=K, target=target, depth=truth, light=light
    )


@cache
def training_drift(iterations: int, *, lit: bool = True, points: int = 24) -> tuple[Drift, ...]:
    """Train in float32 and, from starts that differ by a rounding, several times in float64.

    Training is a chaotic map: what differs by a rounding differs more with every step. Float32 is good
    enough where its loss cannot be told from those of the float64 trainings.

    Args:
        iterations: of each training.
        lit: with a near-field light, which is held.
        points: entries of the result, evenly spaced in the logarithm of the iteration.
    """
    scene = _drift_scene(lit)
    generator = torch.Generator().manual_seed(5)
    start = {name: value.double() for name, value in scene.parameters.items()}
    exact = [_Training(scene, start)]
    for _ in range(OTHERS):
        noise = {k: 2 * torch.rand(v.shape, generator=generator) - 1 for k, v in scene.parameters.items()}
        near = {k: v * (1 + OTHER_START * noise[k].double()) for k, v in start.items()}
        exact.append(_Training(scene, near))
    single = _Training(scene, dict(scene.parameters))
    told = {round(math.exp(math.log(iterations) * k / points)) for k in range(points + 1)}
    told |= {count for count in CHECKPOINTS if count <= iterations}
    found = []
    for iteration in range(1, iterations + 1):
        for training in (single, *exact):
            training.step()
        if iteration in told:
            way = exact[0].distance(start)
            losses = np.array([training.loss() for training in exact])
            loss = float(losses.mean())
            found.append(
                Drift(
                    iteration,
                    loss,
                    exact[0].distance(single.values) / way,
                    max(exact[0].distance(other.values) for other in exact[1:]) / way,
                    abs(single.loss() / loss - 1),
                    float(losses.std(ddof=1)) / loss,
                )
            )
    return tuple(found)


class _Training:
    """A scene and its optimiser, in the precision of its parameters."""

    def __init__(self, scene: LitScene, values: dict[str, Tensor]) -> None:
        self._scene = scene
        leaves = {name: value.clone() for name, value in values.items()}
        self._adam = SelectiveAdam(leaves, RATES)
        self._single = all(value.dtype == torch.float32 for value in values.values())
        self._losses: list[float] = []

    @property
    def values(self) -> dict[str, Tensor]:
        return {name: value.detach() for name, value in self._adam.parameters.items()}

    def step(self) -> None:
        scene = self._scene.with_parameters(**self.values)
        found = native_step(scene) if self._single else autograd_step(scene, rounded=False)
        self._adam.step(None, {name: found[name] for name in scene.parameters})
        self._losses.append(float(found["loss"]))

    def loss(self) -> float:
        """Mean over the last iterations."""
        return float(np.mean(self._losses[-max(1, round(LOSS_WINDOW_SHARE * len(self._losses))) :]))

    def distance(self, others: dict[str, Tensor]) -> float:
        squares = [
            (value.double() - others[name].double()).square().sum() for name, value in self.values.items()
        ]
        return math.sqrt(float(sum(squares)))


def _training(lit: bool, effort: Effort) -> Iterator[Trial]:
    from scipy.stats import t

    drifts = training_drift(effort.iterations, lit=lit)
    # One more training of the same kind lies within this many deviations of the mean of those there are.
    quantile = float(t.ppf(1 - FALSE_ALARM / len(drifts) / 2, OTHERS)) * math.sqrt(1 + 1 / (OTHERS + 1))
    for drift in drifts:
        place = f"{drift.iteration} iterations, loss off by {drift.float32_loss:.1e}, parameters by "
        place += f"{drift.float32_parameters:.1e} of their way"
        yield place, drift.float32_loss / max(SAME_LOSS, quantile * drift.other_loss)


def _rows() -> Iterator[Row]:
    for strength in (1e-8, 1.0, 1e8):
        case = f"float32 to float64, gradients {strength:g}"
        yield Row("Adam", case, "drift over the bound of its roundings", 1.0, partial(_adam, strength))
    yield Row("Adam", "gradients 0 to 1e18", "steps not finite or too long", FINITE, _adam_extremes)
    yield Row("Adam", "repeat and threads", "results that differ", EXACT, _adam_repeat)
    yield Row("densification", "relocation", "relative error", 4 * EPS, _relocation)
    yield Row("densification", "extreme Gaussians", "results that are not finite", FINITE, _rounds)
    for lit in (False, True):
        name = f"float32 to float64, {'lit' if lit else 'unlit'}"
        yield Row(
            "training",
            name,
            "difference of the loss, over 1 % or what float64 trainings differ by",
            1.0,
            partial(_training, lit),
        )


ROWS = tuple(_rows())
