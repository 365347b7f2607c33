"""Poses that COLMAP has found, and depth that the frames came with: one unit afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from extrags.config import PosesConfig
from extrags.errors import CaptureError, ConfigError
from extrags.poses import RgbdAlignment, estimate
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
    # As `estimate_poses` does where held-out frames alone have depth.
    shown = given if given.training_depth_known else replace(given, depth_mm=None)
    made = _from_colmap(shown, found(), registered, {"mean_reprojection_px": 0.0}, settings)
    return with_estimated_poses(given, made)


def withheld(given: EndoscopicSequence) -> EndoscopicSequence:
    """True depth is for the evaluation alone."""
    return given.without_training_depth()


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


def depth_beside_the_points(depth: float, *, share: float) -> np.ndarray:
    """`FAR` where a point is observed, and another depth at a share of the other pixels."""
    result = found()
    image = np.zeros((FRAMES, HEIGHT, WIDTH), np.float32)
    image.reshape(FRAMES, -1)[:, : round(share * HEIGHT * WIDTH)] = depth
    column, row = result.observed_px.astype(int).T
    image[result.observed_frame, row, column] = FAR
    return image


@pytest.mark.parametrize(
    ("share", "unit"), [pytest.param(0.9, 50 / 4, id="dense"), pytest.param(0.1, 50 / FAR, id="sparse")]
)
def test_the_working_distance_is_the_median_of_dense_depth(share: float, unit: float) -> None:
    """Of sparse depth the median need not be that of the others: that of the points counts, interpolated."""
    given = replace(sequence(metric=False), depth_mm=depth_beside_the_points(4.0, share=share))
    after = posed(given, 50.0)
    assert after.metric
    assert after.scale_words == "millimetres from the working distance given"
    assert after.depth_mm is not None
    assert given.depth_mm is not None
    # Single pixels whose depth is unlike that of all round them are taken for speckles.
    kept = (after.depth_mm > 0) | (given.depth_mm == 0)
    assert kept.mean() > 0.97
    np.testing.assert_allclose(after.depth_mm[kept], given.depth_mm[kept] * unit, rtol=0.02)
    assert np.ptp(after.cameras.centers[:, 0]) == pytest.approx(2 * unit, rel=0.02)


@pytest.mark.parametrize("metric", [True, False])
def test_the_working_distance_scales_an_alignment_by_depth(
    metric: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    placed = found()
    aligned = RgbdAlignment(placed.world_from_camera, placed.points, placed.points_rgb, {"without_depth": []})
    monkeypatch.setattr(estimate, "align_by_depth", lambda *_: aligned)
    given = sequence(metric=metric)
    made = estimate.estimate_poses(given, PosesConfig(fallback="rgbd", working_distance_mm=50.0))
    after = with_estimated_poses(given, made)
    unit = 1.0 if metric else 50 / FAR
    assert after.metric
    assert after.scale_source == ("depth" if metric else "working_distance")
    assert after.depth_mm is not None
    assert after.points is not None
    np.testing.assert_allclose(after.depth_mm, unit * FAR)
    np.testing.assert_allclose(after.points, unit * placed.points, rtol=1e-5)
    np.testing.assert_allclose(after.cameras.centers, unit * placed.world_from_camera[:, :3, 3])
    assert ("working distance" in made.summary) != metric


def test_a_scale_of_the_poses_that_are_replaced_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of other poses it says nothing, and they would be of no unit without a word."""

    def ran(*_given: object, **_named: object) -> PoseJobResult:
        raise CaptureError("COLMAP ran")

    monkeypatch.setattr(estimate, "run_job", ran)
    scaled = replace(sequence(metric=True), scale_source="setting")
    blind = replace(scaled, depth_mm=None)
    with pytest.raises(ConfigError, match=r"ingest\.scale_mm_per_unit.*poses\.working_distance_mm instead"):
        estimate.estimate_poses(blind, PosesConfig())
    for given, config in (
        (scaled, PosesConfig()),
        (blind, PosesConfig(working_distance_mm=30.0)),
        (replace(blind, scale_source="source"), PosesConfig()),
    ):
        with pytest.raises(CaptureError, match="COLMAP ran"):
            estimate.estimate_poses(given, config)


@pytest.mark.parametrize(
    ("metric", "working_distance_mm", "far", "true_far"),
    [
        pytest.param(True, None, FAR / UNIT, FAR / UNIT, id="metric truth, poses of no unit"),
        pytest.param(False, None, FAR / UNIT, FAR / UNIT, id="neither metric"),
        pytest.param(False, 50.0, 50.0, 50.0, id="truth of another unit, metric poses"),
        # How far the distance told is off counts in the figures.
        pytest.param(True, 50.0, 50.0, FAR, id="both metric"),
    ],
)
def test_withheld_truth_follows_the_poses(
    metric: bool, working_distance_mm: float | None, far: float, true_far: float
) -> None:
    after = posed(withheld(sequence(metric=metric)), working_distance_mm)
    assert after.metric == (working_distance_mm is not None)
    assert after.points is not None
    assert after.true_depth_mm is not None
    np.testing.assert_allclose(after.points[:, 2], far, rtol=1e-5)
    np.testing.assert_allclose(after.true_depth_mm, true_far, rtol=1e-5)
    assert not after.training_depth_known


@pytest.mark.parametrize("working_distance_mm", [None, 50.0])
def test_withheld_truth_of_an_unknown_unit_is_left_out(working_distance_mm: float | None) -> None:
    given = sequence(metric=False)
    assert given.depth_mm is not None
    few = np.zeros_like(given.depth_mm)
    few[:, 30, 40] = FAR
    after = posed(withheld(replace(given, depth_mm=few)), working_distance_mm)
    assert after.true_depth_mm is None


def test_withheld_truth_follows_an_alignment_by_estimated_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth that was estimated may be aligned by, beside true depth that was withheld."""
    given = sequence(metric=False)
    assert given.depth_mm is not None
    both = replace(given, withheld_depth_mm=2 * given.depth_mm)
    placed = found()
    aligned = RgbdAlignment(placed.world_from_camera, placed.points, placed.points_rgb, {"without_depth": []})
    monkeypatch.setattr(estimate, "align_by_depth", lambda *_: aligned)
    for working_distance_mm, factor in ((None, 1.0), (50.0, 50 / FAR)):
        config = PosesConfig(fallback="rgbd", working_distance_mm=working_distance_mm)
        after = with_estimated_poses(both, estimate.estimate_poses(both, config))
        assert after.depth_mm is not None
        assert after.true_depth_mm is not None
        np.testing.assert_allclose(after.depth_mm, factor * FAR)
        np.testing.assert_allclose(after.true_depth_mm, factor * 2 * FAR)


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
