"""Steps of an optimisation that leave the Gaussians of a given scene as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.training.density import DensityStrategy
from extrags.training.schedule import Schedule
from extrags.training.step import Observation, TrainingStep, training_step
from extrags.training.views import View

__all__ = ["FillingStep", "filling_schedule"]


class FillingStep:
    """A step that moves all Gaussians of a scene but its first ones; see `TrainingStep`.

    Their number must stay (`filling_schedule`), since they are known by their places.

    Args:
        scene: where to start; it is copied.
        schedule: rates and weights.
        fixed: Gaussians that stay, the first ones.
    """

    def __init__(self, scene: Scene, schedule: Schedule, fixed: int) -> None:
        self._step: TrainingStep = training_step(scene, schedule)
        self.adam, self.colors = self._step.adam, self._step.colors
        self._kept = {
            name: values[:fixed] for name, values in scene.detached().gaussians.parameters().items()
        }
        self._fixed = fixed

    @property
    def light(self) -> NearFieldLight | None:
        """See `TrainingStep.light`."""
        return self._step.light

    def differentiate(
        self, view: View, iteration: int, density: DensityStrategy, viewmat: np.ndarray | None = None
    ) -> Observation:
        """See `TrainingStep.differentiate`."""
        return self._step.differentiate(view, iteration, density, viewmat)

    def update(self, observation: Observation, iteration: int) -> None:
        """See `TrainingStep.update`."""
        self._step.update(observation, iteration)
        with torch.no_grad():
            for name, values in self._kept.items():
                self.adam.parameters[name][: self._fixed].copy_(values)


def filling_schedule(schedule: Schedule) -> Schedule:
    """The same schedule with the number of Gaussians and the light as they are."""
    learned = ("falloff", "spread", "cosine", "response", "specular", "glare", "exposure", "offset")
    return replace(
        schedule,
        densify=schedule.densify.model_copy(update={"enabled": False}),
        light=schedule.light.model_copy(update=dict.fromkeys(learned, False)),
    )
