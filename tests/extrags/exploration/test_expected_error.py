from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from extrags.cameras import Cameras, rotation_about, rotation_angle_deg
from extrags.exploration import Exploration, explore
from extrags.exploration.approach import Approaches, straight_way
from extrags.exploration.expected_error import Sizes, measure_sizes, probe_cameras
from extrags.exploration.measurements import (
    Destinations,
    SceneMeasurements,
    _fit_to_be_views,
    frontier_of,
    measure_scene,
)
from extrags.exploration.observation import Observation
from extrags.exploration.search import Branch, SearchContext, grow_branch, prepare_search
from extrags.exploration.seen import ErrorValue, PairValue, Seen, Value, union
from extrags.freespace import FREE, OCCUPIED, FreeSpace, carve
from extrags.scene import Scene
from extrags.surface import fuse_surface

from .tube import Tube, make_ball, make_tube, small_config, small_freespace, small_tube, square_camera

ROWS = 12
START = 5


def error_config(**changes: object):
    settings = {"score": "error", "darkness_weight": 0.0, "fold_penalty": 1.0, "rotation_deg": 20.0}
    return small_config(**settings | {"orbit_deg": 20.0, "max_hole_share": 0.7} | changes)


@cache
def context(**changes: object) -> SearchContext:
    tube = small_tube()
    return prepare_search(tube.scene, tube.cameras, small_freespace(), error_config(**changes))


@cache
def explored(**changes: object) -> Exploration:
    tube = small_tube()
    return explore(tube.scene, tube.sequence, error_config(**changes), freespace=small_freespace())


def random_seen(rng: np.random.Generator, pairs: bool) -> Seen:
    row = np.flatnonzero(rng.random(ROWS) < 0.5).astype(np.int32)
    if pairs:
        return Seen(row, rng.integers(1, 2**32, len(row), dtype=np.uint32))
    return Seen(row, rng.uniform(0.05, 1, len(row)).astype(np.float32))


def random_value(rng: np.random.Generator, pairs: bool) -> tuple[Value, np.ndarray]:
    if pairs:
        return PairValue(8, 2.5), np.zeros(ROWS, np.uint32)
    return ErrorValue(rng.random(ROWS).astype(np.float32)), np.zeros(ROWS, np.float32)


class TestValue:
    @settings(max_examples=60, deadline=None)
    @given(seed=st.integers(0, 10_000), pairs=st.booleans())
    def test_is_monotone_and_has_diminishing_returns(self, seed, pairs):
        rng = np.random.default_rng(seed)
        value, known = random_value(rng, pairs)
        few, view = random_seen(rng, pairs), random_seen(rng, pairs)
        value.add(known, few)
        more = known.copy()
        value.add(more, random_seen(rng, pairs))
        gain, later = value.gain(known, view), value.gain(more, view)
        assert gain >= later >= 0
        value.add(known, view)
        assert value.gain(known, view) == 0

    @settings(max_examples=30, deadline=None)
    @given(seed=st.integers(0, 10_000), pairs=st.booleans())
    def test_what_is_beyond_the_known_is_all_that_counts(self, seed, pairs):
        rng = np.random.default_rng(seed)
        value, known = random_value(rng, pairs)
        value.add(known, random_seen(rng, pairs))
        view = random_seen(rng, pairs)
        beyond = value.beyond(known, view)
        assert value.gain(known, beyond) == pytest.approx(value.gain(known, view), rel=1e-6)
        one, other = known.copy(), known.copy()
        value.add(one, view)
        value.add(other, beyond)
        np.testing.assert_array_equal(one, other)
        assert len(beyond.row) == np.count_nonzero(one != known)

    def test_a_union_is_worth_what_its_parts_add_one_after_the_other(self):
        rng = np.random.default_rng(3)
        for pairs in (True, False):
            value, known = random_value(rng, pairs)
            parts = [random_seen(rng, pairs) for _ in range(4)]
            together = union(value, parts, known)
            total = 0.0
            along = known.copy()
            for part in parts:
                total += value.gain(along, part)
                value.add(along, part)
            assert value.gain(known, together) == pytest.approx(total, rel=1e-6)


