"""A small lit tube with known Gaussians, rendered by the project's own rasteriser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, look_at
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split

WIDTH, HEIGHT = 48, 36


def tube_gaussians(n: int = 900, radius_mm: float = 10.0) -> Gaussians:
    generator = np.random.default_rng(3)
    angle = generator.uniform(0, 2 * np.pi, n)
    along = generator.uniform(0, 45, n)
    points = np.stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), along], axis=1)
    stripes = 0.5 + 0.3 * np.sin(3 * angle) * np.cos(along / 4)
    rgb = np.stack([0.3 + 0.5 * stripes, 0.2 + 0.3 * stripes, 0.25 + 0.2 * stripes], axis=1)
    round_ones = Gaussians.from_points(points, rgb, np.full(n, 1.2), opacity=0.9)
    # Flat on the wall, so that the rendered depth is the tube's: thin along the radius.
    half = torch.from_numpy(angle / 2).float()
    zero = torch.zeros(n)
    return replace(
        round_ones,
        quats=torch.stack([half.cos(), zero, zero, half.sin()], dim=1),
        scales=torch.tensor([0.05, 1.2, 1.2]).log().repeat(n, 1),
    )


def tube_cameras(n: int = 6) -> Cameras:
    poses = [
        look_at(
            np.array([2.5 * np.sin(i), 2.5 * np.cos(i), 2.0 + 1.5 * i]),
            np.array([0.0, 0.0, 22.0 + 1.5 * i]),
            np.array([0.0, -1.0, 0.0]),
        )
        for i in range(n)
    ]
    K = np.array([[24.0, 0, WIDTH / 2], [0, 24.0, HEIGHT / 2], [0, 0, 1]])
    return Cameras(np.tile(K, (n, 1, 1)), np.stack(poses), WIDTH, HEIGHT)


def tube_light() -> NearFieldLight:
    return NearFieldLight(torch.tensor(-2.0), torch.tensor(0.9).log(), torch.zeros(6), 15.0)


@pytest.fixture(scope="session")
def tube_sequence() -> EndoscopicSequence:
    scene = Scene(tube_gaussians(), tube_light())
    cameras = tube_cameras()
    with torch.no_grad():
        rendering = scene.render(cameras)
    depth = torch.where(rendering.alpha > 0.5, rendering.depth, torch.zeros(()))
    return EndoscopicSequence(
        name="test/tube@half",
        rgb=(rendering.rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy(),
        K=cameras.K,
        mask=np.ones((6, HEIGHT, WIDTH), dtype=bool),
        split=Split("half", np.array([0, 1, 3, 4]), np.array([2, 5])),
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth.numpy(),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The tube, shaken."""
    # Here, because that module takes the tube from this one.
    from tests.extrags.training.plain_finetuning import coarse_scene

    return coarse_scene()


@pytest.fixture(scope="module")
def pseudo(scene: Scene) -> PseudoViews:
    """Virtual views of the shaken tube."""
    from tests.extrags.training.plain_finetuning import pseudo_views

    return pseudo_views(scene)


@pytest.fixture(scope="module")
def sequence(tube_sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The tube's frames with a mask, a highlight and pixels without depth."""
    from tests.extrags.training.plain_finetuning import masked

    return masked(tube_sequence)
