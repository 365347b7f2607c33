"""Points of a textured room seen by known cameras."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from extrags.config import PosesConfig
from extrags.errors import ShapeError
from extrags.events import Event, Progress, subscribed
from extrags.poses import Triangulation, triangulate_points
from extrags.poses.colmap_triangulation import _fundamental, _sampson_px
from extrags.poses.pairs import neighbouring_pairs
from extrags.poses.triangulation import _contradiction, _no_points
from extrags.sequence import EndoscopicSequence
from tests.extrags.poses.textured_room import HALF_SIZE_MM, room_sequence

CONFIG = PosesConfig(n_features=400)


@pytest.fixture(scope="module")
def sequence() -> EndoscopicSequence:
    """Frames 2 and 5 are held out; no depth and no point is known."""
    room = room_sequence(7, width=160, height=120, holdout_every=3)
    return replace(room, depth_mm=None)


@pytest.fixture(scope="module")
def found(sequence: EndoscopicSequence) -> tuple[Triangulation, list[Event]]:
    events: list[Event] = []
    with subscribed(events.append):
        return triangulate_points(sequence, CONFIG, stage="depth"), events


def test_points_lie_on_the_walls(found: tuple[Triangulation, list[Event]]) -> None:
    points = found[0]
    assert len(points) > 200
    off_wall = np.abs(np.abs(points.points) - HALF_SIZE_MM).min(1)
    assert float(np.median(off_wall)) < 0.1
    assert points.points_rgb.std() > 5
    # Rays that meet at a larger angle, and more of them, tell more.
    sure = (points.angle_deg > 10) & (points.track_length >= 3)
    assert float(np.quantile(off_wall[sure], 0.9)) < float(np.quantile(off_wall, 0.9))


def test_observations_are_those_of_training_frames(
    sequence: EndoscopicSequence, found: tuple[Triangulation, list[Event]]
) -> None:
    points = found[0]
    assert set(np.unique(points.observed_frame)) == {0, 1, 3, 4, 6}
    np.testing.assert_array_equal(
        np.bincount(points.observed_point, minlength=len(points)), points.track_length
    )
    assert points.track_length.min() >= 2
    assert points.angle_deg.min() >= 1
    for frame in (0, 4):
        rows = points.observed_frame == frame
        (pixels,), (z,) = sequence.cameras[frame].project(points.points[points.observed_point[rows]])
        assert z.min() > 0
        assert np.abs(pixels - points.observed_px[rows]).max() < 5
    assert float(np.median(points.reprojection_px)) < 0.5


def test_of_smaller_frames_observations_are_in_pixels_of_the_given_ones(
    sequence: EndoscopicSequence, found: tuple[Triangulation, list[Event]]
) -> None:
    points = triangulate_points(sequence, CONFIG.model_copy(update={"max_width": 120}))
    assert len(points) > 100
    assert len(points) != len(found[0])
    assert points.observed_px[:, 0].max() > 130
    # Features of smaller frames are four thirds as far off.
    assert float(np.median(points.reprojection_px)) < 0.7
    off_wall = np.abs(np.abs(points.points) - HALF_SIZE_MM).min(1)
    assert float(np.median(off_wall)) < 0.2


def test_progress_and_account(found: tuple[Triangulation, list[Event]]) -> None:
    points, events = found
    steps = [event for event in events if isinstance(event, Progress)]
    assert {step.stage for step in steps} == {"depth"}
    assert steps[-1].done == steps[-1].total
    assert steps[-1].values["points"] == len(points)
    assert points.report["matches_kept"] <= points.report["matches"]
    assert points.summary.startswith(f"{len(points)} points from 5 training frames")
    json.dumps(points.report, allow_nan=False)


def test_same_bits_and_nothing_of_held_out_frames(
    sequence: EndoscopicSequence, found: tuple[Triangulation, list[Event]]
) -> None:
    rgb = sequence.rgb.copy()
    rgb[sequence.test] = 0
    again = triangulate_points(replace(sequence, rgb=rgb), CONFIG)
    np.testing.assert_array_equal(again.points, found[0].points)
    np.testing.assert_array_equal(again.observed_px, found[0].observed_px)


def test_without_texture_or_motion_there_are_no_points(sequence: EndoscopicSequence) -> None:
    flat = triangulate_points(replace(sequence, rgb=np.full_like(sequence.rgb, 128)), CONFIG)
    assert len(flat) == 0
    assert flat.points.shape == (0, 3)
    assert flat.angle_deg.shape == flat.track_length.shape == (0,)
    assert flat.summary == "no point could be triangulated"
    alone = triangulate_points(
        replace(sequence, split=replace(sequence.split, train=np.array([0]), test=np.array([1]))), CONFIG
    )
    assert len(alone) == 0


def test_poses_that_features_contradict_are_told(
    sequence: EndoscopicSequence,
    found: tuple[Triangulation, list[Event]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A run went on with poses in other axes, and only `data check` had a word for it."""
    right = found[0]
    assert _contradiction(right, 1.0) == ""
    few = replace(right, report={**right.report, "matches": 33790, "matches_kept": 13992})
    assert _contradiction(few, 1.0) == ""
    wrong = replace(few, reprojection_px=np.full(len(few), 1.3))
    assert _contradiction(wrong, 2.0) == ""
    told = _contradiction(wrong, 1.0)
    assert "the poses explain 41 % of 33790 feature matches between training frames" in told
    monkeypatch.setattr("extrags.poses.triangulation._assessed", lambda *_: wrong)
    monkeypatch.setattr("extrags.poses.triangulation.run_job", lambda *_, **__: _no_points(sequence))
    assert triangulate_points(sequence, CONFIG).report["contradiction"] == told
    assert told in caplog.text


def test_poses_are_needed(sequence: EndoscopicSequence) -> None:
    with pytest.raises(ShapeError, match="has no poses yet"):
        triangulate_points(replace(sequence, world_from_camera=None), CONFIG)


def test_epipolar_distance_is_zero_for_projections_and_in_pixels(sequence: EndoscopicSequence) -> None:
    cameras = sequence.cameras
    generator = np.random.default_rng(0)
    points = generator.uniform((-8, -8, -2), (8, 8, 14), (50, 3))
    (first,), _ = cameras[0].project(points)
    (second,), _ = cameras[3].project(points)
    poses = cameras.world_from_camera
    F = _fundamental(cameras.K[0], cameras.K[3], np.linalg.inv(poses[3]) @ poses[0])
    assert _sampson_px(F, first, second).max() < 1e-6
    lines = np.concatenate([first, np.ones((50, 1))], axis=1) @ F.T
    across = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    # The distance is shared between both images.
    error = _sampson_px(F, first, second + 2 * across)
    assert 1 < float(np.median(error)) < 2


def test_neighbours_are_found_whatever_their_order() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    order = np.random.default_rng(0).permutation(12)
    poses = np.tile(np.eye(4), (13, 1, 1))
    for place, angle in zip(order, angles, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        poses[place, :3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        poses[place, :3, 3] = [4 * s, 0, -4 * c]
    pairs = neighbouring_pairs(np.arange(12), poses, neighbours=2)
    beside = {tuple(sorted((int(a), int(b)))) for a, b in zip(order, np.roll(order, 1), strict=True)}
    assert set(pairs) == beside
    assert pairs == sorted(pairs)
    assert neighbouring_pairs(np.arange(1), poses, neighbours=2) == []
