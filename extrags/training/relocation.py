"""Densification as Markov-chain Monte Carlo: dead Gaussians are relocated, positions are perturbed by noise.

The semantics of gsplat's `MCMCStrategy`, whose own code cannot run here: its relocation is a CUDA kernel.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.config import DensifyConfig
from extrags.raster import Rendering, SelectiveAdam
from extrags.raster.rotations import rotation_matrices
from extrags.training.density import DensityRound, DensityStrategy, Window

__all__ = ["MCMCStrategy", "compute_relocation"]

MAX_COPIES = 51
"""More copies of one Gaussian than this are treated as this many, as in gsplat."""

GROWTH = 1.05
"""A round grows the set by this factor at most."""

SHAKEN_STEEPNESS, SHAKEN_TRANSPARENCY = 100.0, 0.995
"""Noise reaches a Gaussian as a sigmoid of its transparency: only nearly invisible ones move freely."""


def compute_relocation(
    opacities: Float[Tensor, "n"], scales: Float[Tensor, "n 3"], copies: Int[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    r"""Opacity and scales with which N Gaussians in one place look like the one that was there.

    .. math:: o' = 1 - (1 - o)^{1/N}, \qquad
        s' = s \, o \Big/ \sum_{i=1}^{N} \sum_{k=0}^{i-1} \binom{i-1}{k} \frac{(-1)^k o'^{k+1}}{\sqrt{k+1}}

    The double sum is computed as a single one: :math:`\sum_{i=1}^{N} \binom{i-1}{k} = \binom{N}{k+1}`. It
    alternates between large terms, and is therefore taken in float64.

    Args:
        opacities: of the Gaussians as they were, in (0, 1).
        scales: their standard deviations.
        copies: N, the Gaussian itself included; above 51 counts as 51.

    Returns:
        The new opacities and scales, in the dtype of the old.

    Source: Kheradmand et al., 3D Gaussian Splatting as Markov Chain Monte Carlo, NeurIPS 2024, eq. 9.
    """
    count = copies.clamp(1, MAX_COPIES)
    old = opacities.double()
    new = -torch.expm1(torch.log1p(-old) / count)
    k = torch.arange(1, MAX_COPIES + 1, device=old.device)
    table = old.new_tensor(
        [[math.comb(n, j) for j in range(1, MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)]
    )
    signed = table[count] * (1 - 2 * ((k - 1) % 2)) / k.double().sqrt()
    total = (signed * new[:, None] ** k).sum(1)
    shrink = (old / total).to(scales.dtype)
    return new.to(opacities.dtype), scales * shrink[:, None]


class MCMCStrategy(DensityStrategy):
    """Moves dead Gaussians onto live ones, grows by copying, and explores by noise.

    Rules are those of gsplat's `MCMCStrategy` with two differences. Lengths are in units of the scene's
    extent, as gsplat's trainer normalises the scene before it begins: the noise does not depend on whether
    a scene is in millimetres. And a relocated Gaussian starts its moments and step count anew, where gsplat
    keeps those that it had in its old place.

    Args:
        config: thresholds.
        extent: length scale of the scene in world units.
        iterations: of the whole optimisation.
        seed: of all samples.

    Source: Kheradmand et al., 3D Gaussian Splatting as Markov Chain Monte Carlo, NeurIPS 2024.
    """

    def __init__(self, config: DensifyConfig, extent: float, iterations: int, *, seed: int) -> None:
        self._config = config
        self._extent = extent
        self._window = Window.of(config, iterations)
        self._generator = torch.Generator().manual_seed(seed)

    def penalty(self, parameters: dict[str, Tensor]) -> Tensor | None:
        """Mean opacity and mean scale (in extents), weighted: unused Gaussians fade and count as dead."""
        config = self._config
        faded = config.opacity_penalty * parameters["opacities"].sigmoid().mean()
        return faded + config.scale_penalty * parameters["scales"].exp().mean() / self._extent

    def step(self, adam: SelectiveAdam, rendering: Rendering, iteration: int) -> None:
        """See `DensityStrategy.step`."""
        if self._window.round_after(iteration):
            self.relocate(adam.parameters).apply(adam)
            self.grow(adam.parameters).apply(adam)
        self.shake(adam.parameters, adam.learning_rates["means"])

    def relocate(self, parameters: dict[str, Tensor]) -> DensityRound:
        """Each dead Gaussian becomes a copy of a live one, drawn by opacity."""
        opacities = parameters["opacities"].detach().sigmoid()
        dead = torch.nonzero(opacities <= self._config.prune_opacity)[:, 0]
        alive = torch.nonzero(opacities > self._config.prune_opacity)[:, 0]
        if len(dead) == 0 or len(alive) == 0:
            return _unchanged(parameters)
        source = alive[self._sampled(opacities[alive], len(dead))]
        rows, values = self._shared_out(parameters, source)
        place = torch.searchsorted(rows, source)
        return DensityRound(
            keep=torch.ones_like(opacities, dtype=torch.bool),
            new_gaussians=_none(parameters),
            rewritten=torch.cat([rows, dead]),
            values={name: torch.cat([value, value[place]]) for name, value in values.items()},
            restarted=torch.ones(len(rows) + len(dead), dtype=torch.bool, device=rows.device),
        )

    def grow(self, parameters: dict[str, Tensor]) -> DensityRound:
        """Up to 5 % more Gaussians, copies of live ones, drawn by opacity."""
        n = len(parameters["means"])
        more = min(self._config.max_gaussians, int(GROWTH * n)) - n
        if more <= 0:
            return _unchanged(parameters)
        opacities = parameters["opacities"].detach().sigmoid()
        if not bool((opacities > 0).any()):
            return _unchanged(parameters)
        source = self._sampled(opacities, more)
        rows, values = self._shared_out(parameters, source)
        place = torch.searchsorted(rows, source)
        return DensityRound(
            keep=torch.ones_like(opacities, dtype=torch.bool),
            new_gaussians={name: value[place] for name, value in values.items()},
            rewritten=rows,
            values=values,
            restarted=torch.zeros(len(rows), dtype=torch.bool, device=rows.device),
        )

    @torch.no_grad()
    def shake(self, parameters: dict[str, Tensor], means_learning_rate: float) -> None:
        """Add noise to the positions, shaped like each Gaussian, in proportion to the learning rate."""
        transparency = 1 - parameters["opacities"].sigmoid()
        share = torch.sigmoid(SHAKEN_STEEPNESS * (transparency - SHAKEN_TRANSPARENCY))
        axes = rotation_matrices(parameters["quats"]) * parameters["scales"].exp()[:, None, :]
        noise = torch.randn(parameters["means"].shape, generator=self._generator).to(share.device)
        noise = noise * share[:, None]
        shaped = torch.einsum("nij,nkj,nk->ni", axes, axes, noise)
        parameters["means"] += shaped * (means_learning_rate * self._config.noise / self._extent**2)

    def _sampled(self, weights: Tensor, n: int) -> Tensor:
        # Once a round. On the processor whatever the device: the draws are the same.
        found = torch.multinomial(weights.cpu(), n, replacement=True, generator=self._generator)
        return found.to(weights.device)

    def _shared_out(self, parameters: dict[str, Tensor], source: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The sampled rows, in order, and their parameters after copies were placed at the same position."""
        rows, times = torch.unique(source, return_counts=True)
        values = {name: value.detach()[rows].clone() for name, value in parameters.items()}
        opacities, scales = compute_relocation(
            values["opacities"].sigmoid(), values["scales"].exp(), times + 1
        )
        limits = torch.finfo(torch.float32)
        values["opacities"] = torch.logit(opacities.clamp(self._config.prune_opacity, 1 - limits.eps))
        # The thin axes of needles and pancakes may have no size left in float32, and zero has no logarithm.
        values["scales"] = scales.clamp_min(limits.tiny).log()
        return rows, values


def _none(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach()[:0].clone() for name, value in parameters.items()}


def _unchanged(parameters: dict[str, Tensor]) -> DensityRound:
    means = parameters["means"]
    return DensityRound(torch.ones(len(means), dtype=torch.bool, device=means.device), _none(parameters))
