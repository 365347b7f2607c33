"""Walls with holes, thin walls, and what must hold of any world: nothing behind the wall is ever used."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from extrags.cameras import rotation_about
from extrags.config import FreespaceConfig, SurfaceConfig
from extrags.freespace import FREE, FreeSpace, carve
from extrags.freespace.carving import carving_views
from extrags.freespace.distances import distance_to_cubes
from extrags.freespace.passages import reachable
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.surface import Mesh, fuse_surface
from tests.extrags.exploration.tube import (
    Tube,
    centre_line,
    make_tube,
    scene_of_points,
    small_mesh,
    small_tube,
)

CONFIG = FreespaceConfig(grid_size=64, render_width=96)


@cache
def torn_tube() -> tuple[Scene, Tube]:
    """A tube whose outer wall has a hole 8 mm wide; a sphere around everything catches rays through it."""
    tube = make_tube(n_gaussians=4000, n_views=10, width=96, height=72, light=False)
    means = tube.scene.gaussians.means.numpy()
    outward = np.array([np.cos(1.0), np.sin(1.0), 0.0])
    hole = np.linalg.norm(means - (centre_line(1.0) + 20 * outward), axis=1) < 4.0
    assert hole.any()
    kept = tube.scene.gaussians.subset(torch.from_numpy(~hole))
    z = 1 - (2 * np.arange(8000) + 1) / 8000
    turn = np.arange(8000) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    sphere = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1) * 110
    outer = scene_of_points(sphere, radius=3.0).gaussians
    return Scene(Gaussians.concatenated(kept, outer)), tube


def free_beyond(space: FreeSpace, tube: Tube, margin: float) -> int:
    centers = space.voxel_centers()[space.occupancy.ravel() == FREE]
    return int((tube.distance_from_wall(centers) < -margin).sum())


def test_what_lies_behind_a_hole_is_not_free() -> None:
    scene, tube = torn_tube()
    mesh = fuse_surface(scene, tube.cameras, SurfaceConfig(voxel_share=1 / 48))
    sealed = carve(scene, mesh, tube.cameras, CONFIG)
    leaking = carve(scene, mesh, tube.cameras, CONFIG.model_copy(update={"passage_share": 0.0}))
    assert free_beyond(leaking, tube, sealed.voxel_mm) > 20
    assert free_beyond(sealed, tube, sealed.voxel_mm) == 0
    assert (sealed.lookup(tube.cameras.centers) == FREE).all()
    assert sealed.segment_is_free(tube.cameras.centers[:-1], tube.cameras.centers[1:]).all()


def test_a_mesh_without_some_triangles_leaks_nothing() -> None:
    tube, mesh = small_tube(), small_mesh()
    kept = np.random.default_rng(0).random(len(mesh.triangles)) > 0.1
    torn = Mesh(mesh.vertices, mesh.triangles[kept])
    space = carve(tube.scene, torn, tube.cameras, FreespaceConfig(grid_size=48, render_width=48))
    assert free_beyond(space, tube, 0.0) == 0


def test_missing_gaussians_open_no_wall() -> None:
    tube = small_tube()
    gaussians = tube.scene.gaussians
    kept = torch.from_numpy(np.random.default_rng(1).random(len(gaussians)) > 0.15)
    scene = Scene(gaussians.subset(kept))
    mesh = fuse_surface(scene, tube.cameras, SurfaceConfig(voxel_share=1 / 32))
    space = carve(scene, mesh, tube.cameras, FreespaceConfig(grid_size=48, render_width=48))
    assert (space.occupancy == FREE).sum() > 1000
    assert free_beyond(space, tube, space.voxel_mm) == 0


def test_a_ball_passes_a_wide_gap_alone() -> None:
    free = np.ones((24, 9, 9), bool)
    for gap, passes in ((1, False), (7, True)):
        wall = np.zeros_like(free)
        wall[12] = True
        half = gap // 2
        wall[12, 4 - half : 5 + half, 4 - half : 5 + half] = False
        clearance = distance_to_cubes(wall, 30.0)
        found = reachable(free & ~wall, clearance, np.array([[3, 4, 4]]), 2.5)
        assert found[3, 4, 4]
        assert bool(found[20, 4, 4]) is passes


def test_a_camera_at_a_thin_wall_frees_nothing_behind_it() -> None:
    tube, mesh = small_tube(), small_mesh()
    poses = tube.cameras.world_from_camera.copy()
    outward = np.array([np.cos(0.6), np.sin(0.6), 0.0])
    poses[2, :3, 3] = centre_line(0.6) + 18.0 * outward
    cameras = replace(tube.cameras, world_from_camera=poses)
    space = carve(tube.scene, mesh, cameras, FreespaceConfig(grid_size=32, render_width=48))
    assert space.lookup(cameras.centers[2]) == FREE
    assert free_beyond(space, tube, 0.0) == 0


@pytest.mark.parametrize("scale", [1.0, 0.02, 30.0])
def test_states_do_not_depend_on_where_the_world_lies_and_how_large_it_is(scale: float) -> None:
    tube, mesh = small_tube(), small_mesh()
    config = FreespaceConfig(grid_size=32, render_width=48)
    space = carve(Scene(tube.scene.gaussians), mesh, tube.cameras, config)
    rotation = rotation_about(np.array([1.0, -2.0, 0.5]), 1.9)
    shift = scale * np.array([30.0, -50.0, 20.0])
    gaussians = tube.scene.gaussians
    # The Gaussians are round: their rotations do not matter.
    moved = replace(
        gaussians,
        means=torch.from_numpy((scale * gaussians.means.numpy() @ rotation.T + shift).astype(np.float32)),
        scales=gaussians.scales + float(np.log(scale)),
    )
    poses = tube.cameras.world_from_camera.copy()
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + shift
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    vertices = (scale * mesh.vertices @ rotation.T + shift).astype(np.float32)
    found = carve(
        Scene(moved), replace(mesh, vertices=vertices), replace(tube.cameras, world_from_camera=poses), config
    )
    points = space.voxel_centers()
    there = scale * points @ rotation.T + shift
    assert (found.lookup(there) == space.lookup(points)).mean() > 0.997
    free = space.occupancy.ravel() == FREE
    apart = np.abs(found.clearance_at(there) / scale - space.clearance_at(points))[free]
    assert np.median(apart) < 0.01 * space.voxel_mm
    assert np.quantile(apart, 0.98) < 1.1 * space.voxel_mm


class TestCarvingViews:
    def test_few_are_all(self):
        tube, cameras = small_tube(), small_tube().cameras
        np.testing.assert_array_equal(carving_views(tube.scene, cameras, CONFIG), np.arange(len(cameras)))

    def test_many_are_the_most_different(self):
        tube = make_tube(n_gaussians=1500, n_views=60, width=48, height=36, light=False)
        config = FreespaceConfig(max_views=12, render_width=48)
        chosen = carving_views(tube.scene, tube.cameras, config)
        assert len(chosen) == 12
        # Their spread is that of all: every camera has a chosen one within a tenth of the way or so.
        centers = tube.cameras.centers
        away = np.linalg.norm(centers[:, None] - centers[chosen][None], axis=-1).min(axis=1)
        length = np.linalg.norm(np.diff(tube.cameras.centers, axis=0), axis=1).sum()
        assert away.max() < 0.1 * length

    def test_a_third_of_the_frames_finds_nearly_all_that_all_find(self):
        tube = make_tube(n_gaussians=1500, n_views=60, width=48, height=36, light=False)
        config = FreespaceConfig(grid_size=32, render_width=48)
        everything = carve(tube.scene, small_mesh(), tube.cameras, config).occupancy == FREE
        config = config.model_copy(update={"max_views": 20})
        found = carve(tube.scene, small_mesh(), tube.cameras, config).occupancy == FREE
        assert (found & everything).sum() / (found | everything).sum() > 0.95
