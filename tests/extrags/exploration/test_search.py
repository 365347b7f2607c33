from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from extrags.cameras import rotation_angle_deg
from extrags.errors import CaptureError, ShapeError
from extrags.events import Event, Progress, subscribed
from extrags.exploration import search
from extrags.exploration.coverage import coverage_gain, rendered_pairs, training_coverage
from extrags.exploration.darkness import luminance
from extrags.exploration.primitives import PRIMITIVES, apply_primitives, primitive_motions
from extrags.exploration.score import fold_weight, net_turn_deg
from extrags.exploration.search import Branch, SearchContext, grow_branch, prepare_search
from extrags.exploration.seen import PairValue, union
from extrags.exploration.waves import Least, WaveState
from extrags.freespace import FREE, OCCUPIED, FreeSpace
from extrags.scene import Scene

from .tube import SEEN, scene_of_points, small_config, small_freespace, small_tube, square_camera

START = 5


def context_in(freespace: FreeSpace, **changes: object) -> SearchContext:
    tube = small_tube()
    return prepare_search(tube.scene, tube.cameras, freespace, small_config(**changes))


def context(**changes: object) -> SearchContext:
    return context_in(small_freespace(), **changes)


@cache
def known() -> np.ndarray:
    return context().measured.known


def branch_of(ready: SearchContext) -> Branch:
    return grow_branch(ready, small_tube().cameras.world_from_camera[START], ready.measured.known, START)


@cache
def branch(**changes: object) -> Branch:
    return branch_of(context(**changes))


def disc_context(**changes: object) -> tuple[SearchContext, np.ndarray]:
    """A disc that hardly fills the view, seen from a place too small to leave; and the four turns there.

    One turn to any side is allowed, a second one sees too little. So each of the four turns is a dead end.
    """
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-9, 9, 25), np.linspace(-9, 9, 25)))
    points = np.stack([x, y, np.full_like(x, 10.0)], axis=1)[np.hypot(x, y) <= 9]
    scene = scene_of_points(points)
    turns = apply_primitives(np.eye(4), primitive_motions(1.2, 15.0, 15.0, 10.0))[6:10]
    seen = [
        float((scene.render(square_camera(pose)).alpha >= 0.5).float().mean())
        for pose in (*turns, *(turns[i] @ turns[j] for i in range(4) for j in range(4) if i != j ^ 1))
    ]
    assert min(seen[:4]) > max(seen[4:])
    settings = {
        "length": 9,
        "max_expansions": 99,
        "step_share": 0.12,
        "safety_share": 0.01,
        "rotation_deg": 15.0,
        "orbit_deg": 15.0,
        "hole_weight": 0.0,
        "max_hole_share": 1 - (min(seen[:4]) + max(seen[4:])) / 2,
    }
    return prepare_search(scene, square_camera(), small_room(), small_config(**settings | changes)), turns


def small_room() -> FreeSpace:
    """A millimetre of free space to each side of the origin."""
    occupancy = np.full((8, 8, 8), OCCUPIED, np.uint8)
    occupancy[3:5, 3:5, 3:5] = FREE
    return FreeSpace(occupancy, np.full(3, -4.0), np.eye(3), 1.0, np.ones((8, 8, 8), np.float32))


