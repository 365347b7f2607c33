"""A real colon from CT: what is inside and outside is known everywhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_catalog.ct_colon.model import FOLDER
from extrags.config import ExploreConfig, FreespaceConfig
from extrags.exploration import explore
from extrags.freespace import carve
from extrags.surface import fuse_surface
from tests.benchmarks.bench_freespace import Truth, measured
from tests.colon_ct import ColonCT


@pytest.mark.parametrize("begin_mm", [20.0, pytest.param(1200.0, marks=pytest.mark.slow)])
def test_free_space_lies_inside_and_poses_have_the_room_they_are_said_to_have(
    shared_data: Path, begin_mm: float
) -> None:
    if not (shared_data / FOLDER).is_dir():
        pytest.skip("no ../shared/data/colon_ct_gca beside the checkout")
    colon = ColonCT.read(shared_data)
    scene, sequence = colon.stretch(begin_mm, begin_mm + 30, views=16, n_gaussians=6000, width=120, height=96)
    cameras = sequence.training_cameras
    space = carve(scene, fuse_surface(scene, cameras), cameras, FreespaceConfig(grid_size=64))
    truth = Truth(colon.wall)
    assert truth.closed
    found = measured(space, truth, cameras)
    assert found["outside"] == 0
    assert found["iou"] > 0.55
    assert found["recall_off_the_wall"] > 0.7
    assert found["clearance_over_mm"] < 0.5 * space.voxel_mm

    config = ExploreConfig(trajectories=2, length=5, max_expansions=8, render_width=48)
    exploration = explore(scene, sequence, config, freespace=space)
    assert len(exploration) > 0
    centers = exploration.cameras.centers
    room_mm = truth.inside_mm(centers)
    assert (room_mm > 0).all()
    assert (space.clearance_at(centers) <= room_mm + 0.25 * space.voxel_mm).all()
    assert np.isfinite(exploration.cameras.world_from_camera).all()
