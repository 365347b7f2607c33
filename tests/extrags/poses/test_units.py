"""Poses that COLMAP has found, and depth that the frames came with: one unit afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from extrags.config import PosesConfig
from extrags.errors import CaptureError
from extrags.poses import estimate
from extrags.poses.estimate import _from_colmap, with_estimated_poses
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.radial_lens import RadialLens
from extrags.sequence import EndoscopicSequence, Split

FRAMES, HEIGHT, WIDTH, FOCAL_PX = 6, 60, 80, 60.0
FAR = 10.0
"""Of a plane that all cameras look at, in the unit of the source."""
UNIT = 10.0
"""COLMAP's unit in that of the source."""


def sequence(*, metric: bool) -> EndoscopicSequence:
    K = np.tile(np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]]), (FRAMES, 1, 1))
    return EndoscopicSequence(
        "test/plane",
        np.full((FRAMES, HEIGHT, WIDTH, 3), 90, np.uint8),
        K,
        np.ones((FRAMES, HEIGHT, WIDTH), bool),
        Split("test", np.arange(5), np.array([5])),
        depth_mm=np.full((FRAMES, HEIGHT, WIDTH), FAR, np.float32),
        metric=metric,
    )


def found() -> PoseJobResult:
    """The cameras beside each other, and points of the plane, in COLMAP's unit."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = np.linspace(-1, 1, FRAMES)
    points = np.stack([rng.uniform(-4, 4, 100), rng.uniform(-3, 3, 100), np.full(100, FAR)], axis=1)
    frames, seen, pixels = [], [], []
    for frame in range(5):
        beside = points - poses[frame, :3, 3]
        place = FOCAL_PX * beside[:, :2] / beside[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        inside = np.flatnonzero(((place > 0) & (place < [WIDTH, HEIGHT])).all(axis=1))
        frames += [frame] * len(inside)
        seen += inside.tolist()
        pixels += place[inside].tolist()
    poses[:, :3, 3] /= UNIT
    return PoseJobResult(
        poses,
        points / UNIT,
        np.zeros((100, 3), np.uint8),
        np.array(frames),
        np.array(seen),
        np.array(pixels),
        {},
    )


def posed(given: EndoscopicSequence, working_distance_mm: float | None = None) -> EndoscopicSequence:
    settings = PosesConfig(working_distance_mm=working_distance_mm)
    registered = np.ones(FRAMES, bool)
    made = _from_colmap(given, found(), registered, {"mean_reprojection_px": 0.0}, settings)
    return with_estimated_poses(given, made)


@pytest.mark.parametrize(
    ("metric", "working_distance_mm", "far", "becomes_metric"),
    [(True, None, FAR, True), (False, None, FAR, False), (False, 50.0, 50.0, True), (True, 50.0, FAR, True)],
)
def test_depth_and_points_are_in_one_unit(
    metric: bool, working_distance_mm: float | None, far: float, becomes_metric: bool
) -> None:
    after = posed(sequence(metric=metric), working_distance_mm)
    assert after.metric == becomes_metric
    assert after.depth_mm is not None
    assert after.points is not None
    np.testing.assert_allclose(after.depth_mm, far, rtol=1e-5)
    np.testing.assert_allclose(after.points[:, 2], far, rtol=1e-5)
    baseline = np.ptp(after.cameras.centers[:, 0])
    assert baseline == pytest.approx(2 * far / FAR, rel=1e-5)


@pytest.mark.parametrize("working_distance_mm", [None, 50.0])
@pytest.mark.parametrize("metric", [True, False])
def test_depth_of_an_unknown_unit_is_left_out(
    caplog: pytest.LogCaptureFixture, metric: bool, working_distance_mm: float | None
) -> None:
    given = sequence(metric=metric)
    assert given.depth_mm is not None
    few = np.zeros_like(given.depth_mm)
    few[:, 30, 40] = FAR
    after = posed(replace(given, depth_mm=few), working_distance_mm)
    assert after.depth_mm is None
    assert not after.training_depth_known
    assert after.metric == (working_distance_mm is not None)
    assert "its unit is not that of the poses, and it is left out" in caplog.text


def test_a_lens_that_is_known_is_not_estimated(caplog: pytest.LogCaptureFixture, monkeypatch: Any) -> None:
    """What would be found is the lens of the pinhole that native frames are looked at through."""
    asked = []

    def ran(_module: str, job: PoseJob, *_given: object, **_named: object) -> PoseJobResult:
        asked.append(job.unknown_lens)
        raise CaptureError("enough")

    monkeypatch.setattr(estimate, "run_job", ran)
    lens = RadialLens((-0.02, 0.001, 0.0, 0.0), np.radians(60))
    config = PosesConfig(refine_intrinsics="always")
    for given in (replace(sequence(metric=True), lens=lens), sequence(metric=True)):
        with pytest.raises(CaptureError, match="enough"):
            estimate.estimate_poses(given, config)
    assert asked == [False, True]
    assert "those of a lens that is known; it is kept" in caplog.text
