"""One optimisation step: render a view, compare, carry the gradients back, move the parameters.

`AutogradStep` uses autograd on any backend and is the specification; `NativeStep` calls the native kernels
one after the other and reuses its arrays. Both give the same numbers up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster import Rendering, SelectiveAdam, l1_ssim_loss, native_isa
from extrags.raster.direct import DirectStep, Target
from extrags.raster.loss import depth_loss
from extrags.scene import Scene
from extrags.training.density import DensityStrategy
from extrags.training.frame_colors import BALANCE_PRIOR, FrameColorFit, colored
from extrags.training.light_fit import (
    BESIDE,
    LOG_ROUGHNESS_BOUNDS,
    LightFit,
    lamp_distance,
    learned_parameters,
    learning_rate,
)
from extrags.training.schedule import Schedule
from extrags.training.views import View

__all__ = ["AutogradStep", "NativeStep", "Observation", "TrainingStep", "training_step"]


@dataclass(frozen=True)
class Observation:
    """Result of one step's forward and backward pass.

    Args:
        loss: all terms.
        rendering: of the view, the gradients of its 2D means filled; good until the next step.
        visible: Gaussians in view, [N].
        viewmat_gradient: where a pose was given, [4, 4]; good until the next step.
    """

    loss: float
    rendering: Rendering
    visible: Tensor
    viewmat_gradient: np.ndarray | None = None


@runtime_checkable
class TrainingStep(Protocol):
    """Holds the parameters of a scene while they are optimised."""

    adam: SelectiveAdam
    colors: FrameColorFit | None
    """Haze and balance of single frames, while they are learned."""

    @property
    def light(self) -> NearFieldLight | None:
        """The light as it is now, if the scene has one."""

    def differentiate(
        self, view: View, iteration: int, density: DensityStrategy, viewmat: np.ndarray | None = None
    ) -> Observation:
        """Loss and gradients of a view; the parameters stay.

        Args:
            view: what to match.
            iteration: sets weights and degree.
            density: tells whether absolute gradients are needed, and may add a penalty.
            viewmat: camera from world instead of the view's own, [4, 4]; its gradient is asked for.
        """

    def update(self, observation: Observation, iteration: int) -> None:
        """Move the parameters along the gradients of the last `differentiate`.

        Args:
            observation: what that returned.
            iteration: sets the light's learning rates; those of the Gaussians are `adam.learning_rates`.
        """


def training_step(scene: Scene, schedule: Schedule) -> TrainingStep:
    """The fastest implementation that can take a scene; its parameters are copied."""
    plain = all(
        value.dtype == torch.float32 and value.device.type == "cpu"
        for value in scene.gaussians.parameters().values()
    )
    return (NativeStep if plain and native_isa() is not None else AutogradStep)(scene, schedule)


class AutogradStep:
    """The step as autograd and `torch.optim` do it, on any backend.

    Args:
        scene: where to start; it is copied.
        schedule: rates and weights.
    """

    def __init__(self, scene: Scene, schedule: Schedule) -> None:
        self._schedule = schedule
        self.adam = SelectiveAdam(_leaves(scene.gaussians), schedule.learning_rates(0))
        self.light, self._light_adam = _trainable_light(scene.light, schedule)
        self.colors = _learned_colors(scene, schedule)
        self._colors_leaf: Tensor | None = None
        self._frame: int | None = None

    def differentiate(
        self, view: View, iteration: int, density: DensityStrategy, viewmat: np.ndarray | None = None
    ) -> Observation:
        """See `TrainingStep.differentiate`."""
        schedule = self._schedule
        scene = Scene(Gaussians(**self.adam.parameters), self.light)
        light = None
        self._frame = view.frame
        if scene.light is not None:
            light = scene.light.camera_light(scene.light.exposure(view.frame)[None])
        if light is not None and self.colors is not None and view.frame is not None:
            self._colors_leaf = self.colors.leaf()
            light = colored(light, self._colors_leaf.to(scene.device), view.frame)
        pose = None
        if viewmat is not None:
            pose = scene.array(viewmat).requires_grad_()
        rendering = scene.render(
            view.camera,
            camera_light=light,
            sh_degree=schedule.sh_degree_at(iteration, scene.gaussians.sh_degree),
            viewmats=None if pose is None else pose[None],
            absgrad=density.needs_absgrad,
        )
        like = rendering.rgb
        image, target = rendering.rgb[0], view.colors.to(like)
        if (saturated := view.saturated) is not None:
            saturated = saturated.to(like.device)
            image = torch.where(saturated, image.clamp(max=1), image)
            target = target.masked_fill(saturated, 1)
        if view.shown is not None:
            hidden = ~view.shown.to(like.device)[..., None]
            image, target = image.masked_fill(hidden, 0), target.masked_fill(hidden, 0)
        loss = schedule.photometric_weight * l1_ssim_loss(
            image,
            target,
            dssim_weight=schedule.dssim_weight,
            mask=view.weights.to(like),
            ssim_mask=None if view.ssim_weight is None else view.ssim_weight.to(like),
            normalisation=view.normalisation,
        )
        if view.depth_mm is not None and schedule.depth_weight > 0:
            loss = loss + schedule.depth_weight_at(iteration) * depth_loss(
                rendering.depth[0],
                rendering.alpha[0],
                view.depth_mm.to(like),
                scale=schedule.depth_scale,
                huber_delta=schedule.depth_huber_delta,
                confidence=None if view.depth_confidence is None else view.depth_confidence.to(like),
            )
        loss = loss * view.loss_weight
        if scene.light is not None and view.frame is not None:
            loss = loss + schedule.light.exposure_prior * scene.light.log_exposure.square().mean()
            if self._colors_leaf is not None:
                loss = loss + BALANCE_PRIOR * self._colors_leaf[:, 1:].square().mean()
        if scene.light is not None and schedule.light.offset:
            loss = loss + schedule.light.offset_prior * lamp_distance(scene.light.offset)
        for penalty in _penalties(schedule, self.adam.parameters, density, iteration):
            loss = loss + penalty
        loss.backward()
        gradient = None if pose is None or pose.grad is None else pose.grad.cpu().numpy()
        return Observation(float(loss.detach()), rendering, rendering.visible[0], gradient)

    def update(self, observation: Observation, iteration: int) -> None:
        """See `TrainingStep.update`."""
        self.adam.step(visible=observation.visible)
        self.adam.zero_grad()
        leaf, self._colors_leaf = self._colors_leaf, None
        if self.colors is not None and leaf is not None and leaf.grad is not None and self._frame is not None:
            share = self._schedule.light_rate_share(iteration)
            self.colors.step(leaf.grad.numpy(), self._frame, share)
        if self._light_adam is not None:
            share = self._schedule.light_rate_share(iteration)
            for group in self._light_adam.param_groups:
                group["lr"] = share * group["initial_lr"]
            self._light_adam.step()
            self._light_adam.zero_grad(set_to_none=True)
            if self.light is not None and self._schedule.light.specular:
                with torch.no_grad():
                    self.light.log_roughness.clamp_(*LOG_ROUGHNESS_BOUNDS)


class NativeStep:
    """The step as the native kernels do it: no graph, no new arrays while the number of Gaussians stays.

    `direct` holds the last view's gradients, once there was one; `light_fit` the light, if the scene has one.

    Args:
        scene: float32 on the CPU; it is copied.
        schedule: rates and weights.
    """

    def __init__(self, scene: Scene, schedule: Schedule) -> None:
        self._near = scene.near
        self._schedule = schedule
        self._sh_degree = scene.gaussians.sh_degree
        self.colors = _learned_colors(scene, schedule)
        self.light_fit = None if scene.light is None else LightFit(scene.light, schedule.light, self.colors)
        self.adam = SelectiveAdam(
            _leaves(scene.gaussians), schedule.learning_rates(0), joined={"sh": ("sh0", "shN")}
        )
        self.direct: DirectStep | None = None
        self._bound: list[Tensor] = []

    @property
    def light(self) -> NearFieldLight | None:
        """See `TrainingStep.light`."""
        return None if self.light_fit is None else self.light_fit.light

    def differentiate(
        self, view: View, iteration: int, density: DensityStrategy, viewmat: np.ndarray | None = None
    ) -> Observation:
        """See `TrainingStep.differentiate`."""
        schedule = self._schedule
        direct = self._bound_step(density)
        target = self._target(view)
        if viewmat is not None:
            target.viewmat[...] = viewmat
        loss = direct.run(
            target,
            sh_degree=schedule.sh_degree_at(iteration, self._sh_degree),
            light=None if self.light_fit is None else self.light_fit.row(view.frame),
            dssim_weight=schedule.dssim_weight,
            photometric_weight=schedule.photometric_weight,
            loss_weight=view.loss_weight,
            depth_weight=schedule.depth_weight_at(iteration),
            depth_scale=schedule.depth_scale,
            depth_huber_delta=schedule.depth_huber_delta,
            near=self._near,
            pose=viewmat is not None,
        )
        if self.light_fit is not None:
            loss += self.light_fit.prior()
        for penalty in _penalties(schedule, self.adam.parameters, density, iteration):
            self._add_penalty(penalty, direct.gradients)
            loss += float(penalty.detach())
        gradient = None if viewmat is None else direct.viewmat_gradient
        return Observation(loss, direct.rendering(target), direct.visible, gradient)

    def update(self, observation: Observation, iteration: int) -> None:
        """See `TrainingStep.update`."""
        if self.direct is None:
            raise RuntimeError("update before the first differentiate")
        self.adam.step(visible=observation.visible, gradients=self.direct.gradients)
        if self.light_fit is not None:
            self.light_fit.step(self.direct.light_gradient, self._schedule.light_rate_share(iteration))

    def _bound_step(self, density: DensityStrategy) -> DirectStep:
        """The kernels' arrays, made anew where densification has replaced the parameters."""
        if self.direct is None:
            self.direct = DirectStep(absgrad=density.needs_absgrad, lit=self.light_fit is not None)
        leaves = list(self.adam.parameters.values())
        if len(leaves) != len(self._bound) or any(
            a is not b for a, b in zip(leaves, self._bound, strict=True)
        ):
            joined = {name: array.values for name, array in self.adam.joined.items()}
            self.direct.bind({**self.adam.parameters, **joined})
            self._bound = leaves
        return self.direct

    def _add_penalty(self, penalty: Tensor, gradients: dict[str, Tensor]) -> None:
        """A penalty depends on the parameters alone: autograd costs little there."""
        parameters = self.adam.parameters
        found = torch.autograd.grad(penalty, list(parameters.values()), allow_unused=True)
        split = {"sh0": gradients["sh"][:, :1], "shN": gradients["sh"][:, 1:]}
        for name, gradient in zip(parameters, found, strict=True):
            if gradient is not None:
                (split[name] if name in split else gradients[name]).add_(gradient)

    def _target(self, view: View) -> Target:
        """What the kernels need of a view; made anew, so that one decoded view alone is in memory."""
        camera = view.camera
        return Target(
            camera.viewmats[0].astype(np.float32),
            camera.K[0].astype(np.float32),
            view.colors,
            lens=camera.lens,
            weight=view.weights,
            ssim_weight=view.ssim_weight,
            normalisation=view.normalisation,
            depth=view.depth_mm if self._schedule.depth_weight > 0 else None,
            depth_confidence=view.depth_confidence,
            shown=view.shown,
            saturated=view.saturated,
        )


