from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from extrags.cameras import Cameras, rotation_about
from extrags.config import FreespaceConfig
from extrags.errors import CaptureError, PoseError, ShapeError
from extrags.freespace import FREE, OCCUPIED, UNKNOWN, FreeSpace, carve, voxel_visibility
from extrags.freespace.carving import _nearest_error, carving_views
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.surface import Mesh
from tests.extrags.exploration.tube import (
    scene_of_points,
    small_freespace,
    small_mesh,
    small_tube,
    square_camera,
)

AXES = rotation_about(np.array([1.0, 2.0, -1.0]), 0.7)


def made_space(occupancy: np.ndarray, voxel_mm: float = 2.0) -> FreeSpace:
    clearance = np.arange(occupancy.size, dtype=np.float32).reshape(occupancy.shape)
    return FreeSpace(occupancy, np.array([3.0, -5.0, 7.0]), AXES, voxel_mm, clearance)


def sheet(z: float, half: float = 12.0, n: int = 40) -> np.ndarray:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n)))
    return np.stack([x, y, np.full_like(x, z)], axis=1)


def sheet_mesh(z: float, half: float = 12.0) -> Mesh:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]], np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


class TestLookup:
    def test_finds_the_voxel_of_each_centre(self):
        occupancy = np.random.default_rng(0).integers(0, 3, (6, 6, 6)).astype(np.uint8)
        space = made_space(occupancy)
        np.testing.assert_array_equal(space.lookup(space.voxel_centers()), occupancy.ravel())
        np.testing.assert_allclose(space.clearance_at(space.voxel_centers()), np.arange(216), atol=1e-3)

    def test_the_free_share_is_that_of_all_voxels(self) -> None:
        occupancy = np.full((5, 5, 5), UNKNOWN, np.uint8)
        occupancy[1:3, 2, :4] = FREE
        assert made_space(occupancy).free_share == 8 / 125

    def test_clearance_is_linear_between_centres_and_never_negative(self) -> None:
        """Against the eight corners, weighed by hand; half a voxel from the faces it stays as it is."""
        generator = np.random.default_rng(3)
        space = made_space(np.zeros((6, 6, 6), np.uint8))
        space = replace(space, clearance=generator.uniform(-1, 3, (6, 6, 6)).astype(np.float32))
        grid = generator.uniform(0, 6, (200, 3))
        expected = np.zeros(200)
        for n, at in enumerate(np.clip(grid - 0.5, 0, 5)):
            low = np.minimum(np.floor(at).astype(int), 4)
            for corner in np.ndindex(2, 2, 2):
                weight = np.prod(np.where(corner, at - low, 1 - (at - low)))
                expected[n] += weight * space.clearance[tuple(low + corner)]
        assert (expected < 0).any()
        found = space.clearance_at(space.from_grid(grid))
        np.testing.assert_allclose(found, np.maximum(expected, 0), atol=8 * np.finfo(np.float32).eps)

    def test_outside_is_unknown(self):
        space = made_space(np.zeros((6, 6, 6), np.uint8))
        outside = space.origin_mm + np.array([[-0.01, 1, 1], [1, 12.01, 1], [1, 1, 500]]) @ AXES
        np.testing.assert_array_equal(space.lookup(outside), UNKNOWN)
        np.testing.assert_array_equal(space.clearance_at(outside), 0)

    def test_shapes_that_do_not_fit_are_refused(self):
        with pytest.raises(ShapeError, match="S x S x S"):
            FreeSpace(
                np.zeros((4, 4, 4), np.uint8), np.zeros(3), np.eye(3), 1.0, np.zeros((4, 4, 5), np.float32)
            )

    def test_round_trip_on_disk(self, tmp_path):
        space = small_freespace()
        space.save(tmp_path / "freespace")
        loaded = FreeSpace.load(tmp_path / "freespace")
        for name in ("occupancy", "clearance", "origin_mm", "axes"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(space, name))
        assert loaded.voxel_mm == space.voxel_mm


