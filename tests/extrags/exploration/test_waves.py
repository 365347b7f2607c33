from __future__ import annotations

import itertools
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from extrags.cameras import Cameras, pose_distances
from extrags.config import ExploreConfig
from extrags.errors import ConfigError
from extrags.exploration import Exploration, WaveState, explore, merge_wave, start_views
from extrags.exploration.coverage import (
    count_pairs,
    coverage_gain,
    rendered_pairs,
    training_coverage,
)
from extrags.exploration.search import Branch, grow_branch, prepare_search
from extrags.exploration.seen import PairValue, Seen
from extrags.exploration.waves import Least, search_starts

from .tube import SEEN, make_tube, small_config, small_freespace, small_tube


def made_branch(anchor: int, words: np.ndarray, length: int = 3, gaussians: int = 4) -> Branch:
    row = np.flatnonzero(words).astype(np.int32)
    return Branch(
        anchor,
        np.stack([np.eye(4)] * length),
        ("move_right",) * (length - 1),
        (1.0,) * (length - 1),
        Seen(row, words[row]),
        words[:gaussians],
        1,
        1,
        "made",
    )


def made_state(**changes: object) -> WaveState:
    nothing = np.zeros(6, np.uint32)
    state = WaveState(
        nothing[:4],
        nothing[:4],
        nothing,
        PairValue(4, 2.5),
        waiting=(0, 1, 2, 3),
        room=4,
        least=Least(2.0),
        wave=2,
    )
    return replace(state, **changes)


class TestStartViews:
    def test_are_spread_over_space(self):
        tube = make_tube(n_gaussians=200, n_views=40)
        chosen = start_views(tube.cameras, 5, 30.0)
        assert len(set(chosen.tolist())) == 5
        order = np.sort(chosen)
        # Evenly spaced on the path: both ends, and no gap much larger than the others.
        assert order[0] <= 1
        assert order[-1] >= 38
        assert np.diff(order).max() <= 2 * np.diff(order).min()

    def test_are_spread_in_space_not_in_time(self):
        # A recording that lingers: 30 frames in one place, 5 along the way.
        poses = np.stack([np.eye(4)] * 35)
        poses[30:, 2, 3] = [10, 20, 30, 40, 50]
        cameras = Cameras(np.stack([np.eye(3)] * 35), poses, 8, 8)
        chosen = start_views(cameras, 6, 10.0)
        assert sum(index < 30 for index in chosen) == 1

    def test_any_first_few_are_spread_too(self):
        cameras = make_tube(n_gaussians=200, n_views=40).cameras
        np.testing.assert_array_equal(start_views(cameras, 9, 30.0)[:4], start_views(cameras, 4, 30.0))

    def test_the_first_is_the_middle_wherever_the_world_begins(self):
        poses = np.stack([np.eye(4)] * 9)
        poses[:, 2, 3] = np.arange(9.0)
        for origin in (0.0, -4.0, 200.0):
            moved = poses.copy()
            moved[:, :3, 3] += origin
            chosen = start_views(Cameras(np.stack([np.eye(3)] * 9), moved, 8, 8), 3, 10.0)
            assert chosen[0] == 4
            assert sorted(chosen.tolist()) == [0, 4, 8]

    @pytest.mark.parametrize("n_views", [1, 2, 7])
    def test_fewer_views_than_starts(self, n_views):
        cameras = make_tube(n_gaussians=200, n_views=n_views).cameras
        assert sorted(start_views(cameras, 20, 30.0).tolist()) == list(range(n_views))

    def test_further_ones_close_gaps(self):
        cameras = make_tube(n_gaussians=200, n_views=40).cameras
        chosen = start_views(cameras, 2, 30.0, spacing=0.3)
        np.testing.assert_array_equal(chosen[:2], start_views(cameras, 2, 30.0))

        def farthest(starts: np.ndarray) -> float:
            distances = [pose_distances(cameras, cameras[int(one)], 30.0)[:, 0] for one in starts]
            return float(np.min(distances, axis=0).max())

        assert farthest(chosen) <= 0.3 < farthest(chosen[:-1])

    def test_no_start_is_refused(self):
        with pytest.raises(ConfigError, match="at least one start"):
            start_views(small_tube().cameras, 0, 30.0)


