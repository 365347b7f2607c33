"""Poses of a textured room by COLMAP, against the exact ones."""

from __future__ import annotations

import json
import logging
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import extrags.poses.estimate as estimate_module
from extrags.cameras import rotation_angle_deg
from extrags.config import PosesConfig
from extrags.errors import CaptureError, ShapeError
from extrags.events import Event, Progress, subscribed
from extrags.metrics.pose import absolute_trajectory_error
from extrags.poses import PoseEstimate, estimate_poses, registration_report, with_estimated_poses
from extrags.poses.colmap import MAPPED_STEPS
from extrags.poses.features import EXTRACTED_STEPS
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.sequence import EndoscopicSequence
from tests.extrags.poses.textured_room import HALF_SIZE_MM, room_sequence, turning_room

CONFIG = PosesConfig(n_features=600, fallback="never")
FRAMES, NOISE_FRAME, BLIND_COLUMNS = 9, 8, 40


@dataclass(frozen=True)
class Run:
    sequence: EndoscopicSequence
    estimate: PoseEstimate
    raw: PoseJobResult
    events: list[Event]
    log: str


@pytest.fixture(scope="module")
def sequence() -> EndoscopicSequence:
    """Seven training frames, and held-out ones, the last of which shows nothing but noise."""
    room = room_sequence(FRAMES, width=200, height=150)
    rng = np.random.default_rng(0)
    rgb = room.rgb.copy()
    rgb[NOISE_FRAME] = rng.integers(0, 255, rgb.shape[1:])
    # An overlay that is the same in every frame, as devices draw; the mask leaves it out.
    overlay = rng.integers(0, 255, (rgb.shape[1] // 6, BLIND_COLUMNS // 6 + 1, 3))
    rgb[:, :, :BLIND_COLUMNS] = np.kron(overlay, np.ones((6, 6, 1)))[: rgb.shape[1], :BLIND_COLUMNS]
    mask = room.mask.copy()
    mask[:, :, :BLIND_COLUMNS] = False
    split = replace(room.split, train=np.array([0, 1, 2, 4, 5, 6, 7]), test=np.array([3, 8]))
    return replace(room, rgb=rgb, mask=mask, split=split)


@pytest.fixture(scope="module")
def run(sequence: EndoscopicSequence) -> Run:
    events: list[Event] = []
    kept: list[PoseJobResult] = []
    messages: list[str] = []
    run_job = estimate_module._run

    def keeping(*arguments: object) -> PoseJobResult:
        kept.append(run_job(*arguments))  # type: ignore[arg-type]
        return kept[-1]

    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("extrags.poses.estimate")
    logger.addHandler(handler)
    with pytest.MonkeyPatch.context() as patch, subscribed(events.append):
        patch.setattr(estimate_module, "_run", keeping)
        found = estimate_poses(sequence, CONFIG)
    logger.removeHandler(handler)
    return Run(sequence, found, kept[0], events, "\n".join(messages))


def test_poses_are_metric_and_right(run: Run) -> None:
    registered = np.flatnonzero(run.estimate.registered)
    assert registered.tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert run.estimate.metric
    assert run.sequence.world_from_camera is not None
    # A rigid alignment only: the unit must be the millimetre already. The path is 12 mm wide.
    errors = absolute_trajectory_error(
        run.estimate.world_from_camera[registered], run.sequence.world_from_camera[registered], "se3"
    )
    assert errors.rmse < 0.05
    assert errors.rotation_mean_deg < 0.5
    assert run.estimate.mean_reprojection_px is not None
    assert run.estimate.mean_reprojection_px < 0.5
    assert run.estimate.report["scale"]["relative_spread"] < 0.01


def test_points_lie_on_the_walls(run: Run) -> None:
    from extrags.metrics.pose import umeyama

    assert run.sequence.world_from_camera is not None
    chosen = run.estimate.registered
    world = umeyama(
        run.estimate.world_from_camera[chosen, :3, 3],
        run.sequence.world_from_camera[chosen, :3, 3],
        with_scale=False,
    )
    points = world.apply(run.estimate.points.astype(np.float64))
    off_wall = np.abs(np.abs(points) - HALF_SIZE_MM).min(1)
    assert len(points) > 200
    assert float(np.median(off_wall)) < 0.1
    assert run.estimate.points_rgb.dtype == np.uint8
    assert run.estimate.points_rgb.std() > 5


def test_no_point_comes_from_masked_pixels(run: Run) -> None:
    assert len(run.raw.observed_px) > 1000
    assert run.raw.observed_px[:, 0].min() >= BLIND_COLUMNS
    assert set(np.unique(run.raw.observed_frame)) == set(run.sequence.train.tolist())


def test_a_frame_without_pose_is_named(run: Run) -> None:
    assert run.estimate.report["unregistered_test"] == ["arc-8"]
    assert run.estimate.report["unregistered_train"] == []
    assert "no pose for 1 of 2 held-out frames: arc-8" in run.log
    assert run.estimate.report["registrations"]["arc-3"]["inliers"] > 50
    assert run.estimate.summary == (
        "by COLMAP: 7 of 7 training frames, 1 of 2 held-out frames; scale from depth"
    )
    json.dumps(run.estimate.report, allow_nan=False)


def test_the_summary_says_where_parallax_is_missing(run: Run) -> None:
    """The plan of a page shows the summary; the log alone would be missed."""
    turning = replace(run.estimate, report={**run.estimate.report, "triangulation_angle_deg": 0.93})
    assert turning.summary.startswith(run.estimate.summary + "; the rays to a point differ by 0.9 degrees")


def test_progress_runs_to_its_end(run: Run) -> None:
    steps = [event for event in run.events if isinstance(event, Progress)]
    assert {step.stage for step in steps} == {"poses"}
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    assert steps[-1].done == steps[-1].total
    assert steps[-1].values["registered"] == 8
    # Seven frames and their 21 pairs make the map; each of the two others is matched with all seven.
    pairs, held_out_pairs = 21, 14
    weights = EXTRACTED_STEPS * 9 + pairs + MAPPED_STEPS * 7 + held_out_pairs + 2
    assert {step.total for step in steps} == {weights}
    # Held-out pairs are counted while they are matched, not only once all are.
    assert any(step.done == weights - 2 for step in steps)


def test_same_bits_and_nothing_of_held_out_frames_in_the_map(run: Run) -> None:
    """Once more with other held-out frames: training poses and points must be the very same."""
    rgb = run.sequence.rgb.copy()
    rgb[3] = rgb[0]
    other = replace(
        run.sequence, rgb=rgb, split=replace(run.sequence.split, test=np.array([3], dtype=np.int64))
    )
    again = estimate_poses(other, CONFIG)
    train = run.sequence.train
    np.testing.assert_array_equal(
        again.world_from_camera[train], run.estimate.world_from_camera[train], strict=True
    )
    np.testing.assert_array_equal(again.points, run.estimate.points, strict=True)
    # The copy of frame 0 lands where frame 0 is.
    np.testing.assert_allclose(again.world_from_camera[3], again.world_from_camera[0], atol=0.05)


def test_sequence_without_the_frames_that_failed(run: Run) -> None:
    posed = with_estimated_poses(run.sequence, run.estimate)
    assert len(posed) == FRAMES - 1
    assert posed.frame_names == tuple(f"arc-{k}" for k in range(8))
    assert posed.train.tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert posed.test.tolist() == [3]
    assert posed.world_from_camera is not None
    assert np.isfinite(posed.world_from_camera).all()
    assert posed.metric
    np.testing.assert_array_equal(posed.rgb, run.sequence.rgb[:8])
    assert posed.points is run.estimate.points
    assert posed.pose_source == "estimated"


def test_frames_in_the_middle_may_fail(run: Run) -> None:
    registered = run.estimate.registered.copy()
    registered[[1, 3]] = False
    posed = with_estimated_poses(run.sequence, replace(run.estimate, registered=registered, metric=False))
    assert posed.frame_names == ("arc-0", "arc-2", "arc-4", "arc-5", "arc-6", "arc-7")
    assert posed.train.tolist() == [0, 1, 2, 3, 4, 5]
    assert posed.test.tolist() == []
    assert not posed.metric
    assert posed.depth_mm is not None
    np.testing.assert_array_equal(posed.depth_mm[1], run.sequence.depth_mm[2])  # type: ignore[index]
    with pytest.raises(ShapeError, match="has 9 frames, the estimate has 3"):
        with_estimated_poses(
            run.sequence,
            replace(
                run.estimate, registered=registered[:3], world_from_camera=run.estimate.world_from_camera[:3]
            ),
        )


def test_withheld_depth_changes_neither_poses_nor_points(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without training depth the unit is COLMAP's own; the truth follows it, for the evaluation alone."""
    monkeypatch.setattr(estimate_module, "_run", lambda *_: run.raw)
    hidden = run.sequence.without_training_depth()
    found = estimate_poses(hidden, CONFIG)
    blind = estimate_poses(replace(hidden, depth_mm=None, withheld_depth_mm=None), CONFIG)
    assert not found.metric
    np.testing.assert_array_equal(found.points, blind.points)
    np.testing.assert_array_equal(found.world_from_camera, blind.world_from_camera)
    assert found.report == blind.report
    assert found.truth_per_unit == pytest.approx(run.estimate.report["scale"]["mm_per_unit"])
    assert blind.truth_per_unit is None
    posed = with_estimated_poses(hidden, found)
    assert not posed.metric
    assert posed.true_depth_mm is not None
    assert run.sequence.depth_mm is not None
    np.testing.assert_allclose(
        posed.true_depth_mm * found.truth_per_unit, run.sequence.depth_mm[:8], rtol=1e-5
    )
    assert posed.training_part().depth_mm is None
    unknown = with_estimated_poses(hidden, replace(found, truth_per_unit=None))
    assert unknown.true_depth_mm is None


def test_a_working_distance_makes_the_estimate_metric(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate_module, "_run", lambda *_: run.raw)
    told = CONFIG.model_copy(update={"working_distance_mm": 21.0})
    hidden = run.sequence.without_training_depth()
    found = estimate_poses(hidden, told)
    assert found.metric
    assert found.truth_per_unit is None
    assert found.report["scale"]["working_distance_mm"] == 21.0
    assert found.summary.endswith("scale from the working distance given")
    posed = with_estimated_poses(hidden, found)
    assert posed.scale_words == "millimetres from the working distance given"
    # The truth stays in its own millimetres: how far what was told is off counts in the figures.
    np.testing.assert_array_equal(posed.true_depth_mm, run.sequence.depth_mm[:8])  # type: ignore[index]
    # The room is as far away as that when its median true depth is told.
    assert run.sequence.depth_mm is not None
    true = float(np.median(run.sequence.depth_mm[run.sequence.train]))
    right = estimate_poses(hidden, CONFIG.model_copy(update={"working_distance_mm": true}))
    mm_per_unit = run.estimate.report["scale"]["mm_per_unit"]
    assert right.report["scale"]["mm_per_unit"] == pytest.approx(mm_per_unit, rel=0.03)
    # Where depth is known, it is measured and not told.
    measured = estimate_poses(run.sequence, told)
    np.testing.assert_array_equal(measured.points, run.estimate.points)
    posed = with_estimated_poses(run.sequence, measured)
    assert posed.scale_words == "millimetres from known depth"


def test_held_out_depth_is_none_to_fall_back_on(
    turning: EndoscopicSequence, no_parallax: PoseJobResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_module, "_run", lambda *_: no_parallax)
    split = replace(turning.split, train=np.array([0, 1, 2, 3]), test=np.array([4, 5]))
    hidden = replace(turning, split=split).without_training_depth()
    with pytest.raises(CaptureError, match="The source has no depth that frames could be aligned by"):
        estimate_poses(hidden, CONFIG.model_copy(update={"fallback": "auto"}))
    with pytest.raises(CaptureError, match="needs depth, and there is none"):
        estimate_poses(hidden, CONFIG.model_copy(update={"fallback": "rgbd"}))


def test_without_texture_the_account_says_so(sequence: EndoscopicSequence) -> None:
    flat = replace(sequence, rgb=np.full_like(sequence.rgb, 128))
    with pytest.raises(
        CaptureError, match=r"poses for 0 of 7 training frames \(0%\), expected at least 50%"
    ) as told:
        estimate_poses(flat, CONFIG)
    message = str(told.value)
    assert "Features per frame: 0 (median), 0 at least" in message
    assert "frames per model: none" in message
    assert "Without a pose: arc-0 to arc-7." in message
    assert "little texture: lower poses.peak_threshold" in message
    assert f"larger images than of {sequence.width} pixels" in message
    assert "whichever of ingest.width, ingest.downscale and ingest.size" in message
    assert "switched off (poses.fallback)" in message


def test_the_account_tells_features_inliers_and_parallax(run: Run) -> None:
    report = run.estimate.report
    assert set(report["frames"]) == {f"arc-{k}" for k in (0, 1, 2, 4, 5, 6, 7)}
    assert all(
        frame["registered"] and frame["features"] > 100 and frame["best_pair_inliers"] > 30
        for frame in report["frames"].values()
    )
    assert report["pairs_examined"] == report["pairs_verified"] > 10
    assert report["pairs_turn_only"] == 0
    # The arc is 12 mm wide, the walls are about 20 mm away.
    assert 3 < report["pair_angle_deg"] < 40
    assert 5 < report["triangulation_angle_deg"] < 60


@pytest.fixture(scope="module")
def turning() -> EndoscopicSequence:
    return turning_room(6)


@pytest.fixture(scope="module")
def no_parallax(turning: EndoscopicSequence) -> PoseJobResult:
    """What COLMAP makes of a scope that only turns."""
    return estimate_module._run(estimate_module._job(turning, CONFIG), turning.name)


def test_a_scope_that_only_turns(
    turning: EndoscopicSequence, no_parallax: PoseJobResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Good matches from one point: the report must name the parallax."""
    monkeypatch.setattr(estimate_module, "_run", lambda *_: no_parallax)
    for fallback, instead in (
        ("never", r"switched off \(poses.fallback\)"),
        ("auto", "The source has no depth that frames could be aligned by"),
    ):
        with pytest.raises(CaptureError, match=f"too little parallax.*{instead}"):
            estimate_poses(replace(turning, depth_mm=None), CONFIG.model_copy(update={"fallback": fallback}))


def test_poses_that_parallax_hardly_tells_come_with_a_warning(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(estimate_module, "_run", lambda *_: run.raw)
    estimate_poses(run.sequence, CONFIG)
    assert "sideways motion" not in caplog.text
    monkeypatch.setattr(registration_report, "LITTLE_PARALLAX_DEG", 90.0)
    estimate_poses(run.sequence, CONFIG)
    assert "give a part of the recording with sideways motion" in caplog.text


def test_a_second_attempt_is_lenient_and_counts_where_it_registers_more(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    jobs: list[PoseJob] = []
    complete = estimate_module._run(estimate_module._job(run.sequence, CONFIG), "arc")
    count = len(run.sequence)
    none = replace(
        complete,
        world_from_camera=np.full((count, 4, 4), np.nan),
        report=complete.report | {"registrations": {}},
    )

    def attempts(job: PoseJob, _: str) -> PoseJobResult:
        jobs.append(job)
        return complete if job.lenient else none

    monkeypatch.setattr(estimate_module, "_run", attempts)
    hidden = replace(run.sequence, depth_mm=None)
    found = estimate_poses(hidden, CONFIG)
    assert [job.lenient for job in jobs] == [False, True]
    assert found.report["lenient"]
    assert found.summary.startswith(
        "by COLMAP: 7 of 7 training frames in a second, lenient attempt (0 in the first), 1 of 2 held-out"
    )
    assert "trying again with guided matching" in caplog.text
    np.testing.assert_array_equal(found.registered, run.estimate.registered)
    with pytest.raises(CaptureError, match="for 0 of 7 training frames"):
        estimate_poses(hidden, CONFIG.model_copy(update={"lenient_retry": False}))
    assert len(jobs) == 3
    # Depth to align frames by is better than bad matches.
    monkeypatch.setattr(estimate_module, "_by_depth", lambda *_: found)
    assert estimate_poses(run.sequence, CONFIG.model_copy(update={"fallback": "auto"})) is found
    assert not jobs[-1].lenient


def test_depth_steps_in_where_colmap_fails(
    turning: EndoscopicSequence, no_parallax: PoseJobResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_module, "_run", lambda *_: no_parallax)
    messages: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("extrags.poses.estimate")
    logger.addHandler(handler)
    found = estimate_poses(turning, CONFIG.model_copy(update={"fallback": "auto", "rgbd_width": 100}))
    logger.removeHandler(handler)
    assert found.method == "rgbd"
    assert found.registered.all()
    assert found.metric
    assert found.mean_reprojection_px is None
    assert any("aligning by colour and depth instead" in message for message in messages)
    assert found.report["colmap"]["registered_train"] < 0.5 * len(turning.train)
    assert "by colour and depth: 6 of 6 training frames (COLMAP registered only" in found.summary
    # All frames stand in one place, so that an alignment of centres would say nothing.
    assert turning.world_from_camera is not None
    there = turning.world_from_camera[0] @ found.world_from_camera
    assert np.linalg.norm((there - turning.world_from_camera)[:, :3, 3], axis=1).max() < 0.05
    assert rotation_angle_deg(there[:, :3, :3], turning.world_from_camera[:, :3, :3]).max() < 0.1
    json.dumps(found.report, allow_nan=False)


def test_depth_fails_as_well(
    turning: EndoscopicSequence, no_parallax: PoseJobResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_module, "_run", lambda *_: no_parallax)
    assert turning.depth_mm is not None
    depth = turning.depth_mm.copy()
    depth[2:] = 0
    blind = replace(turning, depth_mm=depth)
    with pytest.raises(CaptureError, match="Alignment by depth failed as well") as told:
        estimate_poses(blind, CONFIG.model_copy(update={"fallback": "auto", "rgbd_width": 100}))
    assert "placed 2 of 6 training frames" in str(told.value)
    assert "of these without depth: arc-2 to arc-5" in str(told.value)


def test_too_few_frames(sequence: EndoscopicSequence) -> None:
    two = replace(sequence, split=replace(sequence.split, train=np.array([0, 1])))
    with pytest.raises(CaptureError, match="at least 3 training frames, found 2"):
        estimate_poses(two, CONFIG)


def test_a_process_that_dies_is_told_with_its_last_words(
    sequence: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho 'zlib: out of luck' >&2\nexit 7\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(CaptureError, match="ended with code 7:\nzlib: out of luck"):
        estimate_poses(sequence, CONFIG)


@pytest.mark.slow
def test_human_sinus_at_a_quarter_of_its_size(shared_data: Path) -> None:
    from data_catalog.readers import sinus
    from extrags.config import IngestConfig

    source = sinus.READER.read(shared_data / "sinus_hopkins", IngestConfig(downscale=4), "sinus/hopkins")
    found = estimate_poses(source, PosesConfig())
    assert source.world_from_camera is not None
    chosen = found.registered
    assert int(chosen.sum()) == 35
    assert not found.metric
    errors = absolute_trajectory_error(found.world_from_camera[chosen], source.world_from_camera[chosen])
    # The path is 0.14 x 0.27 x 0.19 units long; the shipped poses are themselves estimates.
    assert errors.rmse < 0.010
    assert found.mean_reprojection_px is not None
    assert found.mean_reprojection_px < 1.0
    assert len(found.points) > 500
