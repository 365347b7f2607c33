"""Poses from colour and depth, against the exact ones."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from extrags.cameras import pixel_rays
from extrags.config import PosesConfig
from extrags.errors import CaptureError
from extrags.events import Event, Progress, subscribed
from extrags.feature_matches import mutual_matches
from extrags.poses import RgbdAlignment, align_by_depth, errors_against_given
from extrags.poses.alignment import TUKEY, Posed, _solved, _tukey, agreement, align, pair_equations
from extrags.poses.depth_views import depth_view
from extrags.poses.landmarks import Landmarks, landmarks, relative_pose
from extrags.sequence import EndoscopicSequence, Split
from tests.extrags.poses.textured_room import HALF_SIZE_MM, room_sequence

CONFIG = PosesConfig(rgbd_width=100)


@pytest.fixture(scope="module")
def sequence() -> EndoscopicSequence:
    """Seven training frames with noisy depth, two held out, of which the last shows nothing but noise."""
    room = room_sequence(9, width=200, height=150)
    assert room.depth_mm is not None
    rng = np.random.default_rng(0)
    depth = (room.depth_mm * rng.normal(1, 0.005, room.depth_mm.shape)).astype(np.float32)
    rgb = room.rgb.copy()
    rgb[8] = rng.integers(0, 255, rgb.shape[1:])
    depth[8] = rng.uniform(5, 30, depth.shape[1:])
    # The lamp rides on the scope: each frame has a brightness of its own.
    gain = np.linspace(0.7, 1.1, 9)[:, None, None, None]
    rgb = np.clip(rgb * gain, 0, 249).astype(np.uint8)
    split = Split("seven", np.array([0, 1, 2, 4, 5, 6, 7]), np.array([3, 8]))
    return replace(room, rgb=rgb, depth_mm=depth, split=split)


@pytest.fixture(scope="module")
def found(sequence: EndoscopicSequence) -> tuple[RgbdAlignment, list[Event]]:
    events: list[Event] = []
    with subscribed(events.append):
        alignment = align_by_depth(sequence, CONFIG)
    return alignment, events


def test_poses_are_metric_and_right(
    sequence: EndoscopicSequence, found: tuple[RgbdAlignment, list[Event]]
) -> None:
    poses = found[0].world_from_camera
    assert np.flatnonzero(np.isfinite(poses).all((1, 2))).tolist() == list(range(8))
    np.testing.assert_array_equal(poses[0], np.eye(4))
    errors = errors_against_given(sequence, poses, metric=True)
    # The path is 12 mm wide, pixels at the wall are 0.3 mm wide.
    assert errors["train"]["ate_rmse"] < 0.1
    assert errors["test"]["ate_rmse"] < 0.1
    assert errors["train"]["rotation_mean_deg"] < 1.0
    assert errors["train"]["rpe_translation_rmse"] < 0.1


def test_points_lie_on_the_walls(
    sequence: EndoscopicSequence, found: tuple[RgbdAlignment, list[Event]]
) -> None:
    assert sequence.world_from_camera is not None
    first = sequence.world_from_camera[0]
    points = found[0].points @ first[:3, :3].T + first[:3, 3]
    off_wall = np.abs(np.abs(points) - HALF_SIZE_MM).min(1)
    assert len(points) > 2000
    assert float(np.median(off_wall)) < 0.2
    assert found[0].points_rgb.std() > 5


def test_progress_and_account(sequence: EndoscopicSequence, found: tuple[RgbdAlignment, list[Event]]) -> None:
    alignment, events = found
    steps = [event for event in events if isinstance(event, Progress)]
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    assert steps[-1].done == steps[-1].total
    assert steps[-1].values["registered"] == 8
    assert alignment.report["frames"]["arc-3"]["placed"]
    assert not alignment.report["frames"].get("arc-8", {"placed": False})["placed"]
    assert 0 < alignment.report["surface_residual_mm"] < 0.3
    json.dumps(alignment.report, allow_nan=False)


def test_same_bits_and_nothing_of_held_out_frames_in_the_model(
    sequence: EndoscopicSequence, found: tuple[RgbdAlignment, list[Event]]
) -> None:
    rgb = sequence.rgb.copy()
    rgb[3] = 0
    alone = replace(sequence, rgb=rgb, split=replace(sequence.split, test=np.array([3])))
    again = align_by_depth(alone, CONFIG)
    train = sequence.train
    np.testing.assert_array_equal(again.world_from_camera[train], found[0].world_from_camera[train])
    np.testing.assert_array_equal(again.points, found[0].points)


def test_a_first_frame_of_something_else_is_left_out(sequence: EndoscopicSequence) -> None:
    """As it would be in the middle: the largest model counts."""
    rng = np.random.default_rng(0)
    rgb, depth = sequence.rgb.copy(), np.array(sequence.depth_mm)
    height, width = depth.shape[1:]
    rgb[0] = rng.normal(90, 6, (height, width, 3)).clip(0, 255)
    depth[0] = 55 + np.linspace(0, 60, width) + rng.normal(0, 0.05, (height, width))
    found = align_by_depth(replace(sequence, rgb=rgb, depth_mm=depth), CONFIG)
    placed = np.isfinite(found.world_from_camera).all((1, 2))
    assert not placed[0]
    assert placed[1:].sum() >= 6


def test_without_texture_the_shape_may_do(sequence: EndoscopicSequence) -> None:
    """A room seen into its corners is known by its walls alone."""
    room = room_sequence(5, width=200, height=150, holdout_every=9)
    found = align_by_depth(replace(room, rgb=np.full_like(room.rgb, 128)), CONFIG)
    errors = errors_against_given(room, found.world_from_camera, metric=True)
    assert errors["train"]["frames"] == 5
    assert errors["train"]["ate_rmse"] < 0.2


def test_depth_is_needed(sequence: EndoscopicSequence) -> None:
    with pytest.raises(CaptureError, match="needs depth, and there is none"):
        align_by_depth(replace(sequence, depth_mm=None), CONFIG)
    assert sequence.depth_mm is not None
    empty = np.zeros_like(sequence.depth_mm)
    with pytest.raises(CaptureError, match="none of 7 training frames has enough depth"):
        align_by_depth(replace(sequence, depth_mm=empty), CONFIG)


def test_a_frame_without_depth_is_named(sequence: EndoscopicSequence) -> None:
    assert sequence.depth_mm is not None
    depth = sequence.depth_mm.copy()
    depth[4] = 0
    part = replace(
        sequence, depth_mm=depth, split=Split("part", np.array([0, 1, 2, 4, 5]), np.array([], dtype=np.int64))
    )
    found = align_by_depth(part, CONFIG)
    assert found.report["without_depth"] == ["arc-4"]
    assert np.isfinite(found.world_from_camera).all((1, 2))[[0, 1, 2, 4, 5]].tolist() == [
        True, True, True, False, True,
    ]  # fmt: skip


class TestAlign:
    def test_from_a_rough_guess(self, sequence: EndoscopicSequence) -> None:
        assert sequence.world_from_camera is not None
        truth = sequence.world_from_camera
        first, second = (depth_view(sequence, frame, 100) for frame in (0, 2))
        assert first is not None
        assert second is not None
        start = truth[2].copy()
        start[:3, 3] += [0.8, -0.6, 0.5]
        pose = align(second, start, [Posed(first, truth[0])])
        assert np.linalg.norm(pose[:3, 3] - truth[2][:3, 3]) < 0.15
        right = agreement(Posed(second, truth[2]), [Posed(first, truth[0])])
        wrong = agreement(Posed(second, start), [Posed(first, truth[0])])
        assert right.surface > 0.9
        assert right.texture > 0.5
        assert right.score > wrong.score + 0.3

    def test_nothing_in_common_changes_nothing(self, sequence: EndoscopicSequence) -> None:
        assert sequence.world_from_camera is not None
        view = depth_view(sequence, 0, 100)
        assert view is not None
        away = sequence.world_from_camera[0].copy()
        away[:3, 3] += 500.0
        reference = Posed(view, sequence.world_from_camera[0])
        np.testing.assert_array_equal(align(view, away, [reference]), away)
        assert pair_equations(Posed(view, away), reference, 0, away[:3, 3]).count == 0
        assert agreement(Posed(view, away), [reference]).score == 0.0

    def test_size_and_normals(self, sequence: EndoscopicSequence) -> None:
        view = depth_view(sequence, 0, 70)
        assert view is not None
        # 200 / 3: sizes are divided by whole numbers.
        assert view.valid.shape == (50, 66)
        assert sequence.depth_mm is not None
        assert view.points[20, 30, 2] == pytest.approx(sequence.depth_mm[0, 61, 91])
        u = view.K[0, 0] * view.points[20, 30, 0] / view.points[20, 30, 2] + view.K[0, 2]
        assert u == pytest.approx(30.5)
        known = np.abs(view.normals).sum(-1) > 0
        assert (view.normals * view.points).sum(-1)[known].max() < 0

    @pytest.mark.parametrize(("max_width", "step"), [(100, 2), (67, 3), (50, 4)])
    def test_frames_that_are_upside_down(self, max_width: int, step: int) -> None:
        """Depth and colours of different places would differ to the other side."""
        # Sizes that no step divides: blocks of the two frames differ. Of a picture on a plane ahead, the
        # colours alone tell the place.
        room = room_sequence(4, width=199, height=149)
        ahead = np.array([0.0, 0.0, 20.0, 1.0])
        upright = replace(room, depth_mm=np.full(room.mask.shape, ahead[2], np.float32))
        turned = replace(upright, rgb=np.ascontiguousarray(room.rgb[:, ::-1, ::-1]))
        first, second = depth_view(upright, 0, max_width), depth_view(turned, 0, max_width)
        assert first is not None
        assert second is not None
        assert second.valid.shape == (149 // step, 199 // step)
        half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        start = half_turn.copy()
        start[:3, 3] += [0.2, -0.1, 0.1]
        pose = align(second, start, [Posed(first, np.eye(4))])
        off_px = room.K[0, 0, 0] * (np.linalg.inv(pose) @ half_turn @ ahead - ahead)[:2] / ahead[2]
        assert np.linalg.norm(off_px) < 0.25

    @pytest.mark.parametrize("step", [1, 2, 3, 4])
    def test_depth_of_a_slanted_wall_and_of_a_fold(self, step: int) -> None:
        room = room_sequence(4, width=120, height=96)
        rays = pixel_rays(room.cameras[0])[0] @ np.asarray(room.cameras.world_from_camera[0, :3, :3])
        # In camera axes: a wall 10 ahead that recedes to the right, and behind its edge another.
        normal, distance = np.array([-0.3, 0.1, 1.0]), 10.0
        depth = distance / (rays @ normal)
        # It lies in the middle of a block.
        edge = 60 + step // 2
        depth[:, edge:] += 30
        shown = replace(room, depth_mm=np.tile(depth.astype(np.float32), (len(room), 1, 1)))
        view = depth_view(shown, 0, 120 // step)
        assert view is not None
        wall = view.valid & (np.arange(view.valid.shape[1]) < edge // step - 1)
        assert wall.mean() > 0.4
        np.testing.assert_allclose(view.points[wall] @ normal, distance, rtol=1e-5)
        # Of the two surfaces, and of nothing between them.
        points = view.points[view.valid]
        behind = points[:, 2] - distance / (points / points[:, 2:] @ normal)
        assert np.minimum(np.abs(behind), np.abs(behind - 30)).max() < 1e-4


class TestLandmarks:
    def test_relative_pose(self, sequence: EndoscopicSequence) -> None:
        assert sequence.world_from_camera is not None
        truth = np.linalg.inv(sequence.world_from_camera[0]) @ sequence.world_from_camera[2]
        between, support = relative_pose(landmarks(sequence, 2), landmarks(sequence, 0), seed=0)
        assert between is not None
        assert support > 30
        assert np.linalg.norm(between[:3, 3] - truth[:3, 3]) < 0.3

    def test_a_third_of_wrong_matches(self) -> None:
        rng = np.random.default_rng(1)
        points = rng.uniform((-5, -5, 10), (5, 5, 20), (60, 3))
        names = np.eye(128, dtype=np.float32)[rng.permutation(128)[:60]]
        shift = np.array([2.0, -1.0, 0.5])
        wrong = rng.permutation(60)[:20]
        there = points + shift
        there[wrong] = rng.uniform((-5, -5, 10), (5, 5, 20), (20, 3))
        between, support = relative_pose(Landmarks(points, names), Landmarks(there, names), seed=0)
        assert between is not None
        np.testing.assert_allclose(between[:3, 3], shift, atol=0.05)
        assert 38 <= support <= 45

    def test_no_landmarks(self, sequence: EndoscopicSequence) -> None:
        none = landmarks(replace(sequence, rgb=np.full_like(sequence.rgb, 90)), 0)
        assert len(none.points) == 0
        assert len(mutual_matches(none.descriptors, none.descriptors)) == 0
        assert relative_pose(none, landmarks(sequence, 0), seed=0) == (None, 0)


def test_residuals_far_beyond_the_usual_do_not_count() -> None:
    ratios = np.array([0.0, 0.5 * TUKEY, -0.5 * TUKEY, TUKEY, 3 * TUKEY])
    np.testing.assert_allclose(_tukey(ratios), [1, 0.75**2, 0.75**2, 0, 0])


def test_what_is_nearly_undetermined_is_solved_alike_in_any_unit() -> None:
    rows = np.random.default_rng(0).normal(size=(20, 6))
    rows[:, 5] *= 1e-3
    normal, right = rows.T @ rows, rows.T @ np.random.default_rng(1).normal(size=20)
    length = np.repeat([1.0, 1000.0], 3)
    found = _solved(normal / np.outer(length, length), right / length, 2000.0)
    np.testing.assert_allclose(found, length * _solved(normal, right, 2.0), rtol=1e-6)
