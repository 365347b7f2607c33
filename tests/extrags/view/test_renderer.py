"""Pictures of a scene: its light as it is and as it is changed, and what else can be shown of it."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.errors import ConfigError
from extrags.export import fly_through
from extrags.facing import one_sided_rendering
from extrags.gaussians import Gaussians
from extrags.radial_lens import RadialLens
from extrags.raster import available_backends
from extrags.scene import Scene
from extrags.view import SceneRenderer, ViewSettings, overview, pinhole, renderer, typical_depth
from tests.extrags.lit_tube import build_tube, from_outside, seen_from_inside, tube_cameras


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_tube().scene


@pytest.fixture(scope="module")
def camera() -> Cameras:
    return tube_cameras(2)[1]


def rendered(scene: Scene, camera: Cameras, exposure: float | None = None) -> np.ndarray:
    gain = None if exposure is None else torch.tensor([exposure])
    with torch.no_grad():
        return np.rint(scene.render(camera, exposure=gain).rgb[0].clamp(0, 1).numpy() * 255).astype(np.uint8)


@pytest.mark.parametrize("lit", [True, False])
def test_pictures_are_exactly_those_of_the_scene(scene: Scene, camera: Cameras, lit: bool) -> None:
    shown = scene if lit else Scene(scene.gaussians)
    made = SceneRenderer(shown)
    np.testing.assert_array_equal(made.render(camera, ViewSettings()), rendered(shown, camera))
    for exposure in (0.5, 2.0):
        np.testing.assert_array_equal(
            made.render(camera, ViewSettings(exposure=exposure)), rendered(shown, camera, exposure)
        )


def test_pictures_through_a_lens_are_those_of_the_scene(scene: Scene, camera: Cameras) -> None:
    lens = RadialLens((-0.1, 0.0, 0.0, 0.0), math.radians(60))
    through = replace(camera, lens=lens)
    made = SceneRenderer(scene).render(through, ViewSettings())
    np.testing.assert_array_equal(made, rendered(scene, through))
    assert np.abs(made.astype(int) - rendered(scene, camera).astype(int)).max() > 20


def test_walls_seen_from_behind_stand_back(scene: Scene) -> None:
    """Exactly as in the evaluation, in every layer; where they stand if that is wanted."""
    sided, camera = seen_from_inside(scene), from_outside()
    made = SceneRenderer(sided, train=tube_cameras(6))
    with torch.no_grad():
        expected = one_sided_rendering(sided, camera, exposure=torch.tensor([4.0]))
    picture = np.rint(expected.rgb[0].clamp(0, 1).numpy() * 255).astype(np.uint8)
    np.testing.assert_array_equal(made.render(camera, ViewSettings(exposure=4.0)), picture)
    where_they_stand = made.render(camera, ViewSettings(exposure=4.0, one_sided=False))
    np.testing.assert_array_equal(where_they_stand, rendered(scene, camera, 4.0))
    assert np.abs(where_they_stand.astype(int) - picture).mean() > 5
    alpha = made.render(camera, ViewSettings(layer="alpha"))[..., 0]
    np.testing.assert_array_equal(alpha, np.rint(expected.alpha[0].clamp(0, 1).numpy() * 255))
    for layer in ("depth", "uncertainty"):
        shown, plain = (
            made.render(camera, ViewSettings(layer=layer, one_sided=one_sided)).astype(int)
            for one_sided in (True, False)
        )
        assert np.abs(shown - plain).mean() > 2, layer


def test_a_scene_of_a_small_unit_without_light_shows_its_near_surface(camera: Cameras, scene: Scene) -> None:
    """Nothing nearer than 0.01 is rendered of a scene without light; here that would be most of it."""
    factor = 0.0005
    poses = camera.world_from_camera.copy()
    poses[:, :3, 3] *= factor
    values = scene.gaussians.parameters()
    small = Gaussians(
        **{**values, "means": values["means"] * factor, "scales": values["scales"] + math.log(factor)}
    )
    closer = replace(camera, world_from_camera=poses)
    expected = rendered(Scene(scene.gaussians), camera).astype(int)
    assert (rendered(Scene(small), closer).max(axis=2) < 8).mean() > 0.3
    for train in (None, closer):
        made = SceneRenderer(Scene(small), train=train).render(closer, ViewSettings())
        assert np.abs(made.astype(int) - expected).mean() < 0.5


def test_a_scene_without_gaussians_is_black(scene: Scene, camera: Cameras) -> None:
    nothing = Scene(scene.gaussians.subset(torch.arange(0)))
    assert SceneRenderer(nothing).render(camera, ViewSettings()).max() == 0


def test_lamp_and_exposure_multiply(scene: Scene, camera: Cameras) -> None:
    made = SceneRenderer(scene)
    np.testing.assert_array_equal(
        made.render(camera, ViewSettings(exposure=4.0, lamp=0.5)), rendered(scene, camera, 2.0)
    )
    assert made.render(camera, ViewSettings(lamp=0.0)).max() == 0


def test_without_fall_off_everything_is_lit_alike(scene: Scene, camera: Cameras) -> None:
    """Albedo under the camera's response, which is linear here."""
    assert scene.light is not None
    shiny = replace(scene.light, log_specular=torch.tensor(0.5).log(), log_roughness=torch.tensor(0.9).log())
    scene = Scene(scene.gaussians, shiny)
    made = SceneRenderer(scene).render(camera, ViewSettings(falloff=False))
    albedo = rendered(Scene(scene.gaussians), camera)
    assert np.abs(made.astype(int) - albedo.astype(int)).max() <= 1
    assert np.abs(made.astype(int) - rendered(scene, camera).astype(int)).max() > 20