class TestMeasureSizes:
    def test_follows_its_formula(self):
        config = error_config(hole_error=0.3, unresolved_error=0.1, sufficient_resolution=0.5)
        probes = [
            Sizes(np.array([0, 2], np.int32), np.array([4.0, 10.0], np.float32)),
            Sizes(np.array([0], np.int32), np.array([8.0], np.float32)),
        ]
        model = measure_sizes(probes, 2, 1, 100, config)
        np.testing.assert_allclose(model.value.error, [0.1 * 6 / 100, 0, 0.3 * 5 / 100], rtol=1e-6)
        np.testing.assert_allclose(model.size_px, [(16 + 64) / 12, 0, 10], rtol=1e-6)
        seen = model.seen(Sizes(np.array([0, 1, 2], np.int32), np.array([2.0, 5.0, 9.0], np.float32)))
        # Row 1 is in no probe: nothing is known of its worth.
        assert seen.row.tolist() == [0, 2]
        np.testing.assert_allclose(seen.value, [2 / (0.5 * 80 / 12), 1.0], rtol=1e-6)


class TestProbes:
    def test_stay_inside_and_differ_from_the_recording(self):
        tube, space, ready = small_tube(), small_freespace(), context()
        cameras = tube.cameras.at_most_width(32)
        probes = probe_cameras(cameras, space, ready.depth_unit_mm, ready.margin_mm, ready.config)
        assert len(probes) == 64
        centers = probes.centers
        assert (space.lookup(centers) == FREE).all()
        which = np.arange(64) * len(cameras) // 64
        needed = np.minimum(ready.margin_mm, space.clearance_at(cameras.centers[which]))
        assert (space.clearance_at(centers) >= needed - 1e-9).all()
        turned = rotation_angle_deg(
            probes.world_from_camera[:, :3, :3], cameras.world_from_camera[which, :3, :3]
        )
        assert turned.max() > 120
        assert np.linalg.norm(centers - cameras.centers[which], axis=1).max() > 0.5 * ready.depth_unit_mm

    def test_none_passes_through_a_wall(self):
        # Two rooms beside each other, and a camera in the left one.
        occupancy = np.full((16, 16, 16), FREE, np.uint8)
        occupancy[8] = OCCUPIED
        space = FreeSpace(occupancy, np.full(3, -8.0), np.eye(3), 1.0, np.ones((16, 16, 16), np.float32))
        pose = np.eye(4)
        pose[0, 3] = -2.5
        probes = probe_cameras(square_camera(pose), space, 6.0, 0.1, error_config(probe_shift=1.0))
        assert probes.centers[:, 0].max() < 0
        assert np.linalg.norm(probes.centers - pose[:3, 3], axis=1).max() > 3

    def in_the_open(self, rotation: np.ndarray, scale: float, **changes: object) -> tuple[Cameras, Cameras]:
        """Three training views far from every wall, and their probes; the world is turned and scaled."""
        free = np.full((12, 12, 12), FREE, np.uint8)
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, :3, :3] = rotation @ Rotation.random(3, random_state=np.random.default_rng(5)).as_matrix()
        poses[:, :3, 3] = scale * np.array([[1.0, 0, 0], [0, 2, -1], [-1, 1, 3]]) @ rotation.T + [7.0, -40, 3]
        origin = np.array([7.0, -40, 3]) - 60 * scale * rotation @ np.ones(3)
        clearance = np.full(free.shape, 50 * scale, np.float32)
        space = FreeSpace(free, origin, rotation.T.copy(), 10 * scale, clearance)
        K = np.tile(np.array([[20.0, 0, 16], [0, 20.0, 12], [0, 0, 1]]), (3, 1, 1))
        cameras = Cameras(K, poses, 32, 24)
        config = error_config(**{"probe_views": 90, "probe_shift": 0.5, "probe_turn_deg": 40.0} | changes)
        return cameras, probe_cameras(cameras, space, 12.0 * scale, 1.0 * scale, config)

    def test_shifts_and_turns_are_even_up_to_their_limits(self) -> None:
        cameras, probes = self.in_the_open(np.eye(3), 1.0)
        which = np.repeat(np.arange(3), 30)
        np.testing.assert_array_equal(probes.K, cameras.K[which])
        shift = np.linalg.norm(probes.centers - cameras.centers[which], axis=1) / (0.5 * 12)
        start = cameras.world_from_camera[which, :3, :3]
        turn = rotation_angle_deg(probes.world_from_camera[:, :3, :3], start) / 40
        for share in (shift, turn):
            assert share.max() <= 1 + 1e-12
            # Of 90 even draws between 0 and 1; the deviations of both bounds are five of the mean's.
            assert share.mean() == pytest.approx(0.5, abs=5 / np.sqrt(12 * 90))
            assert share.max() > 0.9
        # In the camera's own frame every direction is as likely as any other.
        side = np.einsum("nji,nj->ni", start, probes.centers - cameras.centers[which])
        assert np.abs((np.sign(side)).mean(axis=0)).max() < 5 / np.sqrt(90)

    def test_limits_scale_what_is_drawn(self) -> None:
        cameras, probes = self.in_the_open(np.eye(3), 1.0)
        _, twice = self.in_the_open(np.eye(3), 1.0, probe_shift=1.0, probe_turn_deg=80.0)
        which = np.repeat(np.arange(3), 30)
        moved = np.linalg.norm(probes.centers - cameras.centers[which], axis=1) > 0.24
        np.testing.assert_allclose(
            (twice.centers - cameras.centers[which])[moved],
            2 * (probes.centers - cameras.centers[which])[moved],
            atol=1e-12,
        )
        start = cameras.world_from_camera[which, :3, :3]
        np.testing.assert_allclose(
            rotation_angle_deg(twice.world_from_camera[:, :3, :3], start),
            2 * rotation_angle_deg(probes.world_from_camera[:, :3, :3], start),
            atol=1e-5,
        )

    def test_move_with_the_world(self) -> None:
        turn = rotation_about(np.array([1.0, -2, 0.5]), 1.1)
        _, probes = self.in_the_open(np.eye(3), 1.0)
        _, moved = self.in_the_open(turn, 3.0)
        origin = np.array([7.0, -40, 3])
        np.testing.assert_allclose(
            moved.centers - origin, 3 * (probes.centers - origin) @ turn.T, rtol=0, atol=1e-11
        )
        np.testing.assert_allclose(
            moved.world_from_camera[:, :3, :3], turn @ probes.world_from_camera[:, :3, :3], atol=1e-13
        )

    def test_are_shifted_by_a_fiftieth_of_the_depth_or_not_at_all(self) -> None:
        """Also where a wall is so near that the shift is halved again and again."""
        occupancy = np.full((16, 16, 16), FREE, np.uint8)
        occupancy[8:] = OCCUPIED
        space = FreeSpace(occupancy, np.full(3, -8.0), np.eye(3), 1.0, np.ones((16, 16, 16), np.float32))
        pose = np.eye(4)
        pose[0, 3] = -0.2
        config = error_config(probe_shift=1.0, probe_views=200)
        probes = probe_cameras(square_camera(pose), space, 6.0, 0.1, config)
        shift = np.linalg.norm(probes.centers - pose[:3, 3], axis=1)
        assert probes.centers[:, 0].max() < 0
        assert np.all((shift == 0) | (shift > 0.02 * 6 * (1 - 1e-12)))
        assert np.any(shift == 0)
        assert np.any((shift > 0) & (shift < 0.04 * 6))

    def test_another_seed_gives_others(self):
        first, second = context().measured, context(seed=1).measured
        assert not np.array_equal(first.destinations.poses, second.destinations.poses)