class TestGrowBranch:
    def test_reaches_its_length_and_gains(self):
        found = branch()
        assert len(found) == 5
        assert found.reason == "reached 4 virtual views"
        assert found.anchor == START
        assert len(found.moves) == len(found.values) == 4
        np.testing.assert_array_equal(found.poses[0], small_tube().cameras.world_from_camera[START])

    def test_its_values_are_what_its_views_add(self):
        found, ready = branch(hole_weight=0.0), context(hole_weight=0.0)
        assert ready.value == PairValue(len(ready.scene.gaussians), 0.0)
        covered = ready.measured.known.copy()
        np.testing.assert_array_equal(
            covered, training_coverage(ready.scene, small_tube().cameras.resized(32, 24), **SEEN)
        )
        for pose, value in zip(found.poses[1:], found.values, strict=True):
            _, pairs = rendered_pairs(ready.scene, ready.scoring_cameras(pose[None]), **SEEN)
            assert coverage_gain(covered, pairs[0]) == value
            covered |= pairs[0]
        assert coverage_gain(ready.measured.known, found.pairs) == sum(found.values) > 0

    def test_holes_count_besides(self):
        found, ready = branch(), context()
        gaussians = coverage_gain(ready.measured.pairs, found.pairs)
        assert ready.value.gain(known(), found.seen) == pytest.approx(sum(found.values))
        assert sum(found.values) >= gaussians > 0

    def test_the_first_move_is_the_best_of_all(self):
        # With neither light nor folds the score is the value alone.
        plain = branch(darkness_weight=0.0, fold_penalty=1.0)
        assert plain.values[0] >= branch().values[0]
        paper = branch(darkness_weight=0.0, fold_penalty=1.0, hole_weight=0.0)
        gained = coverage_gain(context().measured.pairs, plain.pairs)
        assert 0 < gained <= sum(plain.values)
        assert sum(paper.values) > 0

    def test_stays_in_free_space_with_its_margin(self):
        space, ready = small_freespace(), context()
        for start in (0, 2, 5, 7):
            found = grow_branch(ready, small_tube().cameras.world_from_camera[start], known(), start)
            centers = found.poses[:, :3, 3]
            assert (space.lookup(centers) == FREE).all()
            assert space.segment_is_free(centers[:-1], centers[1:]).all()
            needed = min(ready.margin_mm, float(space.clearance_at(centers[0])))
            assert (space.clearance_at(centers[1:]) >= needed).all()
            assert (small_tube().distance_from_wall(centers) > 0).all()

    def test_keeps_the_light_from_whiting_out_the_image(self):
        def brightest(limit: float) -> tuple[float, float]:
            ready = context(max_saturated_share=limit, length=8, max_expansions=20)
            start = small_tube().cameras.world_from_camera[START]
            found = grow_branch(ready, start, known(), START)
            rgb = ready.scene.render(ready.scoring_cameras(found.poses), sh_degree=0).rgb.numpy()
            share = (luminance(rgb) >= 1.0).mean(axis=(1, 2))
            return float(share[0]), float(share[1:].max())

        assert brightest(1.0)[1] > 0.1
        start, reached = brightest(0.05)
        assert reached <= max(0.05, start)

    def test_every_pose_is_a_rigid_motion_seen_only_once(self):
        poses = branch(length=8, max_expansions=30).poses
        rotation = poses[:, :3, :3]
        np.testing.assert_allclose(
            rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(rotation), 1)
        for i in range(len(poses)):
            for j in range(i):
                apart = np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3])
                turned = rotation_angle_deg(rotation[i], rotation[j])
                assert apart > 0.25 * context().step_mm or turned > 2.4

    def test_is_a_pure_function(self):
        first, second = branch(), branch_of(context())
        np.testing.assert_array_equal(first.poses, second.poses)
        np.testing.assert_array_equal(first.pairs, second.pairs)
        assert (first.moves, first.values, first.renders) == (second.moves, second.values, second.renders)

    def test_survives_pickling_of_its_inputs(self):
        found = branch_of(pickle.loads(pickle.dumps(context())))
        np.testing.assert_array_equal(found.poses, branch().poses)

    def test_a_dead_end_resumes_from_the_queue(self):
        ready, turns = disc_context()
        start = ready.measured.known
        np.testing.assert_array_equal(
            start, rendered_pairs(ready.scene, ready.scoring_cameras(np.eye(4)[None]), **SEEN)[1][0]
        )
        found = grow_branch(ready, np.eye(4), start)
        assert found.reason == "no further move is possible after 1 virtual view"
        assert found.expansions == 5
        assert found.moves[0].startswith("turn")
        # The best of the four dead ends is kept.
        alone = [rendered_pairs(ready.scene, ready.scoring_cameras(pose[None]), **SEEN)[1] for pose in turns]
        assert found.values[0] == max(int(coverage_gain(start, pairs[0])) for pairs in alone)

    @pytest.mark.parametrize("sign", [1, -1])
    def test_the_queue_gives_its_best_and_the_most_valuable_path_is_kept(self, sign, monkeypatch):
        # Each of the four turns is a dead end, so that they are all tried, the best score first.
        ready, _ = disc_context(hole_weight=1.0)
        rows = len(ready.scene.gaussians) + len(ready.frontier)
        # What is known of the holes already makes the turns worth different amounts.
        seen = np.random.default_rng(4).integers(0, 2**32, rows, dtype=np.uint32)
        monkeypatch.setattr(search, "score", lambda candidates, _: sign * candidates.value)
        events: list[Event] = []
        with subscribed(events.append):
            found = grow_branch(ready, np.eye(4), seen)
        tried = [event.values["value"] for event in events if isinstance(event, Progress)]
        worths = sorted({*tried})
        assert len(tried) == len(worths) == 4
        assert tried == worths[::-sign]
        assert sum(found.values) == pytest.approx(worths[-1])

    def test_a_spent_budget_keeps_the_best_path(self):
        found = branch(length=16, max_expansions=3)
        assert found.expansions == 3
        assert len(found) == 4
        assert found.reason == "budget of 3 expansions spent, 3 virtual views"

    def test_no_way_out_is_told(self):
        space = small_freespace()
        closed = replace(space, occupancy=np.full_like(space.occupancy, OCCUPIED))
        found = branch_of(context_in(closed))
        assert len(found) == 1
        assert found.reason == "no further move is possible after 0 virtual views"

    def test_round_trip_on_disk(self, tmp_path):
        found = branch()
        found.save(tmp_path / "branch")
        loaded = Branch.load(tmp_path / "branch")
        np.testing.assert_array_equal(loaded.poses, found.poses)
        np.testing.assert_array_equal(loaded.pairs, found.pairs)
        np.testing.assert_array_equal(loaded.seen.row, found.seen.row)
        np.testing.assert_array_equal(loaded.seen.value, found.seen.value)
        for name in ("anchor", "moves", "values", "expansions", "renders", "reason"):
            assert getattr(loaded, name) == getattr(found, name)

    def test_coverage_of_another_scene_is_refused(self):
        with pytest.raises(ShapeError, match="coverage of 3 rows"):
            grow_branch(context(), np.eye(4), np.zeros(3, np.uint32))


