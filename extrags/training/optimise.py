"""The optimisation loop that coarse reconstruction and fine-tuning share."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from extrags.errors import DivergedError, NonFiniteError
from extrags.events import emit
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.threads import one_torch_thread
from extrags.training.footprint import APPLIED_EVERY, SmallestFootprint
from extrags.training.frame_colors import FrameColors
from extrags.training.frame_weights import FrameWeights
from extrags.training.light_fit import drop_faint_glare
from extrags.training.pose_refinement import PoseRefinement, RefinedPoses
from extrags.training.schedule import Schedule
from extrags.training.step import Observation, TrainingStep, training_step
from extrags.training.strategies import density_strategy
from extrags.training.views import View

__all__ = ["TrainingResult", "optimise"]

logger = logging.getLogger(__name__)

HISTORY_EVERY = 50
"""Iterations between two entries of the history."""


@dataclass(frozen=True)
class TrainingResult:
    """An optimised scene and the history of its optimisation.

    Args:
        scene: without gradient history.
        history: every 50 iterations `{iteration, loss, psnr, n_gaussians}`; the PSNR is of the view just
            drawn, inside its weights.
        refined: corrected poses of the training frames, where corrections were kept; the scene belongs to
            these.
        frame_weights: which training frames are blurred or have moved, where that was looked for.
        colors: haze and white balance of the training frames, where some was found; the scene belongs to
            frames without (`extrags.training.frame_colors.with_corrected_colors`).
    """

    scene: Scene
    history: list[dict[str, float]]
    refined: RefinedPoses | None = None
    frame_weights: FrameWeights | None = None
    colors: FrameColors | None = None

    @property
    def corrects_frames(self) -> bool:
        """Whether the scene belongs to other poses or colours than those of the frames that were given."""
        return self.refined is not None or self.colors is not None


def optimise(
    scene: Scene,
    draw: Callable[[int], View],
    schedule: Schedule,
    *,
    make_step: Callable[[Scene, Schedule], TrainingStep] = training_step,
    poses: PoseRefinement | None = None,
    footprint: SmallestFootprint | None = None,
) -> TrainingResult:
    """Fit a scene to views, one per iteration.

    Args:
        scene: where to start; the optimisation runs where it is, and so does the result.
        draw: gives the view of an iteration, its images on the scene's device.
        schedule: rates, weights and budgets.
        make_step: which implementation of a step; default: the fastest that can take the scene.
        poses: corrects the poses of real views during the optimisation.
        footprint: lower bound on the size of Gaussians.

    Returns:
        What was found; where haze and white balance of frames are learned and there are none, what there was
        when that was decided: the light has fitted itself to them meanwhile, and who asked begins anew.

    Raises:
        DivergedError: when loss, parameters or light stop being finite; names iteration and parameter group.
        NonFiniteError: when the scene given is not finite.
    """
    step = make_step(scene, schedule)
    adam = step.adam
    density = density_strategy(
        schedule.densify,
        schedule.extent,
        schedule.iterations,
        len(adam.steps),
        seed=schedule.seed,
        device=scene.device,
    )
    history: list[dict[str, float]] = []
    last_good = scene.detached()
    # Torch has only small arrays to handle here: its threads would cost more than they bring.
    with one_torch_thread():
        for iteration in range(schedule.iterations):
            view = draw(iteration)
            adam.learning_rates = schedule.learning_rates(iteration)
            frame = view.frame if poses is not None and poses.active(iteration) else None
            viewmat = None if poses is None or frame is None else poses.viewmat(frame)
            try:
                observation = step.differentiate(view, iteration, density, viewmat)
            except NonFiniteError as error:
                if iteration == 0:
                    raise
                account = _account(schedule, iteration, adam.parameters, step.light)
                raise DivergedError(f"{account}: {error}", last_good) from error
            if not math.isfinite(observation.loss):
                raise DivergedError(_account(schedule, iteration, adam.parameters, step.light), last_good)
            step.update(observation, iteration)
            if iteration == schedule.glare_decided_at and step.light is not None:
                drop_faint_glare(step.light, schedule.light)
            if iteration == schedule.colors_decided_at and step.colors is not None:
                step.colors.decide()
                if step.colors.found() is None:
                    break
            density.step(adam, observation.rendering, iteration)
            last = iteration == schedule.iterations - 1
            if footprint is not None and (last or (iteration + 1) % APPLIED_EVERY == 0):
                footprint.apply(adam.parameters)
            if poses is not None and frame is not None and observation.viewmat_gradient is not None:
                poses.step(frame, observation.viewmat_gradient, iteration)
            if iteration % HISTORY_EVERY == 0 or last:
                entry = {
                    "iteration": float(iteration),
                    "loss": observation.loss,
                    "psnr": _psnr(observation, view),
                    "n_gaussians": float(len(adam.steps)),
                }
                history.append(entry)
                emit(schedule.progress(iteration, entry))
                if not _nonfinite(adam.parameters, step.light):
                    last_good = Scene(Gaussians(**adam.parameters), step.light).detached()
    if _nonfinite(adam.parameters, step.light):
        account = _account(schedule, schedule.iterations, adam.parameters, step.light)
        raise DivergedError(account, last_good)
    found = Scene(Gaussians(**adam.parameters), step.light).detached()
    refined = poses.refined() if poses is not None and poses.kept else None
    colors = None if step.colors is None else step.colors.found()
    return TrainingResult(found, history, refined, colors=colors)


def _psnr(observation: Observation, view: View) -> float:
    """Of the view just drawn, inside its weights."""
    weight = (view.weights > 0).float()[..., None]
    squares = (observation.rendering.rgb[0].detach() - view.colors).square()
    error = (squares * weight).sum() / (3 * weight.sum()).clamp_min(1)
    return -10 * math.log10(max(float(error), 1e-12))


@torch.no_grad()
def _nonfinite(parameters: dict[str, Tensor], light: NearFieldLight | None) -> list[str]:
    """Names of the groups that cannot be rendered."""
    # A finite logarithm may be that of a number beyond float32.
    groups = {name: value.exp() if name == "scales" else value for name, value in parameters.items()}
    if light is not None:
        # The logarithm of a strength of zero is not finite, and no error: what is rendered counts.
        exposures = torch.cat([light.exposures(), light.exposure(None)[None]])
        groups["light"] = light.camera_light(exposures).packed()
    return [name for name, value in groups.items() if not bool(torch.isfinite(value).all())]


def _account(
    schedule: Schedule, iteration: int, parameters: dict[str, Tensor], light: NearFieldLight | None
) -> str:
    bad = _nonfinite(parameters, light)
    where = f"parameter group {', '.join(bad)}" if bad else "all parameter groups still finite"
    return f"{schedule.stage}: not finite any more at iteration {iteration} ({where})"
