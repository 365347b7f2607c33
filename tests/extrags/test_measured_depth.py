"""What training frames tell of their measured depth, on a phantom whose depth is exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import extrags
from extrags.carried_depth import CarriedDepth
from extrags.measured_depth import MeasuredDepthError, as_given
from extrags.measured_depth import measured_depth_error as error_of
from extrags.measured_depth import with_depth_error as with_error
from extrags.sequence import EndoscopicSequence, Split
from extrags.training.reconstruction import refines_poses
from tests.extrags.depth.withheld import recorded

Change = Callable[[int, np.ndarray], np.ndarray]


def measured_depth_error(sequence: EndoscopicSequence) -> MeasuredDepthError | None:
    carried = CarriedDepth.of(sequence)
    return None if carried is None else error_of(carried)


def with_depth_error(
    sequence: EndoscopicSequence, error: float | Literal["auto"] = "auto"
) -> EndoscopicSequence:
    return with_error(sequence, CarriedDepth.of(sequence), error)


@pytest.fixture(scope="module")
def exact() -> EndoscopicSequence:
    return recorded(10, 96, 72)


def with_depth(sequence: EndoscopicSequence, changed: Change) -> EndoscopicSequence:
    assert sequence.depth_mm is not None
    depth = np.stack([changed(k, depth) for k, depth in enumerate(sequence.depth_mm)])
    return replace(sequence, depth_mm=depth.astype(np.float32))


def smoothly_wrong(share: float) -> Change:
    """Each frame by a smooth error of its own, of this standard deviation."""

    def changed(frame: int, depth: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(frame).normal(size=depth.shape)
        field = cv2.GaussianBlur(noise, (0, 0), 0.2 * depth.shape[1])
        return np.asarray(depth * np.exp(share * field / field.std()))

    return changed


def displaced(sequence: EndoscopicSequence, turn_deg: float, shift_mm: float) -> EndoscopicSequence:
    generator = np.random.default_rng(0)
    poses = sequence.cameras.world_from_camera.copy()
    for pose in poses:
        turn = Rotation.from_rotvec(np.radians(turn_deg) * generator.normal(size=3) / np.sqrt(3))
        pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
        pose[:3, 3] += shift_mm * generator.normal(size=3) / np.sqrt(3)
    return replace(sequence, world_from_camera=poses)


def test_exact_depth_is_taken_as_it_is(exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture) -> None:
    found = measured_depth_error(exact)
    assert found is not None
    assert found.error < 1e-3
    assert with_depth_error(exact) is exact
    assert exact.median_depth_error == 0
    assert not caplog.messages


@pytest.mark.parametrize("share", [0.03, 0.06])
def test_smooth_errors_are_found_and_measured(
    exact: EndoscopicSequence, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    given = with_depth(exact, smoothly_wrong(share))
    found = with_depth_error(given)
    assert found.depth_error is not None
    assert found.median_depth_error == pytest.approx(share, rel=0.35)
    np.testing.assert_array_equal(found.depth_mm, given.depth_mm)
    # The evaluation still compares with what was measured, and poses are not tried against such depth.
    np.testing.assert_array_equal(found.true_depth_mm, given.depth_mm)
    assert refines_poses(given.training_part(), extrags.PROFILES["balanced"].coarse)
    assert not refines_poses(found.training_part(), extrags.PROFILES["balanced"].coarse)
    assert "training frames disagree about their depth" in caplog.text
    assert "in its own way; depth is corrected" in caplog.text
    assert with_depth_error(found) is found
    undone = as_given(found)
    assert undone.depth_error is undone.withheld_depth_mm is None
    np.testing.assert_array_equal(undone.depth_mm, given.depth_mm)


def test_a_frame_that_is_farther_off_is_told_apart(exact: EndoscopicSequence) -> None:
    def one_much_worse(frame: int, depth: np.ndarray) -> np.ndarray:
        return smoothly_wrong(0.15 if frame == 4 else 0.02)(frame, depth)

    found = measured_depth_error(with_depth(exact, one_much_worse))
    assert found is not None
    assert found.of_frame.argmax() == 4
    assert found.of_frame[4] > 3 * np.median(found.of_frame)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_poses_that_are_off_are_no_error_of_depth(exact: EndoscopicSequence, factor: float) -> None:
    moved = displaced(exact, 0.5 * factor, 0.3 * factor)
    found = measured_depth_error(moved)
    assert found is not None
    assert found.beyond_motion < 0.2 * found.error
    assert with_depth_error(moved) is moved


def test_poses_that_may_be_grossly_wrong_are_told(
    exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    """Quaternions whose w was read as x went on as depth that is off by a fifth, without a word of poses."""
    poses = exact.cameras.world_from_camera.copy()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    poses[:, :3, :3] = Rotation.from_quat(quaternions[:, [3, 0, 1, 2]]).as_matrix()
    with_depth_error(replace(exact, world_from_camera=poses))
    assert "or as if poses were wrong (are frames and poses in the same order" in caplog.text
    assert "or depth inverse; depth is corrected" in caplog.text


def test_a_number_is_taken_for_it(exact: EndoscopicSequence) -> None:
    wrong = with_depth(exact, smoothly_wrong(0.06))
    assert with_depth_error(wrong, 0) is wrong
    found = with_depth_error(exact, 0.1)
    assert found.depth_error is not None
    assert np.unique(found.depth_error).tolist() == [np.float32(0.1)]


def test_nothing_is_told_without_other_frames(exact: EndoscopicSequence) -> None:
    wrong = with_depth(exact, smoothly_wrong(0.06))
    alone = replace(wrong, split=Split("one", np.array([0]), np.array([5])))
    for given in (alone, replace(wrong, world_from_camera=None), exact.without_training_depth()):
        assert measured_depth_error(given) is None
        assert with_depth_error(given) is given


def test_arrays_in_memory_are_judged_alike(exact: EndoscopicSequence) -> None:
    wrong = with_depth(exact, smoothly_wrong(0.06))
    found = extrags.sequence_from_arrays(
        exact.rgb, K=exact.K, world_from_camera=exact.world_from_camera, depth_mm=wrong.depth_mm
    )
    assert found.median_depth_error > 0.03
