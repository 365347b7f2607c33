"""A tube whose Gaussians are shaken, and a schedule of a few steps: what single steps are tested on."""

from __future__ import annotations

from dataclasses import replace

import torch

from extrags.config import CoarseConfig, DensifyConfig, LightConfig
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.training.reconstruction import coarse_schedule
from extrags.training.schedule import Schedule
from tests.extrags.training.conftest import tube_gaussians, tube_light


def shaken_scene(sh_degree: int = 1, *, lit: bool = True) -> Scene:
    """The tube, shaken: no gradient is zero."""
    generator = torch.Generator().manual_seed(1)
    tube = tube_gaussians()

    def noise(value: torch.Tensor, size: float) -> torch.Tensor:
        return value + size * torch.randn(value.shape, generator=generator)

    n, higher = len(tube), (sh_degree + 1) ** 2 - 1
    shaken = Gaussians(
        means=noise(tube.means, 0.1),
        quats=noise(tube.quats, 0.05),
        scales=noise(tube.scales, 0.1),
        opacities=noise(tube.opacities, 0.5),
        sh0=noise(tube.sh0, 0.05),
        shN=noise(torch.zeros(n, higher, 3), 0.05),
    )
    light = tube_light()
    light = replace(light, log_exposure=0.1 * torch.randn(6, generator=generator))
    return Scene(shaken, light if lit else None)


def step_schedule(iterations: int = 30, **changes: object) -> Schedule:
    config = CoarseConfig(
        iterations=iterations, densify=DensifyConfig(enabled=False), light=LightConfig(offset=True)
    )
    return replace(coarse_schedule(config, 20.0, 15.0, "coarse", iterations=iterations), **changes)  # type: ignore[arg-type]


def relative_error(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found.double() - expected.double()).norm() / expected.double().norm().clamp_min(1e-30))