class TestMeasureScene:
    def test_what_was_resolved_is_known_and_holes_are_not(self):
        ready = context()
        n = len(ready.scene.gaussians)
        assert ready.measured.known[:n].max() == 1.0
        assert (ready.measured.known[n:] == 0).all()
        assert ready.measured.removable_error > 0

    def test_what_lies_outside_the_masks_was_not_seen(self):
        tube, space = small_tube(), small_freespace()
        cameras = tube.cameras
        mask = np.zeros((cameras.height, cameras.width), dtype=bool)
        mask[:, : cameras.width // 2] = True
        config = error_config(probe_views=24)
        frontier = frontier_of(tube.scene, space, config)
        whole, half = (
            measure_scene(tube.scene, cameras, space, config, frontier, masks)
            for masks in (None, [mask] * len(cameras))
        )
        n = len(tube.scene.gaussians)
        # Where Gaussians have their centres in none of the left halves, hardly any is known.
        pixels, _ = cameras.project(tube.scene.gaussians.means.numpy().astype(np.float64))
        with np.errstate(invalid="ignore"):
            in_image = cameras.contains(pixels)
            left = (in_image & (pixels[..., 0] < cameras.width / 2)).any(axis=0)
        away = in_image.any(axis=0) & ~left & (whole.known[:n] > 0.5)
        assert away.sum() > 50
        assert half.known[:n][away].mean() < 0.3 * whole.known[:n][away].mean()
        assert half.removable_error > 1.2 * whole.removable_error
        assert np.bitwise_count(half.pairs).sum() < 0.9 * np.bitwise_count(whole.pairs).sum()
        # A search by the frustum looks at no masks.
        frustum = config.model_copy(update={"visibility": "frustum"})
        plain, masked = (
            measure_scene(tube.scene, cameras, space, frustum, frontier, masks)
            for masks in (None, [mask] * len(cameras))
        )
        np.testing.assert_array_equal(plain.known, masked.known)

    def test_only_probes_that_could_be_virtual_views_are_destinations(self) -> None:
        occupancy = np.full((6, 6, 6), FREE, np.uint8)
        occupancy[3:] = OCCUPIED
        # Two millimetres of room, but for one layer of voxels.
        clearance = np.full(occupancy.shape, 2.0, np.float32)
        clearance[2] = 1.9
        space = FreeSpace(occupancy, np.zeros(3), np.eye(3), 1.0, clearance)
        nothing = Sizes(np.zeros(0, np.int32), np.zeros(0, np.float32))

        def probe(x: float, *, saturated: float = 0.0, rejected: bool = False) -> Observation:
            pose = np.eye(4)
            pose[:3, 3] = x, 2.5, 2.5
            return Observation(
                pose=pose,
                visible=np.zeros(0, np.int32),
                sizes=nothing,
                holes=np.zeros((2, 2), bool),
                depth_mm=np.ones(4, np.float32),
                look_at_mm=1.0,
                dark=np.zeros(3),
                saturated_share=saturated,
                rejected=rejected,
            )

        probes = [
            probe(1.5),
            probe(2.5),  # too near to the wall
            probe(4.5),  # behind it
            probe(0.5, rejected=True),
            probe(0.5, saturated=0.2),
            probe(0.5, saturated=0.21),  # too bright
        ]
        config = error_config(safety_share=0.2, max_saturated_share=0.2)
        assert _fit_to_be_views(probes, space, 10.0, config) == [0, 4]
        assert _fit_to_be_views(probes, space, 5.0, config) == [0, 1, 4]
        none = config.model_copy(update={"destinations": False})
        assert _fit_to_be_views(probes, space, 5.0, none) == []

    def test_removable_error_is_what_is_not_known_yet(self) -> None:
        measured = context().measured
        assert isinstance(measured.value, ErrorValue)
        known, error = measured.known.astype(np.float64), measured.value.error.astype(np.float64)
        assert measured.removable_error == pytest.approx(sum((1 - known) * error), rel=1e-6)
        assert context(score="pairs").measured.removable_error == 0

    def test_virtual_views_have_the_usual_intrinsics(self) -> None:
        """The median of the recording's, one by one: a frame that was zoomed into changes nothing."""
        measured = context().measured
        K = measured.training.K.copy()
        K[0, 0, 0] *= 3
        zoomed = replace(measured, training=replace(measured.training, K=K))
        poses = measured.training.world_from_camera[:2]
        found = zoomed.cameras(poses)
        np.testing.assert_array_equal(found.K, measured.training.K[[1, 1]])
        np.testing.assert_array_equal(found.world_from_camera, poses)
        assert (found.width, found.height) == (measured.training.width, measured.training.height)

    def test_round_trip_on_disk(self, tmp_path):
        for ready in (context(), context(score="pairs")):
            ready.measured.save(tmp_path / ready.config.score)
            loaded = SceneMeasurements.load(tmp_path / ready.config.score)
            again = prepare_search(
                ready.scene, ready.measured.training, ready.freespace, ready.config, loaded
            )
            start = loaded.training.world_from_camera[START]
            one, other = (grow_branch(c, start, c.measured.known, START) for c in (ready, again))
            np.testing.assert_array_equal(one.poses, other.poses)
            assert one.values == other.values

    def test_many_training_views_are_measured_in_part(self):
        tube = small_tube()
        poses = np.repeat(tube.cameras.world_from_camera, 5, axis=0)
        cameras = Cameras(
            np.repeat(tube.cameras.K, 5, axis=0), poses, tube.cameras.width, tube.cameras.height
        )
        config = error_config(max_training_views=10)
        frontier = frontier_of(tube.scene, small_freespace(), config)
        measured = measure_scene(tube.scene, cameras, small_freespace(), config, frontier)
        assert measured.renders == 10 + 64
        assert len(measured.training) == 40


class TestGrowBranch:
    def test_its_values_are_the_error_its_views_take_away(self):
        ready = context()
        found = grow_branch(ready, small_tube().cameras.world_from_camera[START], ready.measured.known, START)
        known = ready.measured.known.copy()
        start, *views = ready.observe(found.poses)
        ready.value.add(known, ready.seen(start))
        for observation, value in zip(views, found.values, strict=True):
            assert ready.value.gain(known, ready.seen(observation)) == pytest.approx(value, rel=1e-6)
            ready.value.add(known, ready.seen(observation))
        assert 0 < sum(found.values) <= ready.measured.removable_error

    def test_trajectories_are_continuous_and_stay_inside(self):
        space, ready = small_freespace(), context()
        for start in (0, 3, 5, 7):
            pose = small_tube().cameras.world_from_camera[start]
            found = grow_branch(ready, pose, ready.measured.known, start)
            rotation, centers = found.poses[:, :3, :3], found.poses[:, :3, 3]
            identity = np.broadcast_to(np.eye(3), rotation.shape)
            np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), identity, atol=1e-6)
            np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-6)
            assert (space.lookup(centers[1:]) == FREE).all()
            assert space.segment_is_free(centers[:-1], centers[1:]).all()
            needed = min(ready.margin_mm, float(space.clearance_at(centers[0])))
            assert (space.clearance_at(centers[1:]) >= needed - 1e-9).all()
            assert (rotation_angle_deg(rotation[1:], rotation[:-1]) <= 20 + 1e-4).all()
            steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
            orbit = 2 * np.sin(np.radians(20) / 2) * 2.0 * ready.depth_unit_mm
            assert (steps <= max(ready.step_mm, orbit) + 1e-9).all()

    def test_straight_ways_are_taken_where_they_pay(self):
        names = [move for moves in explored(trajectories=8).moves for move in moves]
        assert "approach" in names
        without = explored(trajectories=8, destinations=False)
        assert "approach" not in [move for moves in without.moves for move in moves]


