"""The normal term: Gaussians lie on the surface that the starting points sample."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from extrags.config import CoarseConfig
from extrags.raster.rotations import rotation_matrices
from extrags.training.starting import surface_normals

__all__ = ["NormalTerm", "normal_loss"]

NEAREST_EVERY = 100
"""Iterations after which each Gaussian's nearest starting point is looked up again; positions move by small
shares of the points' spacing meanwhile."""


def normal_loss(
    quats: Float[Tensor, "n 4"], log_scales: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> Float[Tensor, ""]:
    """Mean of 1 - |cos| between the shortest axis of each Gaussian and a normal.

    Args:
        quats: rotations (w, x, y, z) of any length; the only argument that gets a gradient.
        log_scales: logarithms of the axes' lengths; they choose the axis.
        normals: unit vectors of either sign.

    Returns:
        In [0, 1]; zero where all axes lie along their normals.

    Source: Bonilla et al., Gaussian Pancakes, MICCAI 2024 (see docs/references.md).
    """
    shortest = log_scales.detach().argmin(dim=1)
    axes = rotation_matrices(quats)[torch.arange(len(quats), device=quats.device), :, shortest]
    return (1 - (axes * normals.detach()).sum(dim=1).abs()).mean()


class NormalTerm:
    """`normal_loss` against the normals of the nearest starting points, as a term of the training loss.

    Nearest points are looked up where the set of Gaussians has changed, every `NEAREST_EVERY` iterations, and
    after each round of densification, which may move Gaussians elsewhere without changing their number.

    Args:
        points: starting points in world units.
        normals: unit normals of the surface at these points, of either sign.
        weight: of the term in the loss.
        start: first iteration at which it is active.
        every: iterations from one use to the next.
        round_every: iterations between rounds of densification.
    """

    def __init__(
        self,
        points: Float[np.ndarray, "p 3"],
        normals: Float[np.ndarray, "p 3"],
        *,
        weight: float,
        start: float,
        every: int,
        round_every: int = NEAREST_EVERY,
    ) -> None:
        self._points = cKDTree(points)
        self._normals = torch.from_numpy(normals)
        self._weight, self._start, self._every = weight, start, every
        self._round_every = round_every
        self._assigned: tuple[Tensor, int, Tensor] | None = None
        """Positions and iteration of the last look-up, and the normals found."""

    @classmethod
    def at(cls, points: Float[np.ndarray, "p 3"], config: CoarseConfig, iterations: int) -> NormalTerm:
        """The term of a reconstruction from starting points, with `extrags.training.starting` normals.

        Args:
            points: where it starts from.
            config: its settings.
            iterations: of this optimisation, which may be fewer than those of the settings.
        """
        return cls(
            points,
            surface_normals(points),
            weight=config.normal_weight,
            start=config.normal_start_share * iterations,
            every=config.normal_every,
            round_every=config.densify.every,
        )

    def penalty(self, parameters: dict[str, Tensor], iteration: int) -> Tensor | None:
        """The weighted term; None at an iteration without it.

        Args:
            parameters: by name, with log scales; `means` are the same tensor until the set changes.
            iteration: counted from 0.
        """
        done = iteration + 1
        if done <= self._start or done % self._every != 0:
            return None
        normals = self._normals_for(parameters["means"], iteration)
        return self._weight * normal_loss(parameters["quats"], parameters["scales"], normals)

    def _normals_for(self, means: Tensor, iteration: int) -> Tensor:
        known = self._assigned
        if known is not None and known[0] is means and self._same_stretch(known[1], iteration):
            return known[2]
        # The tree is on the processor: positions come there whenever nearest points are looked up again.
        _, nearest = self._points.query(means.detach().cpu().numpy())
        normals = self._normals[torch.from_numpy(nearest)].to(means)
        self._assigned = means, iteration, normals
        return normals

    def _same_stretch(self, earlier: int, iteration: int) -> bool:
        """Whether nothing but steps of the optimiser lies between two iterations, and not many."""
        same_round = earlier // self._round_every == iteration // self._round_every
        return same_round and 0 <= iteration - earlier < NEAREST_EVERY