class TestSearchStarts:
    def test_fewer_trajectories_leave_the_starts(self):
        cameras = make_tube(n_gaussians=200, n_views=40).cameras
        many = search_starts(cameras, ExploreConfig(trajectories=12), 30.0)
        assert search_starts(cameras, ExploreConfig(trajectories=2), 30.0) == many
        assert len(search_starts(cameras, ExploreConfig(trajectories=15), 30.0)) == 15

    def test_a_longer_recording_has_more(self):
        cameras = make_tube(n_gaussians=200, n_views=40).cameras
        config = ExploreConfig(trajectories=3, starts=3, start_spacing=1.0)
        assert len(search_starts(cameras, config, 30.0)) < len(search_starts(cameras, config, 10.0))

    def test_pairs_have_as_many_as_trajectories(self):
        cameras = make_tube(n_gaussians=200, n_views=40).cameras
        assert len(search_starts(cameras, ExploreConfig(trajectories=2, score="pairs"), 30.0)) == 2


class TestLeast:
    def test_exactly_enough_is_enough_and_nothing_never_is(self):
        # A start and two virtual views.
        branch = made_branch(0, np.array([7, 0, 0, 0], np.uint32), length=3)
        for least in (Least(3.0), Least(per_view=1.5), Least(2.0, per_view=1.5), Least(3.0, per_view=1.0)):
            assert least.of(branch) == 3.0
            assert least.accepts(branch, 3.0)
            assert not least.accepts(branch, np.nextafter(3.0, 0))
        assert Least().accepts(branch, np.nextafter(0.0, 1))
        assert not Least().accepts(branch, 0.0)


class TestMergeWave:
    @settings(max_examples=40, deadline=None)
    @given(
        seed=st.integers(0, 10_000),
        room=st.integers(0, 6),
        min_gain=st.integers(1, 120),
        frontier_pair=st.sampled_from([0.0, 0.5, 1.0, 7.5]),
    )
    def test_accepts_greedily_by_marginal_value(self, seed, room, min_gain, frontier_pair):
        # Five Gaussians and three frontier voxels.
        def value(covered, pairs):
            new = pairs & ~covered
            return count_pairs(new[:5]) + frontier_pair * count_pairs(new[5:])

        rng = np.random.default_rng(seed)
        words = rng.integers(0, 2**32, (6, 8), dtype=np.uint32)
        words &= rng.integers(0, 2**32, (6, 8), dtype=np.uint32)
        covered = words[0] & words[1]
        merge = merge_wave(
            covered,
            covered[:5],
            [made_branch(i, w, gaussians=5) for i, w in enumerate(words)],
            PairValue(5, frontier_pair),
            least=Least(float(min_gain)),
            room=room,
        )
        assert len(merge.accepted) <= room
        assert list(merge.values) == sorted(merge.values, reverse=True)
        check = covered.copy()
        for index, gain, worth in zip(merge.accepted, merge.gains, merge.values, strict=True):
            left = [value(check, words[i]) for i in range(6)]
            assert value(check, words[index]) == worth == max(left) >= min_gain
            assert coverage_gain(check[:5], words[index][:5]) == gain
            check |= words[index]
        np.testing.assert_array_equal(check, merge.known)
        np.testing.assert_array_equal(check[:5], merge.pairs)
        if len(merge.accepted) < room:
            rest = [i for i in range(6) if i not in merge.accepted]
            assert all(value(check, words[i]) < min_gain for i in rest)

    def test_greedy_keeps_its_bound(self):
        rng = np.random.default_rng(5)
        words = rng.integers(0, 2**32, (7, 4), dtype=np.uint32) & rng.integers(
            0, 2**32, (7, 4), dtype=np.uint32
        )
        nothing = np.zeros(4, np.uint32)
        merge = merge_wave(
            nothing,
            nothing,
            [made_branch(i, w) for i, w in enumerate(words)],
            PairValue(4),
            least=Least(1.0),
            room=3,
        )
        best = max(
            int(count_pairs(words[a] | words[b] | words[c]))
            for a, b, c in itertools.combinations(range(7), 3)
        )
        assert count_pairs(merge.known) >= (1 - 1 / np.e) * best

    def test_a_branch_that_never_left_its_start_is_not_accepted(self):
        merge = merge_wave(
            np.zeros(2, np.uint32),
            np.zeros(2, np.uint32),
            [made_branch(0, np.full(2, 255, np.uint32), length=1)],
            PairValue(2),
            least=Least(1.0),
            room=3,
        )
        assert merge.accepted == ()

    def test_a_branch_that_the_others_left_too_little_waits_for_another_turn(self):
        first, second = np.array([15, 0, 0, 0], np.uint32), np.array([12, 1, 0, 0], np.uint32)
        nothing = np.zeros(4, np.uint32)
        branches = [made_branch(0, first), made_branch(1, second)]

        def accepted(kept_share: float) -> tuple[int, ...]:
            least = Least(1.0, kept_share=kept_share)
            return merge_wave(nothing, nothing, branches, PairValue(4), least=least, room=3).accepted

        assert accepted(0.3) == (0, 1)
        assert accepted(0.5) == (0,)
        state = made_state(least=Least(1.0, kept_share=0.5)).merged(branches)
        assert state.waiting == (2, 3, 0, 1)
        assert "grows again" in state.rejected[0]


