"""Errors of estimated poses against a source's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from extrags.poses import errors_against_given
from extrags.poses.registration_report import NAMED_FRAMES, named_frames, parallax_warning
from extrags.sequence import EndoscopicSequence, Split

FRAMES = 8


def straight_ahead() -> EndoscopicSequence:
    """Cameras along their axis, looking that way."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 2, 3] = np.arange(FRAMES)
    return EndoscopicSequence(
        "test/straight",
        np.zeros((FRAMES, 6, 8, 3), np.uint8),
        np.tile(np.array([[8.0, 0, 4], [0, 8.0, 3], [0, 0, 1]]), (FRAMES, 1, 1)),
        np.ones((FRAMES, 6, 8), bool),
        Split("test", np.arange(6), np.arange(6, FRAMES)),
        world_from_camera=poses,
    )


@pytest.mark.parametrize("metric", [True, False])
def test_the_turn_about_a_straight_path_is_told_apart(metric: bool) -> None:
    given = straight_ahead()
    found = given.cameras.world_from_camera.copy()
    # Positions do not tell the turn about the path; single frames are off by two degrees, to either side.
    for frame in range(FRAMES):
        own = Rotation.from_euler("x", 2 * (-1) ** frame, degrees=True)
        found[frame, :3, :3] = (Rotation.from_euler("z", 30, degrees=True) * own).as_matrix()
    # A little aside, the same way: what rounding makes of a straight line is any turn.
    found[3, 0, 3] += 1e-3
    moved = given.cameras.world_from_camera.copy()
    moved[3, 0, 3] += 1e-3
    errors = errors_against_given(given.with_poses(moved), found, metric=metric)
    for kind in ("train", "test"):
        assert errors[kind]["rotation_mean_deg"] == pytest.approx(30, abs=0.5)
        assert errors[kind]["rotation_without_common_turn_mean_deg"] == pytest.approx(2, abs=0.1)


def test_what_all_frames_have_in_common_is_no_error_but_by_itself() -> None:
    given = straight_ahead()
    around = given.cameras.world_from_camera.copy()
    around[:, 0, 3] = np.sin(np.arange(FRAMES))
    around[:, 1, 3] = np.cos(2 * np.arange(FRAMES))
    given = replace(given, world_from_camera=around)
    found = around.copy()
    found[:, :3, :3] = found[:, :3, :3] @ Rotation.from_euler("y", 5, degrees=True).as_matrix()
    errors = errors_against_given(given, found, metric=True)["train"]
    assert errors["rotation_mean_deg"] == pytest.approx(5)
    assert errors["rotation_without_common_turn_mean_deg"] == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(("angle", "warned"), [(0.0, False), (0.93, True), (1.9, True), (7.0, False)])
def test_a_map_without_parallax_is_told(angle: float, warned: bool) -> None:
    """A scope that turned on the spot, with a lens that nobody stated, got poses without a word: 0.93."""
    told = parallax_warning({"triangulation_angle_deg": angle})
    assert (told is not None) == warned
    if told is not None:
        assert f"differ by {angle:.1f} degrees (median), where 2 or more tell its distance" in told


class TestNamedFrames:
    """A stretch of a long recording is missing as a rule; its place tells more than hundreds of names."""

    NAMES = tuple(f"{k:04d}" for k in range(800))

    def test_frames_that_follow_each_other_are_a_range(self) -> None:
        missing = [*self.NAMES[3:5], *self.NAMES[120:188], self.NAMES[300]]
        assert named_frames(missing, self.NAMES) == "0003, 0004, 0120 to 0187, 0300"

    def test_neighbours_are_those_of_their_own_kind(self) -> None:
        """Between training frames held-out ones have been left out."""
        training = [name for name in self.NAMES if int(name) % 8]
        assert named_frames(training[5:20], training) == "0006 to 0022"

    def test_many_are_counted(self) -> None:
        scattered = self.NAMES[::4]
        said = named_frames(scattered, self.NAMES)
        assert said.count(", ") == NAMED_FRAMES - 1
        assert said.endswith(f"0044 and {len(scattered) - NAMED_FRAMES} more")

    def test_none(self) -> None:
        assert named_frames([], self.NAMES) == "none"
