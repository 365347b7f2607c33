"""The optimisation loop that coarse reconstruction and fine-tuning share."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from extrags.config import DensifyConfig, LightConfig, OptimiserConfig
from extrags.errors import DivergedError
from extrags.events import Progress, emit
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster import SelectiveAdam, l1_ssim_loss
from extrags.scene import Scene
from extrags.training.density import DensityStrategy
from extrags.training.strategies import density_strategy
from extrags.training.views import View

__all__ = ["Schedule", "TrainingResult", "optimise"]

logger = logging.getLogger(__name__)

HISTORY_EVERY = 50
"""Iterations between two entries of the history."""


@dataclass(frozen=True)
class TrainingResult:
    """An optimised scene and how it went.

    Args:
        scene: without gradient history.
        history: every 50 iterations `{iteration, loss, psnr, n_gaussians}`; the PSNR is of the view just
            drawn, inside its weights.
    """

    scene: Scene
    history: list[dict[str, float]]


@dataclass(frozen=True)
class Schedule:
    """Everything the loop needs besides scene and views."""

    stage: str
    iterations: int
    extent: float
    optimiser: OptimiserConfig
    light: LightConfig
    densify: DensifyConfig
    dssim_weight: float
    depth_weight: float
    depth_weight_final_share: float
    depth_scale: float
    sh_every: int
    seed: int

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Rates at an iteration; positions fall log-linearly."""
        rates = self.optimiser
        t = iteration / max(1, self.iterations)
        means = math.exp((1 - t) * math.log(rates.means) + t * math.log(rates.means_final))
        return {
            "means": means * self.extent,
            "quats": rates.quats,
            "scales": rates.scales,
            "opacities": rates.opacities,
            "sh0": rates.sh0,
            "shN": rates.shN,
        }

    def resumed(self, *, seed: int) -> Schedule:
        """The schedule of a scene that is already there: all harmonics from the first step."""
        return replace(self, sh_every=1, seed=seed)

    def depth_weight_at(self, iteration: int) -> float:
        """Weight of the depth term, falling log-linearly."""
        return self.depth_weight * float(
            self.depth_weight_final_share ** (iteration / max(1, self.iterations))
        )


def optimise(scene: Scene, draw: Callable[[int], View], schedule: Schedule) -> TrainingResult:
    """Fit a scene to views, one per iteration.

    Args:
        scene: where to start.
        draw: gives the view of an iteration.
        schedule: rates, weights and budgets.

    Raises:
        DivergedError: when loss or parameters stop being finite; names iteration and parameter group.
    """
    parameters = {
        name: value.detach().clone().requires_grad_() for name, value in scene.gaussians.parameters().items()
    }
    light, light_optimiser = _trainable_light(scene.light, schedule)
    adam = SelectiveAdam(parameters, schedule.learning_rates(0))
    density = density_strategy(
        schedule.densify,
        schedule.extent,
        schedule.iterations,
        len(parameters["means"]),
        seed=schedule.seed,
    )
    history: list[dict[str, float]] = []
    last_good = scene.detached()
    for iteration in range(schedule.iterations):
        view = draw(iteration)
        adam.learning_rates = schedule.learning_rates(iteration)
        step = _step(Scene(Gaussians(**parameters), light), view, schedule, iteration, density)
        if not math.isfinite(step["loss"]):
            raise DivergedError(_account(schedule, iteration, parameters), last_good)
        adam.step(visible=step["visible"])
        adam.zero_grad()
        if light_optimiser is not None:
            light_optimiser.step()
            light_optimiser.zero_grad(set_to_none=True)
        density.step(adam, step["rendering"], iteration)
        parameters = adam.parameters
        if iteration % HISTORY_EVERY == 0 or iteration == schedule.iterations - 1:
            entry = {
                "iteration": float(iteration),
                "loss": step["loss"],
                "psnr": step["psnr"](),
                "n_gaussians": float(len(parameters["means"])),
            }
            history.append(entry)
            emit(Progress(schedule.stage, iteration + 1, schedule.iterations, entry))
            if _finite(parameters):
                last_good = Scene(Gaussians(**parameters), light).detached()
    if not _finite(parameters):
        raise DivergedError(_account(schedule, schedule.iterations, parameters), last_good)
    return TrainingResult(Scene(Gaussians(**parameters), light).detached(), history)


