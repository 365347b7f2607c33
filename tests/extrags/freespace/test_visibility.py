"""The coarse-to-fine decision against the full one."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.cameras import Cameras
from extrags.config import FreespaceConfig
from extrags.freespace.grid import voxel_centers
from extrags.freespace.visibility import ViewDepths, seen_through, voxel_visibility
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from tests.extrags.exploration.tube import small_freespace, small_tube


@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.7])
@pytest.mark.parametrize(("size", "top_views"), [(20, 3), (33, 1), (40, 3)])
def test_equals_the_full_evaluation(size: int, top_views: int, threshold: float) -> None:
    tube, space = small_tube(), small_freespace()
    config = FreespaceConfig(grid_size=size, top_views=top_views, occupied_below=threshold, render_width=40)
    voxel_mm = space.voxel_mm * space.grid_size / size
    grid = (space.origin_mm, space.axes, voxel_mm)
    views = ViewDepths.rendered(tube.scene, tube.cameras, config)
    found = seen_through(tube.scene, views, *grid, np.ones((size,) * 3, bool), config)
    full = voxel_visibility(tube.scene, tube.cameras, voxel_centers(size, *grid), config)
    np.testing.assert_array_equal(found.ravel(), full >= threshold)
    assert 0.01 < found.mean() < 0.5


@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.7])
def test_equals_the_full_evaluation_inside_masks(threshold: float) -> None:
    tube, space = small_tube(), small_freespace()
    config = FreespaceConfig(grid_size=24, occupied_below=threshold, render_width=40)
    voxel_mm = space.voxel_mm * space.grid_size / 24
    grid = (space.origin_mm, space.axes, voxel_mm)
    cameras = tube.cameras
    y, x = np.mgrid[: cameras.height, : cameras.width] + 0.5
    disc = np.hypot(y - cameras.height / 2, x - cameras.width / 2) < 0.3 * cameras.width
    views = ViewDepths.rendered(tube.scene, cameras, config, [disc] * len(cameras))
    everything = ViewDepths.rendered(tube.scene, cameras, config)
    found, whole = (
        seen_through(tube.scene, seen, *grid, np.ones((24,) * 3, bool), config)
        for seen in (views, everything)
    )
    points = voxel_centers(24, *grid)
    full = voxel_visibility(tube.scene, cameras, points, config, observing=views.depth >= 0)
    np.testing.assert_array_equal(found.ravel(), full >= threshold)
    # What is seen in no mask is not seen at all.
    pixels, _ = cameras.project(points)
    inside = cameras.contains(pixels)
    column, row = np.where(inside[..., None], pixels, 0).astype(np.int64).transpose(2, 0, 1)
    in_a_mask = (inside & disc[row, column]).any(axis=0)
    assert found.ravel()[~in_a_mask].mean() < 0.02 * whole.mean()
    assert 0.2 * whole.mean() < found.mean() < 0.95 * whole.mean()


def test_decides_only_what_is_asked() -> None:
    tube, space = small_tube(), small_freespace()
    config = FreespaceConfig(grid_size=32, render_width=40)
    views = ViewDepths.rendered(tube.scene, tube.cameras, config)
    grid = (space.origin_mm, space.axes, space.voxel_mm)
    asked = np.random.default_rng(0).random((32, 32, 32)) < 0.3
    everything = seen_through(tube.scene, views, *grid, np.ones_like(asked), config)
    np.testing.assert_array_equal(seen_through(tube.scene, views, *grid, asked, config), everything & asked)


def test_more_views_that_see_a_voxel_keep_it() -> None:
    tube, space = small_tube(), small_freespace()
    config = FreespaceConfig(grid_size=24, render_width=40)
    voxel_mm = space.voxel_mm * space.grid_size / 24
    grid = (space.origin_mm, space.axes, voxel_mm)
    points = voxel_centers(24, *grid)
    for further in range(3, len(tube.cameras)):
        few, more = (
            voxel_visibility(tube.scene, tube.cameras[:n], points, config) for n in (further, further + 1)
        )
        alone = voxel_visibility(tube.scene, tube.cameras[[further]], points, config)
        seen_by_it = (few >= 0.5) & (alone >= 0.5)
        assert seen_by_it.any()
        assert (more[seen_by_it] >= 0.5).all()


def test_a_wall_so_far_away_that_a_block_is_less_than_a_pixel() -> None:
    focal_px, side_px, far = 60.0, 160, 200.0
    K = np.array([[focal_px, 0, side_px / 2], [0, focal_px, side_px / 2], [0, 0, 1]])
    cameras = Cameras(K[None], np.eye(4)[None], side_px, side_px)
    along = np.arange(-40, 41, 1.0)
    points = np.stack([*np.meshgrid(along, along), np.full((81, 81), far)], axis=-1).reshape(-1, 3)
    facing = np.tile([0, 0, 1.0], (len(points), 1))
    wall = Gaussians.from_points(
        points, np.full_like(points, 0.5), np.ones(len(points)), opacity=0.99, normals=facing, thickness=0.01
    )
    scene, config = Scene(wall, None), FreespaceConfig(top_views=1)
    views = ViewDepths.rendered(scene, cameras, config)
    grid = np.array([-8.0, -8.0, far - 12.3]), np.eye(3), 1.0
    within = np.ones((16, 16, 16), bool)
    found = seen_through(scene, views, *grid, within, config)
    shares = voxel_visibility(scene, views.cameras, voxel_centers(16, *grid), config)
    np.testing.assert_array_equal(found, shares.reshape(within.shape) >= config.occupied_below)
    assert 0 < found.mean() < 1
