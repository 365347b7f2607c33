"""The coarse-to-fine decision against the full one."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.config import FreespaceConfig
from extrags.freespace.grid import voxel_centers
from extrags.freespace.visibility import ViewDepths, seen_through, voxel_visibility
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
