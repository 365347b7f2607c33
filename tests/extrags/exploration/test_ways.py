"""Ways to compare the search with: clips that keep to free space, and greedy choices that are the best."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import pytest

from extrags.cameras import Cameras, rotation_angle_deg
from extrags.config import ExploreConfig
from extrags.exploration.ways import (
    PERTURBED_SHIFT_STEPS,
    PERTURBED_TURN_DEG,
    Clip,
    Moves,
    frontier_clips,
    greedy_clips,
    perturbed_views,
    random_walk,
)
from extrags.freespace import FREE, OCCUPIED, UNKNOWN, FreeSpace

UNIT_MM = 10.0
SIZE = 32
VOXEL_MM = 2.0
CONFIG = ExploreConfig(trajectories=3, length=4, step_share=0.4, safety_share=0.2)


def corridor() -> FreeSpace:
    """Free along z, 20 mm wide; walls round it, and unknown space at the far end."""
    from scipy.ndimage import distance_transform_edt

    occupancy = np.full((SIZE, SIZE, SIZE), OCCUPIED, dtype=np.uint8)
    occupancy[11:21, 11:21, 2:24] = FREE
    occupancy[11:21, 11:21, 24:] = UNKNOWN
    clearance = distance_transform_edt(occupancy != OCCUPIED) * VOXEL_MM
    return FreeSpace(
        occupancy, np.full(3, -SIZE * VOXEL_MM / 2), np.eye(3), VOXEL_MM, clearance.astype(np.float32)
    )


def training() -> Cameras:
    """Three views along the corridor that look down it."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [-20.0, -12.0, -4.0]
    K = np.array([[30.0, 0, 20], [0, 30.0, 16], [0, 0, 1]])
    return Cameras(np.tile(K, (3, 1, 1)), poses, 40, 32)


MOVES = Moves(corridor(), UNIT_MM, CONFIG)


def check_feasible(clips: list[Clip]) -> None:
    space = MOVES.space
    for clip in clips:
        assert np.array_equal(clip.poses[0], training().world_from_camera[clip.anchor])
        centers = clip.poses[:, :3, 3]
        assert (space.lookup(centers) == FREE).all()
        assert space.segment_is_free(centers[:-1], centers[1:]).all()
        assert (space.clearance_at(centers) >= MOVES.margin_mm - 1e-9).all()
        rotation = clip.poses[:, :3, :3]
        assert np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max() < 1e-6


class TestRandomWalk:
    def test_each_step_is_a_move_of_the_search(self) -> None:
        clips = random_walk(MOVES, training(), 20, seed=1)
        assert [len(clip.views) for clip in clips] == [3, 3, 3, 3, 3, 3, 2]
        check_feasible(clips)
        assert {clip.anchor for clip in clips} == {0, 1, 2}
        for clip in clips:
            for before, after in pairwise(clip.poses):
                assert np.abs(MOVES.possible(before) - after).max(axis=(1, 2)).min() < 1e-12

    def test_the_seed_decides(self) -> None:
        first, again, other = (random_walk(MOVES, training(), 9, seed) for seed in (1, 1, 2))
        assert all(np.array_equal(a.poses, b.poses) for a, b in zip(first, again, strict=True))
        assert not all(np.array_equal(a.poses, b.poses) for a, b in zip(first, other, strict=True))

    def test_a_start_that_cannot_be_left_ends_nothing(self) -> None:
        poses = training().world_from_camera.copy()
        poses[2, 2, 3] = 25.0  # in unknown space
        cameras = Cameras(training().K, poses, training().width, training().height)
        assert len(MOVES.possible(poses[2])) == 0
        clips = random_walk(MOVES, cameras, 30, seed=1)
        assert sum(len(clip.views) for clip in clips) == 30
        assert [clip.anchor for clip in clips] == [1, 0] * 5

    def test_where_nothing_can_move_there_is_no_clip(self) -> None:
        stuck = replace(MOVES.space, occupancy=np.full((SIZE,) * 3, UNKNOWN, dtype=np.uint8))
        assert random_walk(replace(MOVES, space=stuck), training(), 9, 0) == []