def _learned_colors(scene: Scene, schedule: Schedule) -> FrameColorFit | None:
    if scene.light is None or schedule.colors_decided_at is None:
        return None
    return FrameColorFit(len(scene.light.log_exposure))


def _penalties(
    schedule: Schedule, parameters: dict[str, Tensor], density: DensityStrategy, iteration: int
) -> list[Tensor]:
    """Terms of the loss that depend on the parameters alone."""
    found = [density.penalty(parameters)]
    if schedule.normals is not None:
        found.append(schedule.normals.penalty(parameters, iteration))
    return [penalty for penalty in found if penalty is not None]


def _leaves(gaussians: Gaussians) -> dict[str, Tensor]:
    return {
        name: value.detach().clone().contiguous().requires_grad_()
        for name, value in gaussians.parameters().items()
    }


def _trainable_light(
    light: NearFieldLight | None, schedule: Schedule
) -> tuple[NearFieldLight | None, torch.optim.Adam | None]:
    if light is None:
        return None, None
    config = schedule.light
    values = {k: v.detach().clone() for k, v in light.parameters().items()}
    learned = learned_parameters(config)
    for name in learned:
        values[name].requires_grad_()
    if "offset" in learned:
        values["offset"].register_hook(_beside_the_lens)
    if config.exposure:
        values["log_exposure"].requires_grad_()
    trainable = NearFieldLight(**values, reference_distance=light.reference_distance)
    groups: list[dict[str, Any]] = [
        *({"params": [values[name]], "initial_lr": learning_rate(name, config)} for name in learned),
        {"params": [values["log_exposure"]], "initial_lr": config.exposure_learning_rate},
    ]
    return trainable, torch.optim.Adam(groups, eps=1e-15)


def _beside_the_lens(gradient: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    return gradient * gradient.new_tensor(BESIDE)
