"""The poses stage, and what the coarse stage does with poses that were estimated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import extrags.training
from extrags.config import CoarseConfig, IngestConfig, PosesConfig
from extrags.errors import ConfigError
from extrags.events import Event, Progress, subscribed
from extrags.observed_surface import observed_from_depth
from extrags.poses import observed_by_those_left
from extrags.sequence import EndoscopicSequence
from extrags.store import Ref, Slot, Store
from extrags.training.frame_colors import FrameColors
from extrags.zarr_io import group_exists
from tasks.coarse import coarse, refined_frames
from tasks.ingest import training_frames
from tasks.poses import lens_settings, poses
from tasks.stage import stage
from tests.extrags.poses.textured_room import room_sequence


@stage("poses-test-source", version=1)
def room(slot: Slot) -> None:
    """A sequence with exact poses; its depth is known, so no COLMAP is needed."""
    room_sequence(7, width=120, height=90, holdout_every=4).save(slot.path / "sequence")


@stage("poses-test-guessed-source", version=1)
def guessed_room(slot: Slot) -> None:
    """Nothing states its lens."""
    replace(room_sequence(4, width=40, height=30), intrinsics="guessed").save(slot.path / "sequence")


DROPPED = [4, 5, 6]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def posed(store: str) -> Ref:
    return poses.fn(store=store, sequence=room.fn(store=store), config=PosesConfig(fallback="rgbd"))


@pytest.fixture(scope="module")
def training(store: str, posed: Ref) -> Ref:
    return training_frames.fn(store=store, sequence=posed)


def read(store: str, ref: Ref) -> EndoscopicSequence:
    return EndoscopicSequence.load(Store(store).open(ref) / "sequence")


def test_the_method_stands_in_counts_and_account(store: str, posed: Ref) -> None:
    counts = Store(store).manifest(posed).counts
    assert counts["method"] == "rgbd"
    assert (
        counts["summary"]
        == "by colour and depth: 6 of 6 training frames, 1 of 1 held-out frames; scale from depth"
    )
    assert counts["dropped"] == 0
    assert (counts["intrinsics"], counts["focal_std_px"]) == ("given", None)
    report = json.loads((Store(store).open(posed) / "poses.json").read_bytes())
    assert report["against_given"]["train"]["ate_rmse"] < 0.1
    assert report["against_given"]["test"]["frames"] == 1
    sequence = read(store, posed)
    assert sequence.pose_source == "aligned"
    assert sequence.world_from_camera is not None
    np.testing.assert_array_equal(sequence.world_from_camera[0], np.eye(4))


@stage("poses-test-dropping-source", version=1)
def dropping_room(slot: Slot, with_poses: bool = True) -> None:
    """Half of the training frames have neither texture nor depth; nearly all is said to be observed."""
    room = room_sequence(7, width=120, height=90, holdout_every=4)
    rgb, depth = room.rgb.copy(), room.depth_mm
    assert depth is not None
    depth = depth.copy()
    rgb[DROPPED], depth[DROPPED] = 128, 0
    # The others do not see one side.
    depth[:3, :, :50] = 0
    observed = np.zeros_like(room.mask)
    observed[room.test] = True
    observed[room.test, :10] = False
    poses = room.world_from_camera if with_poses else None
    replace(room, rgb=rgb, depth_mm=depth, observed=observed, world_from_camera=poses).save(
        slot.path / "sequence"
    )


class TestDroppedTrainingFrames:
    def test_what_they_alone_observed_is_not_observed_any_more(self, store: str) -> None:
        source = dropping_room.fn(store=store)
        ref = poses.fn(store=store, sequence=source, config=PosesConfig(fallback="rgbd"))
        before, after = read(store, source), read(store, ref)
        assert len(after.train) == len(before.train) - len(DROPPED)
        assert before.depth_mm is not None
        assert before.observed is not None
        left = np.setdiff1d(before.train, DROPPED)
        expected = observed_from_depth(before.cameras, before.mask, before.depth_mm, left, before.test)
        expected &= before.observed
        assert after.observed is not None
        np.testing.assert_array_equal(after.observed[after.test], expected[before.test])
        shares = [
            stack[frames].mean()
            for stack, frames in zip(
                (before.observed, after.observed), (before.test, after.test), strict=True
            )
        ]
        assert 0.5 * shares[0] < shares[1] < 0.99 * shares[0]

    def test_without_poses_nothing_is_said(self, store: str, caplog: pytest.LogCaptureFixture) -> None:
        source = dropping_room.fn(store=store, with_poses=False)
        ref = poses.fn(store=store, sequence=source, config=PosesConfig(fallback="rgbd"))
        assert read(store, ref).observed is None
        assert "3 training frames are dropped" in caplog.text

    def test_with_all_of_them_it_stays(self) -> None:
        room = replace(room_sequence(4, width=40, height=30), intrinsics="guessed")
        told = replace(room, observed=room.mask)
        assert observed_by_those_left(told, np.ones(4, dtype=bool)) is told.observed

    def test_the_search_tells_how_far_it_is(self) -> None:
        """Events are also where a run that is interrupted, or past its time limit, ends."""
        room = room_sequence(7, width=40, height=30, holdout_every=4)
        registered = np.ones(7, dtype=bool)
        registered[room.train[-1]] = False
        heard: list[Event] = []
        with subscribed(heard.append):
            observed_by_those_left(replace(room, observed=room.mask), registered)
        frames = len(room.test)
        assert heard == [Progress("poses", done, frames) for done in range(1, frames + 1)]


class TestLensSettings:
    def test_sizes_count_where_the_pinhole_is_widened(self) -> None:
        narrow = IngestConfig(width=80, holdout_every=5, size="central")
        assert lens_settings(narrow) == IngestConfig()
        wide = narrow.model_copy(update={"field_of_view_deg": 110.0})
        expected = IngestConfig(field_of_view_deg=110.0, width=80, size="central")
        assert lens_settings(wide) == expected
        assert lens_settings(narrow.model_copy(update={"lens": "native"})).lens == "native"

    def test_what_contradicts_is_refused_before_the_estimate(
        self, store: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked: list[EndoscopicSequence] = []
        monkeypatch.setattr("extrags.poses.estimate_poses", lambda sequence, _: asked.append(sequence))
        both = IngestConfig(lens="native", field_of_view_deg=100)
        with pytest.raises(ConfigError, match=r"leave ingest\.field_of_view_deg out"):
            poses.fn(store=store, sequence=guessed_room.fn(store=store), config=PosesConfig(), ingest=both)
        assert asked == []


def test_refined_poses_are_kept_and_held_out_frames_go_along(store: str, posed: Ref, training: Ref) -> None:
    config = CoarseConfig(iterations=40, max_points=300, refine_poses=True)
    done = coarse.fn(store=store, sequence=training, config=config)
    counts = Store(store).manifest(done).counts
    assert counts["refined_poses"] == 1
    assert isinstance(counts["refined_mean_shift"], float)
    assert counts["refined_mean_shift"] > 0
    whole = refined_frames.fn(store=store, sequence=posed, coarse=done)
    assert Store(store).manifest(whole).counts["test"] == 1
    before = read(store, training)
    after = read(store, training_frames.fn(store=store, sequence=whole))
    assert after.pose_source == "refined"
    assert before.world_from_camera is not None
    assert after.world_from_camera is not None
    shift = np.linalg.norm((after.world_from_camera - before.world_from_camera)[:, :3, 3], axis=1)
    assert shift.mean() == pytest.approx(counts["refined_mean_shift"])
    np.testing.assert_array_equal(after.rgb, before.rgb)
    held_out, kept = read(store, whole), read(store, posed)
    assert held_out.world_from_camera is not None
    assert kept.world_from_camera is not None
    moved = np.linalg.norm((held_out.world_from_camera - kept.world_from_camera)[kept.test, :3, 3], axis=1)
    assert 0 < moved.max() < shift.max()


def test_frames_whose_colors_were_corrected_are_kept(
    store: str, posed: Ref, training: Ref, monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstruct = extrags.training.reconstruct
    count = len(read(store, training))
    colors = FrameColors(np.full(count, 0.2), np.zeros((count, 3)))
    monkeypatch.setattr(
        "extrags.training.reconstruct",
        lambda *given, **named: replace(reconstruct(*given, **named), colors=colors),
    )
    done = coarse.fn(store=store, sequence=training, config=CoarseConfig(iterations=2, max_points=50))
    assert Store(store).manifest(done).counts["corrected_colors"] == 1
    whole = refined_frames.fn(store=store, sequence=posed, coarse=done)
    before, after = read(store, posed), read(store, whole)
    assert after.pose_source == before.pose_source
    changed = [bool((a != b).any()) for a, b in zip(after.rgb, before.rgb, strict=True)]
    assert np.flatnonzero(changed).tolist() == before.train.tolist()


def test_given_poses_are_left_alone(store: str) -> None:
    trusted = training_frames.fn(store=store, sequence=room.fn(store=store))
    done = coarse.fn(store=store, sequence=trusted, config=CoarseConfig(iterations=5, max_points=300))
    assert Store(store).manifest(done).counts["refined_poses"] == 0
    assert not group_exists(Store(store).open(done) / "sequence")


def test_where_poses_come_from_is_kept_on_disk(tmp_path: Path) -> None:
    sequence = room_sequence(4, width=40, height=30)
    sequence.save(tmp_path / "given")
    assert EndoscopicSequence.load(tmp_path / "given").pose_source == "given"
    assert b"pose_source" not in (tmp_path / "given.zarr.zip").read_bytes()
    replace(sequence, pose_source="refined").save(tmp_path / "refined")
    assert EndoscopicSequence.load(tmp_path / "refined").pose_source == "refined"
    assert EndoscopicSequence.load(tmp_path / "refined").training_part().pose_source == "refined"


def test_where_intrinsics_come_from_is_kept_on_disk(tmp_path: Path) -> None:
    sequence = room_sequence(4, width=40, height=30)
    sequence.save(tmp_path / "given")
    written = (tmp_path / "given.zarr.zip").read_bytes()
    # Older artefacts keep their digest.
    assert b"intrinsics" not in written
    assert b"focal_std_px" not in written
    assert EndoscopicSequence.load(tmp_path / "given").intrinsics == "given"
    replace(sequence, intrinsics="estimated", focal_std_px=1.5).save(tmp_path / "estimated")
    loaded = EndoscopicSequence.load(tmp_path / "estimated")
    assert (loaded.intrinsics, loaded.focal_std_px) == ("estimated", 1.5)
    assert loaded.training_part().intrinsics == "estimated"
    assert loaded.at_most_width(20).focal_std_px == 0.75
