"""Views chosen with the true surface: what they are worth is what the truth measures."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog.clairvoyant import LackingSurface, clairvoyant_clips, free_viewpoint_poses
from data_catalog.surface_views import SurfaceTruth
from extrags.cameras import Cameras
from extrags.config import ExploreConfig
from extrags.exploration.ways import Clip, Moves, random_walk
from extrags.freespace import FREE, OCCUPIED, FreeSpace
from tests.data_catalog.test_surface_views import AHEAD, CENTER, RADIUS_MM, SIDES, X, ball, cameras, truth_of

VIEWS = 12


@pytest.fixture(scope="module")
def truth() -> SurfaceTruth:
    return truth_of(ball(), AHEAD, cameras((CENTER, X)))


@pytest.fixture(scope="module")
def moves(truth: SurfaceTruth) -> Moves:
    """All of the ball is free, up to 2 mm from the wall."""
    size, voxel_mm = 24, 2.0
    index = np.stack(np.meshgrid(*[np.arange(size) + 0.5] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(index * voxel_mm - size * voxel_mm / 2, axis=-1)
    occupancy = np.where(distance < RADIUS_MM - 2, FREE, OCCUPIED).astype(np.uint8)
    clearance = np.maximum(RADIUS_MM - 2 - distance, 0).astype(np.float32)
    space = FreeSpace(occupancy, np.full(3, -size * voxel_mm / 2), np.eye(3), voxel_mm, clearance)
    config = ExploreConfig(trajectories=2, length=7, rotation_deg=20.0, orbit_deg=20.0)
    return Moves(space, truth.unit_mm, config)


def views_of(clips: list[Clip]) -> Cameras:
    poses = np.concatenate([clip.views for clip in clips])
    return Cameras(np.tile(AHEAD.K, (len(poses), 1, 1)), poses, AHEAD.width, AHEAD.height)


def test_the_worth_of_views_is_what_the_truth_measures(truth: SurfaceTruth) -> None:
    lacking = LackingSurface.of(truth, AHEAD, seed=0)
    gain = 0.0
    aside = [np.array([0.0, 0.0, 0.0]), np.array([4.0, 0.0, 3.0])]
    views = cameras(*[(place, side) for place in aside for side in (X, -X)])
    for pose in views.world_from_camera:
        sight = lacking.look(pose)
        gain += lacking.gain(sight)
        lacking = lacking.after(sight)
        assert lacking.gain(sight) == 0.0
    found = truth.measure(views)
    never, badly = truth.never_seen.sum(), truth.badly_seen.sum()
    # All samples lack something here, so they are the items.
    assert len(lacking.points) == len(truth.points) == never + badly
    first = lacking.seen.good_from.any(axis=1) & ~truth.training.good_from.any(axis=1)
    well = found.never_seen_well[-1] * never + found.badly_seen[-1] * badly
    assert well > 0
    assert gain == pytest.approx(found.never_seen[-1] * never + 0.5 * first.sum() + 0.5 * well)


def test_it_shows_more_than_chance(truth: SurfaceTruth, moves: Moves) -> None:
    chosen = clairvoyant_clips(truth, moves, AHEAD, VIEWS, seed=0, beam=2)
    walked = random_walk(moves, AHEAD, VIEWS, seed=0)
    known, chance = (truth.measure(views_of(clips)) for clips in (chosen, walked))
    assert len(known) == len(chance) == VIEWS
    assert known.never_seen[-1] > chance.never_seen[-1] + 0.1
    for clip in chosen:
        assert (moves.space.lookup(clip.poses[:, :3, 3]) == FREE).all()


def test_free_poses_need_about_as_many_views_as_there_are_faces(truth: SurfaceTruth, moves: Moves) -> None:
    clips = free_viewpoint_poses(truth, moves, AHEAD, VIEWS, seed=0, pool=200)
    assert [len(clip.views) for clip in clips] == [1] * len(clips)
    found = truth.measure(views_of(clips))
    assert found.after(8)["never_seen"] > 0.9
    # Each choice is the best of the pool, so it is worth no more than the one before.
    again = free_viewpoint_poses(truth, moves, AHEAD, 3, seed=0, pool=200)
    assert all(np.array_equal(a.poses, b.poses) for a, b in zip(again, clips[:3], strict=True))
    assert found.never_seen[3] >= truth.measure(SIDES[:3]).never_seen[-1] - 0.1