class TestWaveState:
    def test_anchors_of_a_wave_are_different(self):
        state = made_state(waiting=(0, 1), wave=5)
        assert state.next_wave() == (0, 1)

    def test_an_anchor_with_nothing_left_retires(self):
        full = np.array([7, 0, 0, 0, 0, 0], np.uint32)
        state = made_state().merged([made_branch(0, full), made_branch(1, np.zeros(6, np.uint32))])
        assert state.waiting == (2, 3, 0)
        assert state.gains == (3,)
        assert state.room == 3
        assert "from view 1: adds 0 pairs (0 pairs alone), needs 2 pairs" in state.rejected[0]

    def test_an_anchor_that_lost_to_its_neighbour_may_try_again(self):
        full = np.array([7, 0, 0, 0, 0, 0], np.uint32)
        state = made_state().merged([made_branch(0, full), made_branch(1, full)])
        assert state.waiting == (2, 3, 0, 1)
        assert "adds 0 pairs (3 pairs alone)" in state.rejected[0]

    def test_a_trajectory_into_a_hole_is_accepted(self):
        # Rows 4 and 5 are frontier voxels: this branch covers no Gaussian anew.
        into = np.array([0, 0, 0, 0, 3, 1], np.uint32)
        state = made_state().merged([made_branch(0, into), made_branch(1, into)])
        assert state.gains == (0,)
        assert state.values == (7.5,)
        assert "from view 1: adds 0 pairs (8 pairs alone)" in state.rejected[0]

    def test_ends_when_there_is_no_room(self):
        full = np.array([7, 0, 0, 0, 0, 0], np.uint32)
        state = made_state(room=1, waves=1).merged([made_branch(0, full), made_branch(1, full << 3)])
        assert state.next_wave() == ()
        assert "there was no room left" in state.rejected[0]

    def test_all_starts_grow_first_where_there_is_not_room_for_each(self):
        assert made_state(room=3).next_wave() == (0, 1, 2, 3)
        assert made_state(room=3, waves=1).next_wave() == (0, 1)
        assert made_state(room=4).next_wave() == (0, 1)
        # One by one means one by one.
        assert made_state(room=3, wave=1).next_wave() == (0,)

    def test_branches_of_other_anchors_are_refused(self):
        with pytest.raises(ConfigError, match="the wave has the anchors"):
            made_state().merged([made_branch(3, np.zeros(6, np.uint32))])

    def test_round_trip_on_disk(self, tmp_path):
        full = np.array([7, 0, 0, 0, 0, 0], np.uint32)
        state = made_state().merged([made_branch(0, full), made_branch(1, full)])
        state.save(tmp_path / "state")
        loaded = WaveState.load(tmp_path / "state")
        np.testing.assert_array_equal(loaded.known, state.known)
        np.testing.assert_array_equal(loaded.pairs, state.pairs)
        np.testing.assert_array_equal(loaded.branches[0].pairs, state.branches[0].pairs)
        for name in ("value", "waiting", "room", "least", "wave", "gains", "values", "rejected", "waves"):
            assert getattr(loaded, name) == getattr(state, name)


@cache
def explored(**changes: object) -> Exploration:
    tube = small_tube()
    return explore(tube.scene, tube.sequence, small_config(**changes), freespace=small_freespace())