class TestApproaches:
    def made(self, rng: np.random.Generator) -> tuple[Approaches, ErrorValue]:
        value = ErrorValue(rng.random(ROWS).astype(np.float32))
        poses = np.broadcast_to(np.eye(4), (30, 4, 4)).copy()
        poses[:, :3, 3] = rng.uniform(-4, 4, (30, 3))
        seen = [random_seen(rng, pairs=False) for _ in range(30)]
        nothing = np.zeros(ROWS, np.float32)
        return (
            Approaches(Destinations.of(poses, seen), value, nothing, step_mm=1.0, turn_deg=20.0),
            value,
        )

    @settings(max_examples=30, deadline=None)
    @given(seed=st.integers(0, 10_000))
    def test_lazily_finds_what_a_full_search_finds(self, seed):
        rng = np.random.default_rng(seed)
        approaches, value = self.made(rng)
        known = np.zeros(ROWS, np.float32)
        value.add(known, random_seen(rng, pairs=False))
        distance = np.linalg.norm(approaches.destinations.poses[:, :3, 3], axis=1)
        views = np.maximum(1, np.ceil(distance - 1e-6))
        rates = np.array([value.gain(known, approaches.destinations.seen(i)) for i in range(30)]) / views
        allowed = np.sort(rates[(views <= 4) & (rates > 0.2)])[::-1]
        found = [rate for rate, _ in approaches.better(np.eye(4), known, 4, 0.2)]
        np.testing.assert_allclose(found, allowed[: len(found)], rtol=1e-12)
        assert len(found) == min(12, len(allowed))

    def test_a_straight_way_turns_by_the_shortest_rotation(self) -> None:
        """From anywhere, in any direction: along the great circle between both orientations."""
        generator = np.random.default_rng(8)
        for _ in range(5):
            start, end = np.eye(4), np.eye(4)
            for pose in (start, end):
                pose[:3, :3] = Rotation.random(random_state=generator).as_matrix()
                pose[:3, 3] = generator.normal(size=3)
            both = Slerp([0, 1], Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]])))
            poses = straight_way(start, end, 3)
            share = np.array([1 / 3, 2 / 3, 1])
            np.testing.assert_allclose(poses[:, :3, :3], both(share).as_matrix(), atol=1e-13)
            centers = (1 - share[:, None]) * start[:3, 3] + share[:, None] * end[:3, 3]
            np.testing.assert_allclose(poses[:, :3, 3], centers, atol=1e-14)
            np.testing.assert_array_equal(poses[:, 3], [[0, 0, 0, 1]] * 3)

    @pytest.mark.parametrize(
        ("turn_deg", "distance", "views"),
        [(50, 0.1, 3), (40, 0.1, 2), (41, 0.1, 3), (0, 0.0, 1), (5, 5.0, 2), (30, 5.01, 3), (170, 3.0, 9)],
    )
    def test_a_way_has_as_many_views_as_its_steps_and_its_turns_need(
        self, turn_deg: float, distance: float, views: int
    ) -> None:
        start, end = np.eye(4), np.eye(4)
        start[:3, :3] = rotation_about(np.array([1.0, 2, -1]), 0.7)
        start[:3, 3] = [5.0, -3, 2]
        end[:3, :3] = start[:3, :3] @ rotation_about(np.array([0.0, 1, 3]), np.radians(turn_deg))
        end[:3, 3] = start[:3, 3] + distance * np.array([0.6, 0, 0.8])
        seen = Seen(np.arange(2, dtype=np.int32), np.array([0.5, 1], np.float32))
        value = ErrorValue(np.array([4.0, 6], np.float32))
        known = np.zeros(2, np.float32)
        approaches = Approaches(Destinations.of(end[None], [seen]), value, known, step_mm=2.5, turn_deg=20.0)
        ((rate, poses),) = approaches.better(start, known, views, 0.0)
        assert rate == pytest.approx(8 / views)
        np.testing.assert_allclose(poses, straight_way(start, end, views), atol=1e-12)
        # One view less than it takes is too few to get there.
        assert list(approaches.better(start, known, views - 1, 0.0)) == []

    def test_a_straight_way_arrives_in_equal_steps(self):
        start, end = np.eye(4), np.eye(4)
        end[:3, :3] = rotation_about(np.array([0.0, 1.0, 0.0]), 1.2)
        end[:3, 3] = [3.0, 0.0, 4.0]
        poses = straight_way(start, end, 4)
        np.testing.assert_allclose(poses[-1], end, atol=1e-12)
        turned = rotation_angle_deg(poses[:, :3, :3], np.concatenate([start[None], poses[:-1]])[:, :3, :3])
        np.testing.assert_allclose(turned, np.degrees(1.2) / 4, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), 1.25)