class TestSegments:
    @settings(max_examples=60, deadline=None)
    @given(seed=st.integers(0, 10_000))
    def test_agree_with_dense_sampling(self, seed):
        rng = np.random.default_rng(seed)
        occupancy = (rng.random((7, 7, 7)) < 0.12).astype(np.uint8)
        space = made_space(occupancy)
        ends = space.origin_mm + rng.uniform(0, 14, (2, 5, 3)) @ AXES
        free = space.segment_is_free(ends[0], ends[1])
        t = np.linspace(0, 1, 4001)[:, None, None]
        sampled = (space.lookup((1 - t) * ends[0] + t * ends[1]) == FREE).all(axis=0)
        # Sampling may miss a voxel that the segment only grazes, never the other way round.
        assert (sampled | ~free).all()
        grazed = sampled & ~free
        for k in np.flatnonzero(grazed):
            fine = np.linspace(0, 1, 400_001)[:, None]
            assert (space.lookup((1 - fine) * ends[0, k] + fine * ends[1, k]) != FREE).any()

    def test_thin_walls_stop_them(self):
        occupancy = np.zeros((8, 8, 8), np.uint8)
        occupancy[4] = OCCUPIED
        space = made_space(occupancy)
        centers = space.voxel_centers().reshape(8, 8, 8, 3)
        assert space.segment_is_free(centers[0, 0, 0], centers[3, 7, 7])
        assert not space.segment_is_free(centers[0, 0, 0], centers[7, 0, 0])

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize("slant", [0.0, 0.3])
    def test_one_voxel_stops_a_segment_alone_from_either_side(self, axis: int, slant: float) -> None:
        """Alone: among many, the longest one decides how finely all of them are cut."""
        start = np.full(3, 2.5)
        for steps in (1, 2, 4):
            end = start + slant * steps / 4
            end[axis] = start[axis] + steps
            for wall in range(7):
                occupancy = np.full((7, 7, 7), FREE, np.uint8)
                where = [2, 2, 2]
                where[axis] = wall
                occupancy[tuple(where)] = OCCUPIED
                space = made_space(occupancy)
                a, b = space.from_grid(start), space.from_grid(end)
                expected = not 2 <= wall <= 2 + steps
                assert bool(space.segment_is_free(a, b)) == expected
                assert bool(space.segment_is_free(b, a)) == expected

    def test_a_point_is_a_segment(self):
        occupancy = np.zeros((4, 4, 4), np.uint8)
        occupancy[1, 1, 1] = UNKNOWN
        space = made_space(occupancy)
        centers = space.voxel_centers().reshape(4, 4, 4, 3)
        assert space.segment_is_free(centers[0, 0, 0], centers[0, 0, 0])
        assert not space.segment_is_free(centers[1, 1, 1], centers[1, 1, 1])

    def test_leaving_the_volume_is_not_free(self):
        space = made_space(np.zeros((4, 4, 4), np.uint8))
        inside = space.voxel_centers()[0]
        assert not space.segment_is_free(inside, inside - 50 * AXES[0])

    def test_none_is_none(self):
        space = made_space(np.zeros((4, 4, 4), np.uint8))
        assert space.segment_is_free(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)


class TestVisibility:
    CONFIG = FreespaceConfig()

    def test_is_one_in_front_and_nothing_behind(self):
        scene = scene_of_points(sheet(8.0))
        points = np.array([[0, 0, 4.0], [0, 0, 7.0], [0, 0, 10.0], [2.0, 1.0, 12.0]])
        visibility = voxel_visibility(scene, square_camera(), points, self.CONFIG)
        np.testing.assert_allclose(visibility, [1, 1, 0, 0], atol=0.05)

    def test_outside_the_image_nobody_can_tell(self):
        scene = scene_of_points(sheet(8.0))
        points = np.array([[0, 0, -4.0], [30.0, 0, 4.0]])
        assert np.isnan(voxel_visibility(scene, square_camera(), points, self.CONFIG)).all()

    def test_a_ray_that_ends_nowhere_proves_nothing(self):
        scene = scene_of_points(sheet(8.0, half=3.0, n=12))
        points = np.array([[0, 0, 4.0], [3.5, 3.5, 4.0]])
        visibility = voxel_visibility(scene, square_camera(), points, self.CONFIG)
        assert visibility[0] == pytest.approx(1, abs=0.05)
        assert np.isnan(visibility[1])

    def test_is_the_mean_of_the_best_three(self):
        # Four views on a line; a screen hides the point from some of them.
        wall = sheet(20.0, half=30.0, n=100)
        poses = np.stack([np.eye(4)] * 4)
        poses[:, 0, 3] = [-6, -2, 2, 6]
        K = np.broadcast_to(square_camera().K, (4, 3, 3)).copy()
        point = np.array([[0.0, 0, 10.0]])
        for hidden, expected in ((1, 1.0), (2, 2 / 3), (3, 1 / 3)):
            between = poses[:hidden, :3, 3] * 0.5 + point * 0.5
            screen = (between[:, None] + sheet(0.0, half=0.5, n=9)).reshape(-1, 3)
            scene = Scene(
                Gaussians.concatenated(
                    scene_of_points(wall).gaussians, scene_of_points(screen, radius=0.15).gaussians
                )
            )
            visibility = voxel_visibility(scene, Cameras(K, poses, 32, 32), point, self.CONFIG)
            assert visibility[0] == pytest.approx(expected, abs=0.05)

    def test_two_views_are_averaged_over_two(self):
        scene = scene_of_points(sheet(8.0))
        poses = np.stack([np.eye(4)] * 2)
        cameras = Cameras(np.concatenate([square_camera().K] * 2), poses, 32, 32)
        visibility = voxel_visibility(scene, cameras, np.array([[0, 0, 4.0]]), self.CONFIG)
        assert visibility[0] == pytest.approx(1, abs=0.05)


