"""Poses, depth and intrinsics that contradict each other: what is blamed, and which mistake is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_catalog import checks
from data_catalog.catalog import read
from data_catalog.checks import check_sequence, depth_disagreement
from data_catalog.diagnostics import diagnose
from data_catalog.pose_conventions import other_readings
from extrags.cameras import invert_poses
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError
from extrags.sequence import EndoscopicSequence

OPEN_GL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def phantom() -> EndoscopicSequence:
    return read("phantom/0@sparse", IngestConfig(width=80, height=64, max_frames=16))


@pytest.fixture(scope="module")
def narrow(shared_data: Path) -> EndoscopicSequence:
    """Cameras that move little, so that depth fits several readings of the axes."""
    return read(shared_data / "simcol3d_s1", IngestConfig(width=160))


def topics(sequence: EndoscopicSequence) -> dict[str, str]:
    return {finding.topic: finding.sentence for finding in diagnose(sequence, "somewhere")}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("world-to-camera (inverted), OpenCV axes", invert_poses),
        ("OpenGL axes", lambda poses: poses @ OPEN_GL),
        ("world-to-camera (inverted), OpenGL axes", lambda poses: invert_poses(poses @ OPEN_GL)),
    ],
)
def test_a_usual_mistake_is_named_where_another_reading_fits_better_by_chance(
    narrow: EndoscopicSequence, name: str, wrong
) -> None:
    mistaken = replace(narrow, world_from_camera=wrong(narrow.world_from_camera))
    with pytest.raises(PoseError) as caught:
        check_sequence(mistaken)
    assert f"are read as {name}" in str(caught.value)


def test_poses_of_other_frames_are_found_with_depth_too(phantom: EndoscopicSequence) -> None:
    assert not topics(phantom).keys() & {"poses", "depth and poses"}
    assert depth_disagreement(phantom) == pytest.approx(0, abs=0.02)
    # Within each recording: as by names that were sorted as text.
    order = np.concatenate([members[::-1] for members in (phantom.train, phantom.test)])
    wrong = replace(phantom, world_from_camera=phantom.world_from_camera[order])
    check_sequence(wrong)
    assert "may not be in the same order" in topics(wrong)["depth and poses"]


@pytest.mark.parametrize(
    "spoil",
    [lambda depth: depth[:, ::-1], lambda depth: np.where(depth > 0, 400 / np.maximum(depth, 1), 0)],
    ids=["upside down", "inverse"],
)
def test_depth_that_no_axes_and_no_unit_explain_is_reported(phantom: EndoscopicSequence, spoil) -> None:
    wrong = replace(phantom, depth_mm=np.ascontiguousarray(spoil(phantom.depth_mm), dtype=np.float32))
    assert "depth may be inverse, of other pixels" in topics(wrong)["depth and poses"]


def test_intrinsics_of_another_size_are_blamed_before_poses(phantom: EndoscopicSequence) -> None:
    doubled = phantom.K.copy()
    doubled[:, :2] *= 2
    with pytest.raises(SourceError, match=r"K belongs to another size. Divide its first two rows by 2 \("):
        check_sequence(replace(phantom, K=doubled))


def test_little_parallax_beside_depth_asks_for_the_unit(phantom: EndoscopicSequence) -> None:
    poses = phantom.world_from_camera.copy()
    poses[:, :3, 3] /= 1000
    sentence = topics(replace(phantom, world_from_camera=poses))["parallax"]
    assert "look whether poses and depth have the same unit" in sentence
    bare = replace(phantom, world_from_camera=poses, depth_mm=None, points=phantom_points(phantom))
    assert "or give depth" in topics(bare)["parallax"]


def phantom_points(phantom: EndoscopicSequence) -> np.ndarray:
    """A cloud before the cameras, at the distance of the wall."""
    ahead = phantom.world_from_camera[phantom.train, :3, 3].mean(axis=0)
    axis = phantom.world_from_camera[phantom.train, :3, 2].mean(axis=0)
    spread = np.random.default_rng(0).normal(0, 2, (60, 3))
    return (ahead + 20 * axis + spread).astype(np.float32)


def test_pixels_that_are_told_to_be_wide_are_no_fault_of_a_guess(phantom: EndoscopicSequence) -> None:
    wide = phantom.K.copy()
    wide[:, 0, 0] *= 0.7
    given = replace(phantom, K=wide, world_from_camera=None, depth_mm=None, observed=None)
    assert "Was the image squeezed?" in topics(given)["intrinsics"]
    assert "intrinsics" not in topics(replace(given, intrinsics="guessed"))


def test_all_duplicates_are_counted(phantom: EndoscopicSequence) -> None:
    rgb = phantom.rgb.copy()
    rgb[[2, 3, 5]] = rgb[[1, 1, 4]]
    assert (
        "3 frames repeat an earlier one: remove them" in topics(replace(phantom, rgb=rgb))["duplicate frame"]
    )


def test_the_beginning_of_another_series_is_no_missing_frame(phantom: EndoscopicSequence) -> None:
    names = tuple(f"{side}_{k:03d}" for side in ("left", "right") for k in range(len(phantom) // 2))
    found = topics(replace(phantom, recording=None, frame_names=names))
    assert "missing frame" not in found
    assert "Give each series, as of a left and a right camera" in found["series of frames"]
    gap = tuple(f"frame_{k + (k > 7):03d}" for k in range(len(phantom)))
    assert "missing frame" in topics(replace(phantom, recording=None, frame_names=gap))


@pytest.mark.parametrize("at_most", [0.0, 0.02, 0.3, 1.0])
def test_what_cannot_be_within_a_bound_is_left_early(phantom: EndoscopicSequence, at_most: float) -> None:
    """No reading that is within it is lost, nor changed."""
    pairs = checks.neighbouring_frames(phantom)
    readings = [phantom.world_from_camera, *(poses for _, poses in other_readings(phantom.world_from_camera))]
    full = np.array([checks._reprojection_error(phantom, poses, pairs) for poses in readings])
    found = np.array(
        [checks._reprojection_error(phantom, poses, pairs, at_most=at_most) for poses in readings]
    )
    np.testing.assert_array_equal(found, np.where(full <= at_most, full, np.inf))
    assert (full <= at_most).any() == (at_most > 0)