@pytest.mark.parametrize(("share", "possible"), [(5e-6, True), (1e-3, False)])
def test_a_camera_nearer_than_the_margin_keeps_its_distance_but_for_rounding(
    share: float, possible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = training()[0].world_from_camera[0]

    def clearance_at(space: FreeSpace, points: np.ndarray) -> np.ndarray:
        there = np.all(points == start[:3, 3], axis=1)
        return np.where(there, 0.01, 0.01 * (1 - share))

    monkeypatch.setattr(FreeSpace, "clearance_at", clearance_at)
    moved = start.copy()
    moved[2, 3] += 0.1
    assert MOVES.allowed(start, moved[None]).tolist() == [possible]


def test_perturbed_views_stay_near_their_training_view() -> None:
    clips = perturbed_views(MOVES, training(), 30, seed=0)
    assert [clip.anchor for clip in clips[:3]] == MOVES.starts(training())
    assert [len(clip.views) for clip in clips] == [1] * 30
    check_feasible(clips)
    poses = np.stack([clip.poses for clip in clips])
    shift = np.linalg.norm(poses[:, 1, :3, 3] - poses[:, 0, :3, 3], axis=1)
    turn = rotation_angle_deg(poses[:, 0, :3, :3], poses[:, 1, :3, :3])
    assert 0.3 * PERTURBED_SHIFT_STEPS * MOVES.step_mm < shift.max() <= PERTURBED_SHIFT_STEPS * MOVES.step_mm
    assert 0.5 * PERTURBED_TURN_DEG < turn.max() <= PERTURBED_TURN_DEG + 1e-6


def test_the_frontier_way_looks_where_sight_ended() -> None:
    clips = frontier_clips(MOVES, training(), 12, seed=0)
    check_feasible(clips)
    assert clips
    # Only the far end borders on unknown space, and all of it lies ahead.
    assert (np.concatenate([clip.views for clip in clips])[:, 2, 2] > 0).all()
    closed = corridor()
    closed.occupancy[closed.occupancy == UNKNOWN] = OCCUPIED
    assert frontier_clips(replace(MOVES, space=closed), training(), 12, seed=0) == []


@dataclass(frozen=True)
class Places:
    """A view sees the cell of 3 mm it stands in; each counts once."""

    taken: frozenset[tuple[int, ...]] = frozenset()

    def look(self, pose: np.ndarray) -> tuple[int, ...]:
        return tuple(int(x) for x in np.floor(pose[:3, 3] / 3))

    def gain(self, sight: tuple[int, ...]) -> float:
        # Worth more far down the corridor.
        return 0.0 if sight in self.taken else 2.0 + 0.1 * sight[2]

    def after(self, sight: tuple[int, ...]) -> Places:
        return Places(self.taken | {sight})

    def look_at_mm(self, pose: np.ndarray) -> float:
        return UNIT_MM


SHORT = replace(MOVES, config=CONFIG.model_copy(update={"length": 3}))
"""Two moves: a beam of 14 times 14 paths looks at all of them."""


class TestGreedy:
    def test_a_wide_beam_finds_the_best_clip(self) -> None:
        best = 0.0
        for start in training().world_from_camera:
            for first in SHORT.possible(start):
                for second in SHORT.possible(first):
                    worth = Places()
                    gain = worth.gain(worth.look(first))
                    worth = worth.after(worth.look(first))
                    best = max(best, gain + worth.gain(worth.look(second)))
        clips = greedy_clips(SHORT, training(), 2, Places(), beam=200)
        assert len(clips) == 1
        check_feasible(clips)
        assert _worth(clips) == pytest.approx([best])

    def test_each_clip_is_worth_at_most_the_one_before(self) -> None:
        clips = greedy_clips(SHORT, training(), 16, Places(), beam=200)
        gains = _worth(clips)
        assert len(clips) == 8
        assert gains[-1] < gains[0]
        assert all(later <= earlier + 1e-9 for earlier, later in pairwise(gains))

    def test_no_more_views_than_wanted_and_none_without_worth(self) -> None:
        assert sum(len(clip.views) for clip in greedy_clips(MOVES, training(), 7, Places(), beam=2)) == 7
        everywhere = frozenset(product(range(-12, 12), repeat=3))
        assert greedy_clips(MOVES, training(), 7, Places(everywhere), beam=2) == []

    def test_a_threshold_ends_it(self) -> None:
        clips = greedy_clips(MOVES, training(), 60, Places(), beam=2, min_gain=5.5)
        assert clips
        assert min(_worth(clips)) > 5.5
        assert sum(len(clip.views) for clip in clips) < 60


def _worth(clips: list[Clip]) -> list[float]:
    worth, gains = Places(), []
    for clip in clips:
        total = 0.0
        for pose in clip.views:
            total += worth.gain(worth.look(pose))
            worth = worth.after(worth.look(pose))
        gains.append(total)
    return gains
