"""Which densification strategy a configuration asks for."""

from __future__ import annotations

import torch

from extrags.config import DensifyConfig
from extrags.training.density import DefaultStrategy, DensityStrategy
from extrags.training.relocation import MCMCStrategy

__all__ = ["density_strategy"]


def density_strategy(
    config: DensifyConfig,
    extent: float,
    iterations: int,
    n_gaussians: int,
    *,
    seed: int,
    device: torch.device | str = "cpu",
) -> DensityStrategy:
    """The strategy of a configuration; one that does nothing where densification is off.

    Args:
        config: which, and its thresholds.
        extent: length scale of the scene in world units.
        iterations: of the whole optimisation.
        n_gaussians: size of the set at the start.
        seed: of everything a strategy draws.
        device: of the Gaussians.
    """
    if not config.enabled:
        return DensityStrategy()
    if config.strategy == "mcmc":
        return MCMCStrategy(config, extent, iterations, seed=seed)
    return DefaultStrategy(config, extent, iterations, n_gaussians, seed=seed, device=device)
