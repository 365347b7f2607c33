"""Which free space a ball can reach, against a search from voxel to voxel."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.freespace.passages import ball_mask, reachable

SIZE = 11


def cube_distance(marked: np.ndarray) -> np.ndarray:
    """From each centre to the nearest marked cube, by looking at all of them."""
    centers = np.argwhere(np.ones_like(marked))
    apart = np.maximum(np.abs(centers[:, None] - np.argwhere(marked)) - 0.5, 0)
    return np.sqrt((apart**2).sum(axis=-1)).min(axis=1, initial=np.inf).reshape(marked.shape)


def passed(free: np.ndarray, cameras: np.ndarray, radius: float) -> np.ndarray:
    """The rule, step by step: where the ball's centre goes, and what the ball covers from there."""
    clearance = cube_distance(~free)
    own = np.sort([clearance[tuple(camera)] for camera in cameras])
    # The lower quartile, linear between ranks.
    rank = (len(own) - 1) / 4
    low = int(rank)
    quartile = own[low] + (rank - low) * (own[min(low + 1, len(own) - 1)] - own[low])
    radius = min(radius, quartile)
    # Half a voxel less: the wall lies somewhere in its cubes. The centre itself needs room all the same.
    room = radius - 0.5 if radius >= 1 else min(radius, 0.5)
    gone = np.zeros_like(free)
    waiting = [tuple(camera) for camera in cameras.tolist()]
    while waiting:
        at = waiting.pop()
        if min(at) < 0 or max(at) >= len(free) or gone[at] or not free[at] or clearance[at] < room:
            continue
        gone[at] = True
        waiting += [(*at[:axis], at[axis] + step, *at[axis + 1 :]) for axis in range(3) for step in (-1, 1)]
    return free & (cube_distance(gone) <= radius)


class TestReachable:
    @pytest.mark.parametrize("radius", [0.0, 0.4, 0.8, 1.2, 1.6, 2.5])
    @pytest.mark.parametrize("seed", range(3))
    def test_is_what_a_ball_passes(self, seed: int, radius: float) -> None:
        generator = np.random.default_rng(seed)
        free = generator.random((SIZE, SIZE, SIZE)) < 0.985
        free[5], free[5, 4:7, 3:6], free[5, 9, 9] = False, True, True
        clearance = cube_distance(~free)
        # Cameras have different room: two of them the most there is on their side of the wall.
        roomy = np.argsort(-clearance[:5].reshape(-1), kind="stable")[:2]
        cameras = np.concatenate([np.argwhere(np.ones((5, SIZE, SIZE)))[roomy], [[2, 5, 5], [3, 4, 7]]])
        free[2, 5, 5] = free[3, 4, 7] = True
        clearance = cube_distance(~free)
        found = reachable(free, clearance, cameras, radius)
        np.testing.assert_array_equal(found, passed(free, cameras, radius))
        assert found.any()
        assert radius < 1.5 or found.sum() < free.sum()

    @pytest.mark.parametrize(("wide", "radius", "passes"), [(1, 1.4, False), (3, 1.4, True), (3, 2.6, False)])
    def test_a_hole_in_a_wall_is_passed_by_what_fits_through(
        self, wide: int, radius: float, passes: bool
    ) -> None:
        free = np.ones((SIZE, SIZE, SIZE), bool)
        free[5] = False
        first = 5 - wide // 2
        free[5, first : first + wide, first : first + wide] = True
        found = reachable(free, cube_distance(~free), np.array([[1, 5, 5]]), radius)
        assert found[:3].any()
        assert found[8, 5, 5] == passes

    def test_in_a_narrow_organ_the_ball_is_as_wide_as_the_cameras_have_room(self) -> None:
        free = np.zeros((SIZE, SIZE, SIZE), bool)
        free[1:10, 4:7, 4:7] = True
        cameras = np.array([[2, 5, 5], [4, 5, 5], [6, 5, 5], [8, 5, 5]])
        np.testing.assert_array_equal(reachable(free, cube_distance(~free), cameras, 40.0), free)


class TestBallMask:
    @pytest.mark.parametrize("radius", [0.3, 1.0, 1.5, 2.2, 3.0])
    def test_holds_the_centres_within_its_radius(self, radius: float) -> None:
        """Of every ball, those that reach beyond the grid too."""
        generator = np.random.default_rng(1)
        points = np.concatenate(
            [generator.uniform(-1, SIZE + 1, (6, 3)), [[4.5, 4.5, 4.5], [3.0, 4, 5], [0.4, 0.6, 0.5]]]
        )
        apart = np.argwhere(np.ones((SIZE, SIZE, SIZE))) + 0.5 - points[:, None]
        expected = (np.sqrt((apart**2).sum(axis=-1)) <= radius).any(axis=0).reshape(SIZE, SIZE, SIZE)
        np.testing.assert_array_equal(ball_mask(points, SIZE, radius), expected)
