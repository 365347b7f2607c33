"""What is measured of the renders of candidates, against images of which everything is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.exploration.frontier import find_frontier
from extrags.exploration.observation import Observation, observe
from extrags.freespace import FREE, FreeSpace
from extrags.raster import Rendering
from extrags.scene import Scene

from .tube import scene_of_points, small_config

WIDTH, HEIGHT, GAUSSIANS, UNIT_MM = 14, 9, 7, 20.0
Observe = Callable[..., list[Observation]]


class Images:
    """Renders of some views."""

    def __init__(self, views: int) -> None:
        generator = np.random.default_rng(views)
        shape = (views, HEIGHT, WIDTH)
        self.alpha = np.where(generator.random(shape) < 0.3, 0.3, 0.8)
        self.depth = generator.uniform(10, 60, shape)
        self.rgb = generator.uniform(0, 1.3, (*shape, 3))
        self.weight = generator.uniform(0, 0.04, (views, GAUSSIANS))
        self.size = generator.uniform(0, 0.1, (views, GAUSSIANS))
        self.radius = (generator.random((views, GAUSSIANS)) < 0.5).astype(np.float32)
        self.cameras = Cameras(
            np.tile(np.diag([9.0, 9, 1]), (views, 1, 1)), np.tile(np.eye(4), (views, 1, 1)), WIDTH, HEIGHT
        )
        # By which the renderer knows them again, whatever batch they come in.
        self.cameras.world_from_camera[:, 0, 3] = np.arange(views)

    def rendered(self, cameras: Cameras, mask: torch.Tensor | None) -> Rendering:
        which = cameras.centers[:, 0].round().astype(int)
        # Pixels that are left out count for no Gaussian; here they take all of their weight.
        counted = np.ones(len(which)) if mask is None else mask.numpy().mean(axis=(1, 2))
        parts = (
            self.rgb[which],
            self.alpha[which],
            self.depth[which],
            np.zeros((len(which), GAUSSIANS, 2)),
            self.radius[which],
        )
        return Rendering(
            *(torch.from_numpy(part.astype(np.float32)) for part in parts),
            visibility_max=torch.from_numpy((self.weight[which] * counted[:, None]).astype(np.float32)),
            visibility_sum=torch.from_numpy(self.size[which].astype(np.float32)),
        )


@pytest.fixture
def look(monkeypatch: pytest.MonkeyPatch) -> Observe:
    scene = scene_of_points(np.random.default_rng(0).normal(size=(GAUSSIANS, 3)))
    free = np.full((4, 4, 4), FREE, np.uint8)
    space = FreeSpace(free, np.zeros(3), np.eye(3), 1.0, np.ones(free.shape, np.float32))
    frontier = find_frontier(scene, space, 0.0)

    def look(
        images: Images, unit_mm: float | None = UNIT_MM, shown: object = None, **changes: object
    ) -> object:
        def render(_: Scene, cameras: Cameras, **options: object) -> Rendering:
            assert options["visibility"]
            mask = options["visibility_mask"]
            assert mask is None or isinstance(mask, torch.Tensor)
            return images.rendered(cameras, mask)

        monkeypatch.setattr(Scene, "render", render)
        config = small_config(**{"darkness_weight": 0.0, "max_hole_share": 0.75} | changes)
        return observe(scene, images.cameras, frontier, config, depth_unit_mm=unit_mm, shown=shown)

    return look


@pytest.mark.parametrize("unit", [1.0, 2.0**-10])
def test_every_view_is_measured_by_its_own_images(look: Observe, unit: float) -> None:
    """More views than one batch has, each with a mask of its own, in any unit of length."""
    images = Images(19)
    images.depth *= unit
    shown = np.random.default_rng(1).random((19, HEIGHT, WIDTH)) < 0.6
    found = look(images, shown=shown)
    assert len(found) == 19
    for index, view in enumerate(found):
        np.testing.assert_array_equal(view.pose, images.cameras.world_from_camera[index])
        np.testing.assert_array_equal(view.holes, (images.alpha[index] < 0.5) & shown[index])
        surface = (images.alpha[index] >= 0.5) & shown[index]
        np.testing.assert_array_equal(view.depth_mm, images.depth[index][surface].astype(np.float32))
        seen = images.weight[index] * shown[index].mean() > 0.02
        np.testing.assert_array_equal(view.visible, np.flatnonzero(seen))
        large = np.flatnonzero(images.size[index] > 0.05)
        np.testing.assert_array_equal(view.sizes.row, large)
        np.testing.assert_array_equal(view.sizes.size_px, images.size[index][large].astype(np.float32))
        white = (images.rgb[index] @ [0.2126, 0.7152, 0.0722] >= 1).mean()
        assert 0 < white < 0.5
        assert view.saturated_share == pytest.approx(white)
        assert not view.dark.any()


def test_by_the_frustum_all_gaussians_inside_the_image_are_seen(look: Observe) -> None:
    images = Images(3)
    for index, view in enumerate(look(images, visibility="frustum")):
        np.testing.assert_array_equal(view.visible, np.flatnonzero(images.radius[index]))


def test_orbits_go_round_the_middle_of_the_view(look: Observe) -> None:
    """The median of the central half in both directions, a quarter to two depth units away."""
    images = Images(5)
    images.depth[:] = 1000
    middle = images.depth[:, 2:7, 3:11]
    middle[:] = np.random.default_rng(0).uniform(15, 30, middle.shape)
    middle[1] *= 0.1
    middle[2] *= 10
    images.alpha[3, 2:7, 3:11] = 0.1
    found = [view.look_at_mm for view in look(images)]
    solid = images.alpha[[0, 4], 2:7, 3:11] >= 0.5
    medians = [float(np.median(middle[view][solid[k]])) for k, view in enumerate((0, 4))]
    # Too near, too far, and nothing in the middle: held at the limits, or at the unit.
    expected = [medians[0], 0.25 * UNIT_MM, 2 * UNIT_MM, UNIT_MM, medians[1]]
    assert found == pytest.approx(expected, rel=float(np.finfo(np.float32).eps))
    # A training view is left as it is: no orbit starts before the unit is known.
    assert [view.look_at_mm for view in look(images, None)] == [0.0] * 5


@pytest.mark.parametrize("holes", range(0, HEIGHT * WIDTH + 1, 6))
def test_too_many_holes_are_rejected(look: Observe, holes: int) -> None:
    images = Images(1)
    images.alpha.reshape(-1)[:] = np.where(np.arange(HEIGHT * WIDTH) < holes, 0.4, 0.9)
    (view,) = look(images, max_hole_share=0.6)
    assert view.rejected == (holes / (HEIGHT * WIDTH) > 0.6)
    (view,) = look(images, max_hole_share=1.0)
    assert view.rejected == (holes == HEIGHT * WIDTH)


@pytest.mark.parametrize("inside", [0, 44, 45, 46, 90])
def test_too_near_is_where_more_than_half_of_the_surface_is_inside_the_margin(
    look: Observe, inside: int
) -> None:
    images = Images(1)
    images.alpha[:] = 0.9
    # Where nothing is, nothing is near.
    images.alpha[0, :, 10:], images.depth[0, :, 10:] = 0.1, 0.5
    nearer = np.arange(90).reshape(HEIGHT, 10) < inside
    images.depth[0, :, :10] = np.where(nearer, 0.99, 1.01) * 0.2 * UNIT_MM
    (view,) = look(images, safety_share=0.2)
    assert view.rejected == (inside > 45)
    # A recording may go as near as it did.
    (view,) = look(images, None, safety_share=0.2)
    assert not view.rejected