def moved_tube(tube: Tube, space: FreeSpace, scale: float, turn: np.ndarray) -> tuple[Tube, FreeSpace]:
    """The same world, scaled, turned and shifted."""
    import torch

    shift = np.array([30.0, -7.0, 12.0])
    g = tube.scene.gaussians
    means = scale * (g.means.numpy() @ turn.T) + shift
    spins = Rotation.from_matrix(turn) * Rotation.from_quat(g.quats.numpy()[:, [1, 2, 3, 0]])
    quats = spins.as_quat()[:, [3, 0, 1, 2]]
    gaussians = replace(
        g,
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy(quats.astype(np.float32)),
        scales=g.scales + float(np.log(scale)),
    )
    poses = tube.cameras.world_from_camera.copy()
    poses[:, :3, 3] = scale * (poses[:, :3, 3] @ turn.T) + shift
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    moved = replace(
        space,
        origin_mm=scale * (turn @ space.origin_mm) + shift,
        axes=space.axes @ turn.T,
        voxel_mm=scale * space.voxel_mm,
        clearance=space.clearance * np.float32(scale),
    )
    return Tube(Scene(gaussians, None), replace(tube.sequence, world_from_camera=poses)), moved


class TestExplore:
    def test_takes_error_away(self):
        found = explored()
        assert 1 <= len(found) <= 4
        assert found.score == "error"
        assert 0 < found.values.sum() <= found.removable_error
        summary = found.summary()
        assert summary["removed_error"] == pytest.approx(found.values.sum())

    @pytest.mark.parametrize("workers", [2, 4])
    def test_is_the_same_for_any_number_of_workers(self, workers, tmp_path):
        from concurrent.futures import ThreadPoolExecutor

        tube = small_tube()
        with ThreadPoolExecutor(workers) as pool:
            found = explore(
                tube.scene, tube.sequence, error_config(), freespace=small_freespace(), map=pool.map
            )
        np.testing.assert_array_equal(found.cameras.world_from_camera, explored().cameras.world_from_camera)
        np.testing.assert_array_equal(found.values, explored().values)

    def test_waves_lose_little_against_one_at_a_time(self):
        wide = explored(trajectories=6, wave=3, wave_kept_share=0.8)
        alone = explored(trajectories=6, wave=1)
        assert wide.values.sum() >= 0.95 * alone.values.sum()

    def test_moves_with_the_world(self):
        # Lights whose fall-off is in millimetres do not scale: without light.
        tube = make_tube(n_gaussians=1500, n_views=7, width=48, height=36, light=False)
        # One start: the first and the last view of the arc are equally far from its middle.
        config = error_config(trajectories=1, length=6)
        turn = rotation_about(np.array([1.0, 2.0, 3.0]), 0.8)
        moved, space = moved_tube(tube, small_freespace(), 2.5, turn)
        still = explore(tube.scene, tube.sequence, config, freespace=small_freespace())
        found = explore(moved.scene, moved.sequence, config, freespace=space)
        assert found.moves == still.moves
        assert found.removable_error == pytest.approx(still.removable_error, rel=1e-3)
        expected = 2.5 * still.cameras.centers @ turn.T + np.array([30.0, -7.0, 12.0])
        np.testing.assert_allclose(found.cameras.centers, expected, atol=2e-3)

    def test_nothing_is_proposed_where_nothing_is_missing(self):
        ball = make_ball()
        mesh = fuse_surface(ball.scene, ball.cameras)
        space = carve(ball.scene, mesh, ball.cameras)
        found = explore(ball.scene, ball.sequence, error_config(render_width=48), freespace=space)
        tube = explored()
        assert found.removable_error < 0.05 * tube.removable_error
        assert found.values.sum() < 0.05 * tube.values.sum()
        assert found.n_virtual <= 0.5 * tube.n_virtual

    def test_more_is_planned_where_more_is_missing(self):
        few = explored(trajectories=8, min_view_gain=1e-3)
        many = explored(trajectories=8, min_view_gain=0.0)
        assert few.n_virtual < many.n_virtual
        assert any("% of error" in line for line in few.rejected)


def test_a_branch_survives_its_file(tmp_path):
    ready = context()
    found = grow_branch(ready, small_tube().cameras.world_from_camera[START], ready.measured.known, START)
    found.save(tmp_path / "branch")
    loaded = Branch.load(tmp_path / "branch")
    np.testing.assert_array_equal(loaded.seen.value, found.seen.value)
    assert loaded.seen.value.dtype == np.float32