class TestCarve:
    def test_no_free_voxel_lies_outside_the_tube(self):
        space, tube = small_freespace(), small_tube()
        centers = space.voxel_centers()[space.occupancy.ravel() == FREE]
        assert len(centers) > 500
        assert (tube.distance_from_wall(centers) > 0).all()

    def test_the_lumen_between_the_cameras_is_free(self):
        space, tube = small_freespace(), small_tube()
        assert (space.lookup(tube.cameras.centers) == FREE).all()
        assert space.segment_is_free(tube.cameras.centers[:-1], tube.cameras.centers[1:]).all()

    def test_the_wall_is_occupied_and_beyond_it_nothing_known(self):
        space, tube = small_freespace(), small_tube()
        assert (space.lookup(small_mesh().vertices.astype(np.float64)) != FREE).all()
        centers = space.voxel_centers()
        beyond = tube.distance_from_wall(centers) < -4 * space.voxel_mm
        assert (space.occupancy.ravel()[beyond] == UNKNOWN).all()

    def test_clearance_is_the_distance_to_the_nearest_cube_that_is_not_free(self):
        space = small_freespace()
        state, size = space.occupancy.ravel(), space.grid_size
        index = np.stack(np.unravel_index(np.arange(size**3), (size,) * 3), axis=1)
        blocked = index[state != FREE]
        some = np.random.default_rng(0).permutation(np.flatnonzero(state == FREE))[:40]
        gap = np.maximum(np.abs(index[some][:, None] - blocked[None]) - 0.5, 0)
        brute = space.voxel_mm * np.sqrt((gap**2).sum(axis=-1)).min(axis=1)
        np.testing.assert_allclose(space.clearance.ravel()[some], brute, rtol=1e-5)
        assert (space.clearance.ravel()[state != FREE] < 0).all()

    def test_clearance_never_exceeds_the_distance_to_the_mesh(self):
        space, mesh = small_freespace(), small_mesh()
        middle = small_tube().cameras.centers[3:]
        exact = np.linalg.norm(middle[:, None] - mesh.vertices[None], axis=-1).min(axis=1)
        found = space.clearance_at(middle)
        assert (found <= exact).all()
        assert (found > space.voxel_mm).all()

    def test_voxels_are_cubes_along_the_principal_axes(self):
        space = small_freespace()
        np.testing.assert_allclose(space.axes @ space.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(space.axes) == pytest.approx(1)
        points = np.concatenate([small_mesh().vertices, small_tube().cameras.centers])
        _, spread, principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        assert spread[0] > spread[1] > spread[2]
        np.testing.assert_allclose(np.abs(space.axes @ principal.T), np.eye(3), atol=1e-4)

    def test_is_deterministic(self):
        tube = small_tube()
        config = FreespaceConfig(grid_size=16, render_width=32)
        first = carve(tube.scene, small_mesh(), tube.cameras, config)
        second = carve(tube.scene, small_mesh(), tube.cameras, config)
        assert first.occupancy.tobytes() == second.occupancy.tobytes()
        assert first.clearance.tobytes() == second.clearance.tobytes()

    def test_behind_a_screen_is_unknown_not_occupied(self):
        scene = scene_of_points(np.concatenate([sheet(6.0, half=2.0, n=10), sheet(16.0, half=20.0, n=80)]))
        screen, wall = sheet_mesh(6.0, 2.0), sheet_mesh(16.0, 20.0)
        both = Mesh(
            np.concatenate([screen.vertices, wall.vertices]),
            np.concatenate([screen.triangles, wall.triangles + 4]),
        )
        config = FreespaceConfig(grid_size=32, wall_voxels=1.5, passage_share=0.0)
        space = carve(scene, both, square_camera(), config)
        assert space.lookup(np.array([0.0, 0, 3.0])) == FREE
        assert space.lookup(np.array([0.0, 0, 6.0])) == OCCUPIED
        assert space.lookup(np.array([0.0, 0, 11.0])) == UNKNOWN
        assert space.lookup(np.array([8.0, 0, 11.0])) == FREE

    @pytest.mark.parametrize(("wall_voxels", "layers"), [(0.3, 0), (1.5, 1), (3.0, 3)])
    def test_the_wall_is_as_thick_as_is_asked_for(self, wall_voxels, layers):
        scene, wall = scene_of_points(sheet(16.0, half=20.0, n=80)), sheet_mesh(16.0, 20.0)
        config = FreespaceConfig(grid_size=32, wall_voxels=wall_voxels, passage_share=0.0, margin_share=0.2)
        space = carve(scene, wall, square_camera(), config)
        at_wall = space.from_grid(np.floor(space.to_grid(np.array([0.3, 0.3, 16.0]))) + 0.5)
        behind = at_wall + np.outer(np.arange(6) * space.voxel_mm, [0, 0, 1])
        expected = np.where(np.arange(6) <= layers, OCCUPIED, UNKNOWN)
        np.testing.assert_array_equal(space.lookup(behind), expected)

    def test_the_views_that_carve_are_far_from_each_other(self):
        tube = small_tube()
        # Most of the recording lingers in one place.
        cameras = tube.cameras[[0] * 6 + [4, 7]]
        chosen = carving_views(tube.scene, cameras, FreespaceConfig(max_views=3))
        found = np.unique(cameras.centers[chosen], axis=0)
        np.testing.assert_array_equal(found, np.unique(tube.cameras.centers[[0, 4, 7]], axis=0))

    def test_what_no_mask_shows_is_not_free(self):
        """A camera before a wall, whose picture is the left half of its image."""
        scene, wall = scene_of_points(sheet(16.0, half=20.0, n=80)), sheet_mesh(16.0, 20.0)
        config = FreespaceConfig(grid_size=32, passage_share=0.0, margin_share=0.2)
        camera = square_camera()
        mask = np.zeros((camera.height, camera.width), dtype=bool)
        mask[:, : camera.width // 2] = True
        whole = carve(scene, wall, camera, config)
        half = carve(scene, wall, camera, config, masks=[mask])
        left, right = (whole.from_grid(whole.to_grid(np.array([x, 0.0, 10.0]))) for x in (-3.0, 3.0))
        assert whole.lookup(left) == whole.lookup(right) == half.lookup(left) == FREE
        assert half.lookup(right) == UNKNOWN
        everything = carve(scene, wall, camera, config, masks=[np.ones_like(mask)])
        np.testing.assert_array_equal(everything.occupancy, whole.occupancy)

    def test_the_largest_error_of_a_voxel_counts(self):
        vertices = np.array([[0.2, 0.5, 0.5], [0.6, 0.5, 0.5], [0.7, 0.5, 0.5], [3.5, 3.5, 3.5]])
        found = _nearest_error(vertices, np.array([0.1, 0.4, 0.2, 0.3]), 4)
        assert found[0, 0, 0] == found[1, 0, 0] == 0.4
        assert found[3, 3, 3] == found[3, 3, 2] == 0.3

    def test_one_training_view_is_enough(self):
        tube = small_tube()
        space = carve(
            tube.scene, small_mesh(), tube.cameras[[4]], FreespaceConfig(grid_size=24, render_width=32)
        )
        assert space.lookup(tube.cameras.centers[[4]])[0] == FREE
        ahead = tube.cameras.centers[4] + 5 * tube.cameras.forward[4]
        assert space.lookup(ahead) == FREE

    def test_no_views_are_refused(self):
        tube = small_tube()
        with pytest.raises(CaptureError, match="no views to carve"):
            carve(tube.scene, small_mesh(), tube.cameras[[]], FreespaceConfig(grid_size=8))

    def test_a_camera_that_stands_nowhere_is_refused(self):
        tube = small_tube()
        poses = tube.cameras.world_from_camera.copy()
        poses[2, 0, 3] = np.nan
        lost = replace(tube.cameras, world_from_camera=poses)
        with pytest.raises(PoseError, match="world_from_camera: view 2 of 8"):
            carve(tube.scene, small_mesh(), lost)

    def test_a_volume_without_extent_is_refused(self):
        tube = small_tube()
        point = Mesh(tube.cameras.centers[[0, 0, 0]].astype(np.float32), np.array([[0, 1, 2]], np.int32))
        cameras = replace(tube.cameras[[0]], world_from_camera=np.round(tube.cameras.world_from_camera[[0]]))
        at_camera = replace(point, vertices=cameras.centers[[0, 0, 0]].astype(np.float32))
        with pytest.raises(CaptureError, match="in one point"):
            carve(tube.scene, at_camera, cameras, FreespaceConfig(grid_size=8))
