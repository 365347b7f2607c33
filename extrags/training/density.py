"""Adaptive density control: strategies that add, move and remove Gaussians between optimiser steps.

`DefaultStrategy` clones, splits and prunes as gsplat's class of that name does, decision by decision;
`MCMCStrategy` (in `relocation`) is its other one. gsplat's own code is not called: it draws from the global
random numbers, knows one torch optimiser per parameter but not the packed `SelectiveAdam`, and its
relocation needs CUDA. The tests drive both side by side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from extrags.config import DensifyConfig
from extrags.errors import ConfigError
from extrags.raster import Rendering, SelectiveAdam
from extrags.raster.rotations import rotation_matrices

__all__ = ["DefaultStrategy", "DensityRound", "DensityStrategy", "Window"]

SPLIT_SHRINK = 1.6
"""A split Gaussian's children are this much smaller (3DGS, section 5.2)."""

RESET_FACTOR = 2.0
"""A reset caps opacities at this many times the pruning threshold, as gsplat does."""


@dataclass(frozen=True)
class Window:
    """When a strategy acts, in iterations.

    Args:
        start: first iteration after which a round may be.
        stop: no rounds, and no observing, from here on.
        every: iterations between rounds.
    """

    start: float
    stop: float
    every: int

    @classmethod
    def of(cls, config: DensifyConfig, iterations: int) -> Window:
        """The window that a configuration means for so many iterations."""
        return cls(config.start_share * iterations, config.stop_share * iterations, config.every)

    def open(self, iteration: int) -> bool:
        """Whether gradients of this iteration count."""
        return iteration < self.stop

    def round_after(self, iteration: int) -> bool:
        """Whether a round follows this iteration."""
        return self.open(iteration) and iteration >= self.start and (iteration + 1) % self.every == 0


@dataclass(frozen=True)
class DensityRound:
    """What one round decides.

    Args:
        keep: Gaussians that stay, over the set before the round, [N].
        new_gaussians: parameters of new Gaussians, appended after the kept ones.
        rewritten: rows, over the set before the round, that get other parameters in place, [R].
        values: their parameters.
        restarted: of the rewritten rows those that are new Gaussians and forget their moments, [R].
    """

    keep: Bool[Tensor, "n"]
    new_gaussians: dict[str, Tensor]
    rewritten: Int[Tensor, "r"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    values: dict[str, Tensor] = field(default_factory=dict)
    restarted: Bool[Tensor, "r"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))

    @property
    def changed(self) -> bool:
        """Whether the set differs from before."""
        return not bool(self.keep.all()) or len(self.new_gaussians["means"]) > 0 or len(self.rewritten) > 0

    @torch.no_grad()
    def apply(self, adam: SelectiveAdam) -> None:
        """Carry the decision out on parameters and moments; `adam.parameters` may hold new leaves."""
        if len(self.rewritten):
            stale = self.rewritten[self.restarted]
            for name, value in adam.parameters.items():
                value[self.rewritten] = self.values[name]
                adam.first_moments[name][stale] = 0
                adam.second_moments[name][stale] = 0
            adam.steps[stale] = 0
        if not bool(self.keep.all()):
            adam.keep(self.keep)
        if len(self.new_gaussians["means"]):
            adam.append(self.new_gaussians)


class DensityStrategy:
    """A strategy that does nothing, and the interface of those that do.

    The loop calls `penalty` before the backward pass and `step` once after every optimiser step.
    """

    needs_absgrad = False
    """Whether `rasterize` must be asked for the absolute gradients of the 2D means."""

    def penalty(self, parameters: dict[str, Tensor]) -> Tensor | None:
        """A term of the loss; None where there is none."""
        return None

    def step(self, adam: SelectiveAdam, rendering: Rendering, iteration: int) -> None:
        """Observe a view after its backward pass and the optimiser's step, and act when it is time.

        Args:
            adam: holds the parameters (log scales, logit opacities); they may be replaced.
            rendering: of the iteration's view, its 2D gradients filled.
            iteration: counted from 0.
        """


