"""Highlights of a wet surface, learned with the light."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, look_at
from extrags.config import CoarseConfig, DensifyConfig, LightConfig
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster import native_isa
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.training import reconstruct
from extrags.training.density import DensityStrategy
from extrags.training.reconstruction import coarse_schedule
from extrags.training.step import AutogradStep, NativeStep
from extrags.training.views import real_views

WIDTH, HEIGHT, FRAMES = 64, 48, 8
STRENGTH, ROUGHNESS = 0.4, 0.25


def wavy_wall() -> Gaussians:
    """A wall of low waves 20 mm away, in patches of two colours."""
    x, y = (part.reshape(-1) for part in np.meshgrid(np.linspace(-16, 16, 56), np.linspace(-12, 12, 42)))
    slope_x, slope_y = 0.55 * np.cos(0.5 * x), 0.4 * np.cos(0.6 * y + 1)
    points = np.stack([x, y, 20 + 1.1 * np.sin(0.5 * x) + 0.67 * np.sin(0.6 * y + 1)], axis=1)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    patches = 0.5 + 0.5 * np.sign(np.sin(1.3 * x) * np.sin(1.1 * y))
    rgb = np.stack([0.45 + 0.1 * patches, 0.2 + 0.1 * patches, 0.15 + 0.05 * patches], axis=1)
    return Gaussians.from_points(
        points, rgb, np.full(len(points), 0.32), opacity=0.95, normals=normals, thickness=0.1
    )


def glossy_light(frames: int = FRAMES) -> NearFieldLight:
    return NearFieldLight(
        torch.tensor(-2.0),
        torch.tensor(0.8).log(),
        torch.zeros(frames),
        20.0,
        cosine=torch.tensor(0.8),
        log_specular=torch.tensor(STRENGTH).log(),
        log_roughness=torch.tensor(ROUGHNESS).log(),
    )


@pytest.fixture(scope="module")
def glossy() -> EndoscopicSequence:
    """Photographs from a row of cameras, of which two of the middle are held out."""
    light = glossy_light()
    centres = [np.array([2.0 * frame - 7.0, 1.5 * math.sin(frame), 0.0]) for frame in range(FRAMES)]
    poses = np.stack([look_at(c, c * [0.6, 0.6, 1] + [0, 0, 20], np.array([0, -1.0, 0])) for c in centres])
    K = np.tile([[45.0, 0, WIDTH / 2], [0, 45.0, HEIGHT / 2], [0, 0, 1]], (FRAMES, 1, 1))
    cameras = Cameras(K, poses, WIDTH, HEIGHT)
    with torch.no_grad():
        shown = Scene(wavy_wall(), light).render(cameras)
    return EndoscopicSequence(
        name="test/glossy@row",
        rgb=(shown.rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy(),
        K=K,
        mask=np.ones((FRAMES, HEIGHT, WIDTH), dtype=bool),
        split=Split("row", np.array([0, 1, 2, 4, 6, 7]), np.array([3, 5])),
        world_from_camera=poses,
        depth_mm=torch.where(shown.alpha > 0.5, shown.depth, torch.zeros(())).numpy(),
    )


def settings(*, specular: bool) -> CoarseConfig:
    return CoarseConfig(
        iterations=400,
        max_points=1500,
        densify=DensifyConfig(enabled=False),
        light=LightConfig(specular=specular, exposure=False),
    )


def held_out_psnr(scene: Scene, sequence: EndoscopicSequence) -> float:
    with torch.no_grad():
        rgb = scene.render(sequence.cameras[sequence.test]).rgb
    target = torch.from_numpy(sequence.rgb[sequence.test].astype(np.float32) / 255)
    return float(-10 * (rgb - target).square().mean().log10())


def test_strength_and_roughness_are_found_and_held_out_views_gain(glossy: EndoscopicSequence) -> None:
    with_highlights, without = (reconstruct(glossy, settings(specular=on)).scene for on in (True, False))
    light = with_highlights.light
    assert light is not None
    # What normals of Gaussians are off, a sharper lobe makes good in part.
    assert float(light.log_roughness.exp()) == pytest.approx(ROUGHNESS, rel=0.35)
    assert float(light.log_specular.exp()) == pytest.approx(STRENGTH, rel=0.35)
    assert held_out_psnr(with_highlights, glossy) > held_out_psnr(without, glossy) + 3


def test_switched_off_there_are_none(glossy: EndoscopicSequence) -> None:
    brief = settings(specular=False).model_copy(update={"iterations": 5})
    light = reconstruct(glossy, brief).scene.light
    assert light is not None
    assert float(light.log_specular) == -math.inf


def test_a_matt_surface_loses_little(glossy: EndoscopicSequence) -> None:
    light = NearFieldLight(
        torch.tensor(-2.0), torch.tensor(0.8).log(), torch.zeros(FRAMES), 20.0, cosine=torch.tensor(0.8)
    )
    with torch.no_grad():
        rgb = Scene(wavy_wall(), light).render(glossy.cameras).rgb
    matt = replace(glossy, rgb=(rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
    with_highlights, without = (reconstruct(matt, settings(specular=on)).scene for on in (True, False))
    assert with_highlights.light is not None
    start = NearFieldLight.initial(1, 20.0)
    assert float(with_highlights.light.log_specular) < float(start.log_specular)
    assert held_out_psnr(with_highlights, matt) > max(45, held_out_psnr(without, matt) - 1)


@pytest.mark.parametrize("log_roughness", [0.0, 1.0, math.log(0.02), math.log(0.01)])
@pytest.mark.parametrize("step_kind", [NativeStep, AutogradStep])
def test_a_roughness_at_a_bound_comes_back(
    glossy: EndoscopicSequence, step_kind: type[NativeStep | AutogradStep], log_roughness: float
) -> None:
    """Where the lobe is held it has no gradient: the bounds of what is learned lie inside."""
    if step_kind is NativeStep and native_isa() is None:
        pytest.skip("the native kernels are not built")
    config = settings(specular=True)
    config = config.model_copy(
        update={"light": config.light.model_copy(update={"specular_learning_rate": 0.04})}
    )
    light = replace(glossy_light(len(glossy.train)), log_roughness=torch.tensor(log_roughness))
    step = step_kind(Scene(wavy_wall(), light), coarse_schedule(config, 20.0, 20.0, "coarse"))
    views = real_views(glossy, glossy.train)
    for iteration in range(8):
        observation = step.differentiate(views[iteration % len(views)], iteration, DensityStrategy())
        step.update(observation, iteration)
    assert step.light is not None
    found = float(step.light.log_roughness.detach())
    assert found < -0.1 if log_roughness >= 0 else found > math.log(0.02) + 0.1