class TestHoles:
    def hole_alone(self) -> tuple[SearchContext, np.ndarray, np.ndarray]:
        """A start turned to the open end of the tube, with every direction of every Gaussian known."""
        ready, coverage = context(), known().copy()
        coverage[: len(ready.scene.gaussians)] = np.uint32(0xFFFFFFFF)
        return ready, small_tube().cameras.world_from_camera[3] @ np.diag([-1.0, 1, -1, 1]), coverage

    def test_draw_the_search_where_no_gaussian_is_left_to_cover(self):
        ready, start, coverage = self.hole_alone()
        found = grow_branch(ready, start, coverage, START)
        pairs = coverage[: len(ready.scene.gaussians)]
        assert sum(found.values) > 0
        state = WaveState(
            pairs, pairs, coverage, ready.value, waiting=(START,), room=1, least=Least(1.0), wave=1
        ).merged([found])
        assert len(state.branches) == 1
        assert state.gains == (0,)
        assert state.values == (ready.value.gain(coverage, found.seen),)
        assert state.values[0] == pytest.approx(sum(found.values))
        # Seen into once, a hole is worth nothing more from there.
        assert ready.value.gain(state.known, found.seen) == 0

    def test_what_the_real_start_shows_is_not_the_worth_of_virtual_views(self):
        """It is not restored: neither its holes nor what lies beyond its mask is filled by it."""
        ready, start, coverage = self.hole_alone()
        (shown,) = ready.observe(start[None])
        assert ready.value.gain(coverage, ready.seen(shown)) > 0
        found = grow_branch(ready, start, coverage, START)
        further = [ready.seen(view) for view in ready.observe(found.poses[1:])]
        together = ready.value.beyond(coverage, union(ready.value, further, coverage))
        np.testing.assert_array_equal(found.seen.row, together.row)
        np.testing.assert_array_equal(found.seen.value, together.value)
        known = coverage.copy()
        for view, value in zip(further, found.values, strict=True):
            assert ready.value.gain(known, view) == pytest.approx(value)
            ready.value.add(known, view)
        nowhere = replace(ready.freespace, occupancy=np.full_like(ready.freespace.occupancy, OCCUPIED))
        stays = grow_branch(replace(ready, freespace=nowhere), start, coverage, START)
        assert len(stays.seen.row) == stays.pairs.any() == 0

    def test_a_spent_budget_keeps_the_path_of_the_largest_value(self):
        ready, start, coverage = self.hole_alone()
        longer, shorter = (
            grow_branch(replace(ready, config=small_config(length=16, max_expansions=count)), start, coverage)
            for count in (6, 3)
        )
        assert sum(longer.values) >= sum(shorter.values) > 0

    def test_a_view_without_any_surface_is_rejected(self):
        # Turned by 90 degrees the camera sees nothing at all; the limit on holes alone would allow that.
        scene = scene_of_points(np.stack(np.meshgrid([-1.0, 0, 1], [-1.0, 0, 1], [10.0]), -1).reshape(-1, 3))
        ready = prepare_search(
            scene, square_camera(), small_room(), small_config(max_hole_share=1.0, rotation_deg=90.0)
        )
        found = grow_branch(ready, np.eye(4), ready.measured.known)
        images = scene.render(ready.scoring_cameras(found.poses)).alpha.numpy()
        assert (images >= 0.5).any(axis=(1, 2)).all()