class DefaultStrategy(DensityStrategy):
    """Clones small Gaussians and splits large ones where the image asks for more; prunes useless ones.

    Rules and order are those of gsplat's `DefaultStrategy`; beyond them the number of Gaussians is capped,
    and then the strongest gradients go first.

    Opacities are not reset unless `reset_every` says so: in a tube the camera is inside the scene, a reset
    opens the wall everywhere at once, and short schedules never close it again. (gsplat 1.5.3 announces a
    reset every 3000 steps, but `step % reset_every == 0 & step > 0` there is never true.) Where there is a
    reset, oversized Gaussians are pruned only after the first one, as in gsplat; else always.

    Args:
        config: thresholds.
        extent: length scale of the scene in world units.
        iterations: of the whole optimisation.
        n_gaussians: size of the set at the start.
        seed: of the samples that place split children. They are drawn on the processor whatever the device:
            the draws are the same.
        device: of the Gaussians.

    Source: Kerbl et al., 3D Gaussian Splatting, section 5; Ye et al., AbsGS, 2024 (absolute gradients).
    """

    def __init__(
        self,
        config: DensifyConfig,
        extent: float,
        iterations: int,
        n_gaussians: int,
        *,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.needs_absgrad = config.absgrad
        self._config = config
        self._extent = extent
        self._window = Window.of(config, iterations)
        self._refine_2d_until = config.refine_scale2d_stop_share * iterations
        self._generator = torch.Generator().manual_seed(seed)
        self._device = torch.device(device)
        statistics = torch.zeros(3, n_gaussians, device=self._device)
        self._gradient, self._count, self._radius = statistics.unbind()

    def step(self, adam: SelectiveAdam, rendering: Rendering, iteration: int) -> None:
        """See `DensityStrategy.step`.

        Raises:
            ConfigError: when no Gaussian would be left.
        """
        if not self._window.open(iteration):
            return
        self.observe(rendering)
        done = iteration + 1
        every = self._config.reset_every
        if self._window.round_after(iteration) and (not every or done % every >= self._config.reset_pause):
            decision = self.decide(adam.parameters, done)
            self._check_something_is_left(decision, done)
            decision.apply(adam)
            self.reset_statistics(len(adam.steps))
        if every and done % every == 0:
            self.reset_opacities(adam)

    def observe(self, rendering: Rendering) -> None:
        """Add the gradients of a rendering's 2D means (in pixels), scaled to half image sizes."""
        means2d = rendering.means2d
        gradient = means2d.absgrad if self.needs_absgrad else means2d.grad  # type: ignore[attr-defined]
        if gradient is None:
            # Nothing of the loss depended on where a Gaussian is.
            return
        height, width = rendering.alpha.shape[1:]
        # The loss of a batch is a mean over its cameras.
        scale = gradient.new_tensor([width / 2, height / 2]) * len(gradient)
        for camera, visible in enumerate(rendering.visible):
            norm = (gradient[camera] * scale).norm(dim=-1)
            self._gradient += torch.where(visible, norm, norm.new_zeros(()))
            self._count += visible
            share = rendering.radius_px[camera] / max(width, height)
            self._radius = torch.maximum(self._radius, share)

    def decide(self, parameters: dict[str, Tensor], done: int) -> DensityRound:
        """One round; call `reset_statistics` with the new size once it is applied.

        Args:
            parameters: by name, with log scales and logit opacities.
            done: iterations behind us.
        """
        config = self._config
        largest = parameters["scales"].detach().exp().amax(1)
        refine_2d = done < self._refine_2d_until
        grows = self._growing(len(largest))
        small = largest <= config.split_scale_share * self._extent
        clones = grows & small
        splits = grows & ~small
        if refine_2d:
            splits |= self._capped(self._radius > config.grow_scale2d, int(grows.sum()))
        useless = parameters["opacities"].detach().sigmoid() < config.prune_opacity
        useless_child = useless.clone()
        if not config.reset_every or done > config.reset_every:
            limit = config.prune_scale_share * self._extent
            wide = self._radius > config.prune_scale2d if refine_2d else torch.zeros_like(useless)
            useless_child |= wide | (largest / SPLIT_SHRINK > limit)
            useless |= wide | (largest > limit)
        copies = _chosen(parameters, clones & ~useless)
        children = self.children(parameters, splits & ~useless_child)
        new_gaussians = {name: torch.cat([copies[name], children[name]]) for name in parameters}
        return DensityRound(~(useless | splits), new_gaussians)

    def children(self, parameters: dict[str, Tensor], chosen: Bool[Tensor, "n"]) -> dict[str, Tensor]:
        """Two smaller Gaussians in place of each chosen one, drawn from it; all first ones in front."""
        parents = _chosen(parameters, chosen)
        scales = parents["scales"].exp()
        twice = {name: value.repeat(2, *[1] * (value.ndim - 1)) for name, value in parents.items()}
        noise = torch.randn(2 * len(scales), 3, generator=self._generator).to(scales.device)
        offset = torch.einsum("nij,nj->ni", rotation_matrices(twice["quats"]), noise * scales.repeat(2, 1))
        twice["means"] = twice["means"] + offset
        # The thin axes of needles and pancakes may have no size left in float32, and zero has no logarithm.
        smallest = torch.finfo(torch.float32).tiny
        twice["scales"] = (scales.repeat(2, 1) / SPLIT_SHRINK).clamp_min(smallest).log()
        return twice

    def reset_statistics(self, n_gaussians: int) -> None:
        """Start collecting anew."""
        statistics = torch.zeros(3, n_gaussians, device=self._device)
        self._gradient, self._count, self._radius = statistics.unbind()

    @torch.no_grad()
    def reset_opacities(self, adam: SelectiveAdam) -> None:
        """Cap all opacities at twice the pruning threshold and forget their moments."""
        cap = RESET_FACTOR * self._config.prune_opacity
        adam.parameters["opacities"].clamp_(max=math.log(cap / (1 - cap)))
        adam.first_moments["opacities"].zero_()
        adam.second_moments["opacities"].zero_()

    def _check_something_is_left(self, decision: DensityRound, done: int) -> None:
        if bool(decision.keep.any()) or len(decision.new_gaussians["means"]):
            return
        config = self._config
        sizes = f"densify.prune_scale_share {config.prune_scale_share}"
        if done < self._refine_2d_until:
            sizes += f" and densify.prune_scale2d {config.prune_scale2d}"
        raise ConfigError(
            f"pruning after {done} iterations removes all {len(decision.keep)} Gaussians: they are fainter "
            f"than densify.prune_opacity {config.prune_opacity} or larger than {sizes} allow"
        )

    def _growing(self, n: int) -> Bool[Tensor, "n"]:
        mean_gradient = self._gradient / self._count.clamp_min(1)
        grows = mean_gradient > self._config.gradient_threshold
        room = self._config.max_gaussians - n
        if room <= 0:
            return torch.zeros_like(grows)
        if int(grows.sum()) > room:
            # The strongest first, so that the cap does not depend on the order in memory.
            strength = torch.where(grows, mean_gradient, mean_gradient.new_zeros(()))
            strongest = torch.argsort(strength, descending=True, stable=True)[:room]
            return torch.zeros_like(grows).index_fill_(0, strongest, True)
        return grows

    def _capped(self, wide: Tensor, growing: int) -> Tensor:
        room = max(0, self._config.max_gaussians - len(wide) - growing)
        if int(wide.sum()) <= room:
            return wide
        size = torch.where(wide, self._radius, self._radius.new_zeros(()))
        widest = torch.argsort(size, descending=True, stable=True)[:room]
        return torch.zeros_like(wide).index_fill_(0, widest, True)


def _chosen(parameters: dict[str, Tensor], index: Bool[Tensor, "n"]) -> dict[str, Tensor]:
    return {name: value.detach()[index].clone() for name, value in parameters.items()}