class TestOneAtATime:
    def test_each_trajectory_sees_the_coverage_of_all_before_it(self):
        # The paper's shared map: updated by finished trajectories, before the next one starts.
        tube = small_tube()
        config = small_config(wave=1, hole_weight=0.0, trajectories=3, min_gain_share=0.0)
        context = prepare_search(tube.scene, tube.cameras, small_freespace(), config)
        coverage = training_coverage(tube.scene, tube.cameras.resized(32, 24), **SEEN)
        poses = []
        for anchor in start_views(tube.cameras, 3, context.depth_unit_mm):
            found = grow_branch(context, tube.cameras.world_from_camera[anchor], coverage)
            coverage = coverage | found.pairs
            poses.append(found.poses)
        found = explored(wave=1, hole_weight=0.0, trajectories=3, min_gain_share=0.0)
        np.testing.assert_array_equal(found.cameras.world_from_camera, np.concatenate(poses))
        np.testing.assert_array_equal(found.coverage_after, coverage)


class TestExplore:
    def test_adds_coverage_and_counts_it_right(self):
        found = explored()
        assert 1 <= len(found) <= 4
        assert found.gain_share > 0.01
        assert found.gain_share == pytest.approx(found.coverage_share_after - found.coverage_share_before)
        assert found.gains.sum() == round(found.gain_share * found.n_pairs)
        assert (found.values >= found.gains).all()
        assert found.cameras.width == small_tube().sequence.width
        assert found.n_virtual == sum(len(views) - 1 for views in found.trajectories)
        for views, anchor in zip(found.trajectories, found.anchors, strict=True):
            np.testing.assert_array_equal(
                views.world_from_camera[0], small_tube().sequence.cameras.world_from_camera[anchor]
            )

    def test_is_the_same_for_one_and_three_workers(self, tmp_path):
        tube = small_tube()
        alone = explored()
        with ThreadPoolExecutor(3) as pool:
            together = explore(
                tube.scene, tube.sequence, small_config(), freespace=small_freespace(), map=pool.map
            )
        alone.save(tmp_path / "alone")
        together.save(tmp_path / "together")
        files = sorted(
            p.relative_to(tmp_path / "alone") for p in (tmp_path / "alone").rglob("*") if p.is_file()
        )
        assert len(files) == 2
        for file in files:
            assert (tmp_path / "alone" / file).read_bytes() == (tmp_path / "together" / file).read_bytes(), (
                file
            )

    def test_beats_staying_near_the_recording(self):
        # What the wave search finds is worth more than as many views beside the recording.
        tube = small_tube()
        found = explored(trajectories=3)
        before = training_coverage(tube.scene, tube.cameras.resized(32, 24), **SEEN)
        rng = np.random.default_rng(0)
        beside = []
        for _ in range(found.n_virtual):
            pose = tube.cameras.world_from_camera[rng.integers(len(tube.cameras))].copy()
            pose[:3, 3] += pose[:3, :3] @ rng.uniform(-5, 5, 3)
            view = Cameras(tube.cameras.K[:1], pose[None], tube.cameras.width, tube.cameras.height)
            beside.append(rendered_pairs(tube.scene, view.resized(32, 24), **SEEN)[1][0])
        random_gain = coverage_gain(before, np.bitwise_or.reduce(beside))
        assert found.gains.sum() > 1.2 * random_gain

    @pytest.mark.parametrize("n_views", [1, 3])
    def test_few_training_views_work(self, n_views):
        tube = small_tube()
        sequence = replace(tube.sequence, split=replace(tube.sequence.split, train=np.arange(n_views) + 3))
        found = explore(tube.scene, sequence, small_config(trajectories=3), freespace=small_freespace())
        # A start may be used again once the coverage has changed.
        assert len(found) == 3
        assert set(found.anchors.tolist()) <= set(range(3, 3 + n_views))

    def test_stops_when_nothing_is_worth_it(self):
        found = explored(min_gain_share=0.9)
        assert len(found) == 0
        assert found.n_virtual == 0
        assert found.gain_share == 0
        assert len(found.rejected) == 4
        assert found.waves == 2

    def test_round_trip_on_disk(self, tmp_path):
        found = explored()
        found.save(tmp_path)
        loaded = Exploration.load(tmp_path)
        assert loaded.summary() == found.summary()
        assert json.loads((tmp_path / "exploration.json").read_text()) == found.summary()
        np.testing.assert_array_equal(loaded.cameras.world_from_camera, found.cameras.world_from_camera)
        np.testing.assert_array_equal(loaded.coverage_after, found.coverage_after)

    def test_nothing_found_round_trips_too(self, tmp_path):
        found = explored(min_gain_share=0.9)
        found.save(tmp_path)
        assert Exploration.load(tmp_path).summary() == found.summary()
