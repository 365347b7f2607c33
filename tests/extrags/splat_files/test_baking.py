"""Light baked into colours, against the scene with its lamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, look_at
from extrags.errors import ConfigError
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.splat_files import bake_light, bake_recorded_light
from tests.extrags.lit_tube import Tube
from tests.extrags.splat_files.conftest import psnr


def wall(distance: float) -> tuple[Scene, Cameras]:
    """A wall across the view, with a lamp that nothing but the distance changes."""
    from extrags.illumination import NearFieldLight

    x, y = (part.reshape(-1) for part in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)))
    points = np.stack([x, y, np.full_like(x, distance)], axis=1)
    rgb = np.stack([0.3 + 0.1 * x, 0.25 + 0.1 * y, np.full_like(x, 0.2)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    gaussians = Gaussians.from_points(
        points, rgb, np.full(len(points), 0.08), opacity=0.9, normals=normals, thickness=0.01
    )
    light = NearFieldLight(torch.tensor(-2.0), torch.tensor(0.8).log(), torch.zeros(1), 20.0)
    K = np.array([[[distance * 20.0, 0, 10], [0, distance * 20.0, 10], [0, 0, 1]]])
    camera = Cameras(K, look_at(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, -1.0, 0]))[None], 20, 20)
    return Scene(gaussians, light), camera


@pytest.mark.parametrize("distance", [10.0, 20.0, 30.0])
@pytest.mark.parametrize("exposure", [1.0, 1.4])
def test_frontal_light_at_its_own_distance_changes_nothing(distance: float, exposure: float) -> None:
    scene, camera = wall(distance)
    baked = Scene(bake_light(scene, distance=distance, exposure=exposure))
    with torch.no_grad():
        lit = scene.render(camera, exposure=torch.tensor([exposure])).rgb
        shown = baked.render(camera).rgb
    # The response bends the sum of overlapping Gaussians, not each by itself; distances vary over the wall.
    assert float((lit - shown).abs().max()) < 0.012
    assert float(shown.mean()) > 0.02


def test_the_recorded_light_looks_like_the_recording(tube: Tube) -> None:
    train = tube.sequence.training_cameras
    recorded = psnr(Scene(bake_recorded_light(tube.scene, train)), tube.scene, train)
    frontal = psnr(Scene(bake_light(tube.scene)), tube.scene, train)
    albedo = psnr(Scene(tube.scene.gaussians), tube.scene, train)
    assert recorded > max(frontal, albedo) + 3
    assert recorded > 20


def test_highlights_are_baked_as_the_views_saw_them_on_average() -> None:
    scene, camera = wall(20.0)
    assert scene.light is not None
    light = replace(scene.light, log_specular=torch.tensor(0.3).log(), log_roughness=torch.tensor(0.6).log())
    shiny = Scene(scene.gaussians, light)
    with_highlights = psnr(Scene(bake_recorded_light(shiny, camera)), shiny, camera)
    without = psnr(Scene(bake_recorded_light(scene, camera)), shiny, camera)
    assert with_highlights > 35
    assert with_highlights > without + 10


def test_what_no_view_shows_takes_the_nearest_camera(tube: Tube) -> None:
    """Half of the tube lies behind the only camera: its light is that of a lamp at its distance."""
    train = tube.sequence.training_cameras[:1]
    assert tube.scene.light is not None
    baked = bake_recorded_light(tube.scene, train)
    assert torch.isfinite(baked.sh0).all()
    distance = (tube.scene.gaussians.means - torch.from_numpy(train.centers[0]).float()).norm(dim=1)
    last = int(distance.argmax())
    one = bake_light(tube.scene, distance=float(distance[last]))
    assert torch.allclose(baked.sh0[last], one.sh0[last], atol=1e-4)


def test_what_lies_beyond_the_mask_of_a_view_is_not_lit_by_it(tube: Tube) -> None:
    train = tube.sequence.training_cameras[[0, 5]]
    both = np.ones((2, train.height, train.width), dtype=bool)
    first_alone = both.copy()
    first_alone[1] = False
    with torch.no_grad():
        seen = tube.scene.render(train[0], visibility=True).visibility_max
    assert seen is not None
    shown = seen[0] > 0
    assert 0.1 < float(shown.float().mean()) < 1
    masked = bake_recorded_light(tube.scene, train, masks=[*first_alone])
    assert torch.equal(masked.sh0[shown], bake_recorded_light(tube.scene, train[:1]).sh0[shown])
    whole = bake_recorded_light(tube.scene, train)
    assert torch.equal(bake_recorded_light(tube.scene, train, masks=[*both]).sh0, whole.sh0)
    assert not torch.allclose(masked.sh0[shown], whole.sh0[shown], atol=1e-3)


def test_without_light_only_the_exposure_counts(tube: Tube, views: Cameras) -> None:
    plain = Scene(tube.scene.gaussians)
    assert psnr(Scene(bake_light(plain)), plain, views) > 100
    doubled = Scene(bake_recorded_light(plain, views, exposure=2.0))
    with torch.no_grad():
        expected = 2 * plain.render(views).rgb
        assert torch.allclose(doubled.render(views).rgb, expected, atol=1e-5)


def test_harmonics_follow_the_slope_of_the_response(lit: Scene) -> None:
    """Against finite differences of the colour that the response gives."""
    assert lit.light is not None
    step = 1e-3
    values = lit.gaussians.detached().parameters()
    moved = {**values, "sh0": values["sh0"] + step}
    bent = Scene(lit.gaussians, replace(lit.light, log_shoulder=torch.tensor(0.0)))
    first = bake_light(bent)
    second = bake_light(Scene(Gaussians(**moved), bent.light))
    slope = (second.sh0 - first.sh0) / step
    unit = bake_light(Scene(Gaussians(**{**values, "shN": torch.ones_like(values["shN"])}), bent.light))
    assert torch.allclose(unit.shN[:, :1], slope, atol=0.01)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_wrong_numbers(value: float, tube: Tube) -> None:
    with pytest.raises(ConfigError, match="distance"):
        bake_light(tube.scene, distance=value)
    with pytest.raises(ConfigError, match="exposure"):
        bake_light(tube.scene, exposure=value)
    with pytest.raises(ConfigError, match="exposure"):
        bake_recorded_light(tube.scene, tube.sequence.training_cameras, exposure=value)


@pytest.mark.usefixtures("without_kernels")
def test_a_scene_elsewhere(elsewhere: torch.device) -> None:
    scene, camera = wall(20.0)
    for bake in (bake_light, lambda lit: bake_recorded_light(lit, camera)):
        here, there = bake(scene), bake(scene.to(elsewhere))
        assert there.device == elsewhere
        torch.testing.assert_close(there.to("cpu").sh0, here.sh0)