def test_alpha_and_depth(scene: Scene, camera: Cameras) -> None:
    made = SceneRenderer(scene)
    with torch.no_grad():
        rendering = scene.render(camera)
    alpha = made.render(camera, ViewSettings(layer="alpha"))
    expected = np.rint(rendering.alpha[0].clamp(0, 1).numpy() * 255).astype(np.uint8)
    np.testing.assert_array_equal(alpha, np.repeat(expected[..., None], 3, axis=2))
    depth = made.render(camera, ViewSettings(layer="depth"))
    hidden = rendering.alpha[0].numpy() < 0.5
    assert hidden.any()
    assert (depth[hidden] == 0).all()
    z = np.where(hidden, np.nan, rendering.depth[0].numpy())
    near, far = depth[z == np.nanmin(z)][0].astype(int), depth[z == np.nanmax(z)][0].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0], "far is blue"


def test_uncertainty_is_that_of_videos(scene: Scene, camera: Cameras) -> None:
    train = tube_cameras(6)
    made = SceneRenderer(scene, train=train).render(camera, ViewSettings(layer="uncertainty"))
    (video,) = fly_through([scene], camera, train=train, colors=False)
    assert np.abs(made.astype(int) - video.astype(int)).max() <= 4, "the palette has 256 colours"
    assert made.max() > 100


def test_a_layer_over_the_colours(scene: Scene, camera: Cameras) -> None:
    made = SceneRenderer(scene, train=tube_cameras(6))
    color = rendered(scene, camera).astype(float)
    for layer in ("alpha", "depth", "uncertainty"):
        alone = made.render(camera, ViewSettings(layer=layer)).astype(float)
        half = made.render(camera, ViewSettings(layer=layer, mix=0.5))
        assert np.abs(half - (color + alone) / 2).max() <= 0.5
        np.testing.assert_array_equal(made.render(camera, ViewSettings(layer=layer, mix=0.0)), color)


