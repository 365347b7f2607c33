from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from extrags.cameras import Cameras, pixel_rays, rotation_about
from extrags.errors import ShapeError
from extrags.exploration.coverage import direction_bin
from extrags.exploration.frontier import Frontier, find_frontier
from extrags.freespace import FREE, OCCUPIED, UNKNOWN, FreeSpace

from .tube import scene_of_points, small_freespace, small_tube, square_camera

SIZE = 16


def room(voxel_mm: float = 1.0) -> FreeSpace:
    """A cube of 8 x 8 x 8 free voxels about the origin, one wall occupied, all else unknown."""
    occupancy = np.full((SIZE,) * 3, UNKNOWN, np.uint8)
    occupancy[4:12, 4:12, 4:12] = FREE
    occupancy[3, 4:12, 4:12] = OCCUPIED
    corner = np.full(3, -0.5 * SIZE * voxel_mm)
    return FreeSpace(occupancy, corner, np.eye(3), voxel_mm, np.ones((SIZE,) * 3, np.float32))


def frontier_of(space: FreeSpace, weight: float = 1.0) -> Frontier:
    points = np.array([[-4.2, 0, 0], [-4.3, 0, 0], [-4.4, 2.0, 0]])
    return find_frontier(scene_of_points(points), space, weight)


def words_of(found: Frontier, camera: Cameras, holes: np.ndarray) -> np.ndarray:
    words = np.zeros(len(found), np.uint32)
    seen, value = found.pairs(camera, holes, 32)
    words[seen] = value
    return words


def everywhere(camera: Cameras) -> np.ndarray:
    return np.ones((camera.height, camera.width), bool)


class TestFindFrontier:
    def test_is_the_shell_of_the_free_space(self):
        found = frontier_of(room())
        assert len(found) == 10**3 - 8**3
        inside = np.abs(found.centers) < 5
        assert inside.all()
        assert (np.abs(found.centers).max(axis=1) == 4.5).all()

    def test_free_space_at_the_edge_of_the_grid_has_one_too(self):
        space = room()
        found = frontier_of(replace(space, occupancy=np.full((SIZE,) * 3, FREE, np.uint8)))
        assert len(found) == (SIZE + 2) ** 3 - SIZE**3

    def test_a_voxel_is_worth_the_gaussians_of_a_voxel_that_holds_any(self):
        # Three Gaussians in two voxels.
        assert frontier_of(room()).pair_value == pytest.approx(1.5)
        assert frontier_of(room(), weight=4.0).pair_value == pytest.approx(6.0)

    def test_no_weight_no_frontier(self):
        found = frontier_of(room(), weight=0.0)
        assert len(found) == 0
        assert found.pair_value == 0
        assert words_of(found, square_camera(), everywhere(square_camera())).shape == (0,)


class TestPairs:
    def test_each_ray_covers_the_voxel_it_enters(self):
        camera = square_camera()
        found = frontier_of(room())
        words = words_of(found, camera, everywhere(camera))
        # 90 degrees wide in a cube: the face ahead, 8 x 8 voxels whose centres are at z = 4.5, and its rim.
        seen = found.centers[words > 0]
        ahead = (seen[:, 2] == 4.5) & (np.abs(seen[:, :2]) < 4).all(axis=1)
        assert ahead.sum() == 64
        toward = -found.centers / np.linalg.norm(found.centers, axis=1, keepdims=True)
        bins = np.uint32(1) << direction_bin(toward, 32).astype(np.uint32)
        np.testing.assert_array_equal(words[words > 0], bins[words > 0])

    def test_counts_the_rays_into_each_voxel(self):
        camera = square_camera()
        found = frontier_of(room())
        seen, pixels = found.counts(camera, everywhere(camera))
        words = words_of(found, camera, everywhere(camera))
        np.testing.assert_array_equal(seen, np.flatnonzero(words))
        # Every ray leaves free space through a voxel of the shell.
        assert pixels.sum() == 32 * 32
        ahead = (found.centers[seen] == [0.5, 0.5, 4.5]).all(axis=1)
        # A voxel of edge 1 on the face at depth 4, with 16 px of focal length: 4 x 4 pixels.
        assert pixels[ahead].tolist() == [16]

    def test_only_holes_count(self):
        camera = square_camera()
        found = frontier_of(room())
        nothing = np.zeros((32, 32), bool)
        assert not words_of(found, camera, nothing).any()
        left = nothing.copy()
        left[:, :8] = True
        seen = found.centers[words_of(found, camera, left) > 0]
        assert len(seen) > 0
        assert (seen[:, 0] < 0).all()

    def test_agrees_with_small_steps_in_a_real_free_space(self):
        tube, space = small_tube(), small_freespace()
        found = find_frontier(tube.scene, space, 1.0)
        camera = tube.cameras[3].resized(32, 24)
        pose = camera.world_from_camera.copy()
        pose[0, :3, :3] = pose[0, :3, :3] @ rotation_about(np.array([0.0, 1.0, 0.0]), 0.7)
        camera = replace(camera, world_from_camera=pose)
        rays = pixel_rays(camera)[0].reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        expected, side_mm = set(), space.grid_size * space.voxel_mm
        for ray in rays:
            points = camera.centers[0] + np.arange(0, 2 * side_mm, 0.002 * space.voxel_mm)[:, None] * ray
            first = points[np.argmax(space.lookup(points) != FREE)]
            expected.add(tuple(np.floor(space.to_grid(first)).astype(int) + 1))
        entered = set(
            map(tuple, np.argwhere(found.row >= 0)[words_of(found, camera, everywhere(camera)) > 0])
        )
        # The small steps may pass a corner of a voxel.
        assert len(entered) > 100
        assert len(entered & expected) > 0.97 * len(entered | expected)

    def test_a_mask_of_another_size_is_refused(self):
        with pytest.raises((ShapeError, TypeCheckError), match="holes"):
            frontier_of(room()).pairs(square_camera(), np.ones((3, 3), bool), 32)
