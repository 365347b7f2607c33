from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster import Rendering, rasterize
from extrags.scene import Scene
from extrags.threads import torch_threads


def _scene_and_cameras() -> tuple[Scene, Cameras]:
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, size=(40, 3)) + np.array([0, 0, 4])
    gaussians = Gaussians.from_points(points, generator.uniform(size=(40, 3)), np.full(40, 0.3))
    K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.5
    return Scene(gaussians), Cameras(np.tile(K, (2, 1, 1)), poses, 32, 24)


def test_attributes_are_blended_as_colours_are() -> None:
    scene, cameras = _scene_and_cameras()
    attributes = torch.randn(40, 5, generator=torch.Generator().manual_seed(0))
    blended, alpha = scene.render_attributes(cameras, attributes)
    assert blended.shape == (2, 24, 32, 5)
    gaussians = scene.gaussians
    for first in (0, 2):
        expected = rasterize(
            gaussians.means,
            gaussians.quats,
            gaussians.scales.exp(),
            gaussians.opacities.sigmoid(),
            None,
            torch.from_numpy(cameras.viewmats.astype(np.float32)),
            torch.from_numpy(cameras.K.astype(np.float32)),
            32,
            24,
            colors=attributes[:, first : first + 3].contiguous(),
        )
        assert torch.equal(blended[..., first : first + 3], expected.rgb)
        assert torch.equal(alpha, expected.alpha)


def test_an_attribute_of_one_gives_the_opacity() -> None:
    scene, cameras = _scene_and_cameras()
    blended, alpha = scene.render_attributes(cameras, torch.ones(40, 1))
    torch.testing.assert_close(blended[..., 0], alpha)
    assert 0 < float(alpha.mean()) < 1


def test_the_near_plane_follows_the_unit_of_length() -> None:
    scene, cameras = _scene_and_cameras()
    lit = replace(scene, light=NearFieldLight.initial(1, 1.0))
    assert lit.near == scene.near == 0.01
    unit = 1e-3
    gaussians = scene.gaussians.detached()
    small = replace(gaussians, means=gaussians.means * unit, scales=gaussians.scales + float(np.log(unit)))
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] *= unit
    found = Scene(small, NearFieldLight.initial(1, unit)).render(replace(cameras, world_from_camera=poses))
    expected = lit.render(cameras)
    assert float(expected.alpha.mean()) > 0.1
    torch.testing.assert_close(found.rgb, expected.rgb, atol=1e-4, rtol=1e-4)


def test_a_scene_in_float64_is_rendered_by_cameras_in_float64() -> None:
    scene, cameras = _scene_and_cameras()
    wide = Scene(Gaussians(**{name: value.double() for name, value in scene.gaussians.parameters().items()}))
    # Less than float32 can tell apart.
    moved = cameras.world_from_camera + 1e-9 * np.eye(4)[3] * np.eye(4)[:, :1]
    nearby = replace(cameras, world_from_camera=moved)
    with torch.no_grad():
        single, double = scene.render(cameras).rgb, wide.render(cameras).rgb
        assert double.dtype == torch.float64
        torch.testing.assert_close(double.float(), single, rtol=1e-4, atol=1e-5)
        assert not torch.equal(wide.render(nearby).rgb, double)


def test_torch_computes_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    # Where torch divides its work, sigmoids differ by a rounding, and a training makes that visible.
    scene, cameras = _scene_and_cameras()
    threads = []

    def recorded(*arguments: Any, **options: Any) -> Rendering:
        threads.append(torch.get_num_threads())
        return rasterize(*arguments, **options)

    monkeypatch.setattr("extrags.scene.rasterize", recorded)
    with torch_threads(2):
        scene.render(cameras)
        scene.render_attributes(cameras, torch.ones(40, 1))
        assert torch.get_num_threads() == 2
    assert threads == [1, 1]
