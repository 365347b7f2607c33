"""A small lit scene with every kind of parameter."""

from __future__ import annotations

import pytest
import torch

from extrags.cameras import Cameras
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from tests.extrags.lit_tube import Tube


@pytest.fixture(scope="session")
def lit(tube: Tube) -> Scene:
    """The tube with colours that change with the direction (SH degree 2) and rotations of any length."""
    values = tube.scene.gaussians.detached().parameters()
    generator = torch.Generator().manual_seed(3)
    count = len(values["means"])
    values["quats"] = values["quats"] * (0.5 + torch.rand(count, 1, generator=generator))
    values["quats"] += 0.05 * torch.randn(count, 4, generator=generator)
    values["shN"] = 0.05 * torch.randn(count, 8, 3, generator=generator)
    values["opacities"] = values["opacities"] + torch.randn(count, generator=generator)
    return Scene(Gaussians(**values), tube.scene.light)


@pytest.fixture(scope="session")
def views(tube: Tube) -> Cameras:
    return tube.sequence.cameras[tube.sequence.test]


def psnr(given: Scene, other: Scene, views: Cameras) -> float:
    """Of renderings of both, in dB."""
    with torch.no_grad():
        first, second = (scene.render(views).rgb.clamp(0, 1) for scene in (given, other))
    return float(-10 * torch.log10(((first - second) ** 2).mean().clamp_min(1e-20)))