class TestPrepareSearch:
    def test_lengths_follow_the_scene(self):
        tube = small_tube()
        ready = context()
        bigger = replace(
            tube.scene.gaussians,
            means=tube.scene.gaussians.means * 3,
            scales=tube.scene.gaussians.scales + float(np.log(3)),
        )
        poses = tube.cameras.world_from_camera.copy()
        poses[:, :3, 3] *= 3
        cameras = replace(tube.cameras, world_from_camera=poses)
        other = prepare_search(Scene(bigger), cameras, small_freespace(), small_config())
        assert other.depth_unit_mm == pytest.approx(3 * ready.depth_unit_mm, rel=1e-3)
        assert ready.step_mm == pytest.approx(0.2 * ready.depth_unit_mm)

    def test_views_that_see_nothing_are_refused(self):
        tube = small_tube()
        away = tube.cameras.world_from_camera.copy()
        away[:, :3, 3] += 1e4
        cameras = replace(tube.cameras, world_from_camera=away)
        with pytest.raises(CaptureError, match="none of the 8 training views sees a surface"):
            prepare_search(tube.scene, cameras, small_freespace(), small_config())


class TestTopCandidates:
    @pytest.mark.parametrize(("kept", "expansions"), [(1, 2), (3, 4), (14, 5)])
    def test_bounds_what_the_queue_holds(self, kept, expansions):
        # Four turns are possible at the start and each is a dead end: every one kept is expanded once.
        ready, _ = disc_context(top_candidates=kept)
        found = grow_branch(ready, np.eye(4), np.zeros(len(ready.scene.gaussians), np.uint32))
        assert found.expansions == expansions


class TestFoldWeight:
    def test_fires_above_the_angle(self):
        config = small_config()
        np.testing.assert_array_equal(fold_weight(np.array([0.0, 20.0, 25.0, 26.0]), config), [1, 1, 1, 0.6])
        np.testing.assert_array_equal(fold_weight(np.array([20.0, 26.0]), small_config(fold_penalty=1)), 1)

    @pytest.mark.parametrize(
        ("moves", "steps", "turned_deg"),
        [
            ("turn_right", 3, 20),
            ("turn_right turn_right", 3, 40),
            ("turn_right turn_left", 3, 0),
            ("turn_right move_forward turn_left", 3, 0),
            ("orbit_up move_left turn_up turn_up", 3, 40),
            ("turn_right turn_right turn_right", 1, 20),
            ("turn_right turn_right turn_right", 9, 60),
        ],
    )
    def test_counts_the_net_rotation(self, moves, steps, turned_deg):
        motions = primitive_motions(1.0, 20.0, 20.0, 10.0)
        path = [small_tube().cameras.world_from_camera[START]]
        for move in moves.split():
            path.append(apply_primitives(path[-1], motions)[PRIMITIVES.index(move)])
        found = net_turn_deg(np.stack(path[:-1]), path[-1][None], steps)
        assert found.tolist() == pytest.approx([turned_deg], abs=1e-5)

    def test_changes_what_the_search_does(self):
        tube, covered = small_tube(), known()

        def most_turned(**changes: object) -> float:
            ready = context(length=8, max_expansions=8, rotation_deg=20.0, orbit_deg=20.0, **changes)
            turned = []
            for start in (0, 5):
                poses = grow_branch(ready, tube.cameras.world_from_camera[start], covered, start).poses
                turned += [net_turn_deg(poses[:t], poses[[t]], 3)[0] for t in range(1, len(poses))]
            return float(np.mean(np.array(turned) > 25.0))

        free, held = most_turned(fold_penalty=1.0), most_turned(fold_penalty=0.05)
        assert free > 0
        assert held < free