def test_uncertainty_needs_the_training_views(scene: Scene, camera: Cameras) -> None:
    made = SceneRenderer(scene)
    assert "uncertainty" not in made.layers
    with pytest.raises(ConfigError, match="views that the scene was made from"):
        made.render(camera, ViewSettings(layer="uncertainty"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exposure": 0.0}, "exposure is 0; expected a number above 0"),
        ({"exposure": math.inf}, "exposure is inf"),
        ({"lamp": -1.0}, "lamp is -1; expected a number from 0"),
        ({"layer": "normals"}, "layer is 'normals'; expected color, alpha, depth, uncertainty"),
        ({"mix": 1.5}, "mix is 1.5; expected 0 to 1"),
    ],
)
def test_settings_out_of_range(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ViewSettings(**settings)


@pytest.mark.parametrize("lit", [True, False])
def test_all_that_is_rasterised_is_on_one_device(
    scene: Scene, camera: Cameras, lit: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The CUDA backend takes nothing else; the device `meta` stands for it where there is none."""
    found: set[str] = set()

    class Stop(Exception):
        pass

    def rasterize(*arrays: Any, light: Any, **_: Any) -> None:
        everything = [*arrays, *vars(light).values()]
        found.update(value.device.type for value in everything if isinstance(value, torch.Tensor))
        raise Stop

    monkeypatch.setattr(renderer, "rasterize", rasterize)
    made = SceneRenderer(scene if lit else Scene(scene.gaussians), device="meta")
    with pytest.raises(Stop):
        made.render(camera, ViewSettings(exposure=2.0))
    assert found == {"meta"}


@pytest.mark.gpu
def test_cuda_shows_what_the_processor_shows(scene: Scene, camera: Cameras) -> None:
    if "gsplat" not in available_backends():
        pytest.skip("gsplat needs a CUDA device")
    settings = [ViewSettings(), ViewSettings(exposure=2.0, falloff=False), ViewSettings(layer="uncertainty")]
    train = tube_cameras(6)
    for each in settings:
        pictures = [
            SceneRenderer(scene, train=train, device=device).render(camera, each).astype(int)
            for device in ("cpu", "cuda")
        ]
        assert np.abs(pictures[0] - pictures[1]).mean() < 1


class TestViewpoints:
    def test_a_pinhole_has_its_field_of_view(self) -> None:
        camera = pinhole(np.eye(4), math.radians(90), 2.0, 200)
        assert (camera.width, camera.height) == (200, 100)
        pixels, _ = camera.project(np.array([[0.0, 1.0, 1.0], [2.0, 0.0, 1.0]]))
        np.testing.assert_allclose(pixels[0], [[100, 100], [200, 50]])
        for fov, aspect in ((0.0, 1.0), (math.pi, 1.0), (1.0, 0.0), (1.0, math.inf)):
            with pytest.raises(ConfigError, match="no camera has"):
                pinhole(np.eye(4), fov, aspect, 200)

    def test_an_overview_has_most_of_the_scene_in_view(self, scene: Scene) -> None:
        camera = overview(scene, 160)
        pixels, depth = camera.project(scene.gaussians.means.double().numpy())
        assert camera.contains(pixels[0]).mean() > 0.75
        assert depth.min() > 0
        # The tube is long: along the image's width.
        assert np.ptp(pixels[0, :, 0]) > 1.5 * np.ptp(pixels[0, :, 1])

    def test_an_overview_of_many_gaussians(self) -> None:
        """What finds their axes must not grow with the square of their number."""
        points = np.random.default_rng(2).normal(size=(6000, 3)) * [4, 1, 2]
        many = Scene(Gaussians.from_points(points, np.full((len(points), 3), 0.5), np.ones(len(points))))
        tracemalloc.start()
        try:
            camera = overview(many, 160)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 5e7
        # It looks along the direction in which they extend least, with the longest one across.
        np.testing.assert_allclose(np.abs(camera.world_from_camera[0, :3, :3]).argmax(axis=0), [0, 2, 1])

    @pytest.mark.parametrize("count", [1, 2, 5])
    def test_an_overview_of_few_gaussians(self, count: int) -> None:
        points = np.arange(3.0 * count).reshape(count, 3)
        few = Scene(Gaussians.from_points(points, np.full((count, 3), 0.5), np.ones(count)))
        camera = overview(few, 160)
        assert np.isfinite(camera.world_from_camera).all()
        with pytest.raises(ConfigError, match="no Gaussians"):
            overview(Scene(few.gaussians.subset(torch.zeros(count, dtype=torch.bool))), 160)

    @pytest.mark.parametrize("spread", [0.0, 1e-7])
    @pytest.mark.parametrize("radius", [3.0, 1e-3])
    @pytest.mark.parametrize("count", [1, 6])
    def test_an_overview_of_gaussians_at_one_place_shows_them(
        self, count: int, radius: float, spread: float
    ) -> None:
        points = 5 + spread * np.arange(3.0 * count).reshape(count, 3)
        one = Scene(Gaussians.from_points(points, np.full((count, 3), 0.9), np.full(count, radius)))
        opaque = Scene(replace(one.gaussians, opacities=torch.full((count,), 4.0)))
        shown = SceneRenderer(opaque).render(overview(opaque, 48), ViewSettings(layer="alpha"))
        # Round, in the middle, and neither a dot nor all there is.
        assert shown[18, 24].min() > 200
        assert shown[0, 0].max() < 40
        assert 0.02 < (shown[..., 0] > 100).mean() < 0.6

    def test_typical_depths(self, scene: Scene, camera: Cameras) -> None:
        assert typical_depth(scene, camera) == 20.0
        unlit = typical_depth(Scene(scene.gaussians), camera)
        depths = camera.project(scene.gaussians.means.double().numpy())[1][0]
        assert unlit == pytest.approx(np.median(depths[depths > 0]), rel=1e-6)