def _trainable_light(
    light: NearFieldLight | None, schedule: Schedule
) -> tuple[NearFieldLight | None, torch.optim.Adam | None]:
    if light is None:
        return None, None
    values = {k: v.detach().clone() for k, v in light.parameters().items()}
    for name in _learned(schedule.light):
        values[name].requires_grad_()
    if schedule.light.exposure:
        values["log_exposure"].requires_grad_()
    trainable = NearFieldLight(**values, reference_distance=light.reference_distance)
    config = schedule.light
    groups: list[dict[str, Any]] = [
        {
            "params": [values[name] for name in _learned(config)],
            "lr": config.learning_rate,
        },
        {"params": [values["log_exposure"]], "lr": config.exposure_learning_rate},
    ]
    return trainable, torch.optim.Adam(groups, eps=1e-15)


def _learned(config: LightConfig) -> list[str]:
    """Names of the global light parameters that the settings leave free."""
    switches = {
        "log_softening": config.falloff,
        "log_exponent": config.falloff,
        "spread": config.spread,
        "cosine": config.cosine,
        "offset": config.offset,
        "log_shoulder": config.response,
    }
    return [name for name, free in switches.items() if free]


def _step(
    scene: Scene, view: View, schedule: Schedule, iteration: int, density: DensityStrategy
) -> dict[str, Any]:
    """Render, compare and back-propagate one view."""
    exposure = None
    if scene.light is not None:
        exposure = scene.light.exposure(view.frame)[None]
    rendering = scene.render(
        view.camera,
        exposure=exposure,
        sh_degree=iteration // schedule.sh_every,
        absgrad=density.needs_absgrad,
    )
    rgb = rendering.rgb[0]
    loss = l1_ssim_loss(rgb, view.rgb, dssim_weight=schedule.dssim_weight, mask=view.weight)
    if view.depth_mm is not None and schedule.depth_weight > 0:
        loss = loss + schedule.depth_weight_at(iteration) * _inverse_depth_loss(
            rendering.depth[0], rendering.alpha[0].detach(), view.depth_mm, schedule.depth_scale
        )
    loss = loss * view.loss_weight
    if scene.light is not None and view.frame is not None:
        loss = loss + schedule.light.exposure_prior * scene.light.log_exposure.square().mean()
    penalty = density.penalty(scene.gaussians.parameters())
    if penalty is not None:
        loss = loss + penalty
    loss.backward()

    def psnr() -> float:
        weight = (view.weight > 0).float()[..., None]
        error = ((rgb.detach() - view.rgb).square() * weight).sum() / (3 * weight.sum()).clamp_min(1)
        return -10 * math.log10(max(float(error), 1e-12))

    return {
        "loss": float(loss.detach()),
        "visible": rendering.visible[0],
        "rendering": rendering,
        "psnr": psnr,
    }


def _inverse_depth_loss(rendered: Tensor, alpha: Tensor, target: Tensor, scale: float) -> Tensor:
    """Mean absolute difference of inverse depths, in units of the inverse median depth.

    Only where both surfaces are there: a hole has no depth that could be wrong.
    """
    valid = (target > 0) & (alpha > 0.5) & (rendered.detach() > 1e-3 * scale)
    if not bool(valid.any()):
        return rendered.sum() * 0
    difference = scale / rendered[valid] - scale / target[valid]
    return difference.abs().mean()


def _finite(parameters: dict[str, Tensor]) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in parameters.values())


def _account(schedule: Schedule, iteration: int, parameters: dict[str, Tensor]) -> str:
    bad = [name for name, value in parameters.items() if not bool(torch.isfinite(value).all())]
    where = f"parameter group {', '.join(bad)}" if bad else "all parameter groups still finite"
    return f"{schedule.stage}: not finite any more at iteration {iteration} ({where})"
