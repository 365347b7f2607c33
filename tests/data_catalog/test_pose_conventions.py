"""Other readings of poses, and what they are called in the words of a file."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog.pose_conventions import LLFF, OPENCV, OPENGL, PoseConvention, other_readings
from extrags.cameras import invert_poses, look_at

OPEN_GL = np.diag([1.0, -1.0, -1.0, 1.0])
DOWN_RIGHT_BACKWARD = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def test_readings_begin_with_the_mistakes_that_people_make() -> None:
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = 1, 2, 3
    names, read_as = zip(*other_readings(pose), strict=True)
    assert len(set(names)) == 47
    assert [name.split(" (y up")[0] for name in names[:3]] == [
        "world-to-camera (inverted), OpenCV axes",
        "OpenGL axes",
        "world-to-camera (inverted), OpenGL axes",
    ]
    np.testing.assert_allclose(read_as[0], invert_poses(pose))
    np.testing.assert_allclose(read_as[1], pose @ OPEN_GL)
    np.testing.assert_allclose(read_as[2], invert_poses(pose) @ OPEN_GL)
    assert not any(np.allclose(reading, pose) for reading in read_as)


def test_axes_are_named_by_where_they_come_from() -> None:
    """Of names such as `axes (y, -x, z)` each letter is an axis of the file that becomes x, y or z."""
    pose = look_at(np.array([3.0, 1, 2]), np.zeros(3), up=np.array([0.0, 1, 0]))[None]
    columns = {letter: np.eye(3)[:, [k]] for k, letter in enumerate("xyz")}
    columns |= {f"-{letter}": -column for letter, column in columns.items()}
    told = 0
    for name, found in other_readings(pose):
        if "OpenCV axes" in name or "OpenGL axes" in name:
            continue
        ways, letters = name.split("axes (")
        turn = np.eye(4)
        turn[:3, :3] = np.hstack([columns[letter] for letter in letters.rstrip(")").split(", ")])
        np.testing.assert_allclose(found, (invert_poses(pose) if "inverted" in ways else pose) @ turn)
        told += 1
    # All but OpenCV's and OpenGL's, which have names, both ways.
    assert told == 2 * (24 - 2)


@pytest.mark.parametrize(
    ("stored", "into_opencv"),
    [
        (OPENCV, lambda matrices: matrices),
        (OPENGL, lambda matrices: matrices @ OPEN_GL),
        (LLFF, lambda matrices: matrices @ DOWN_RIGHT_BACKWARD),
        (PoseConvention(world_to_camera=True), invert_poses),
    ],
)
@pytest.mark.parametrize(("axes", "turn"), [("OpenCV", np.eye(4)), ("OpenGL", OPEN_GL)])
@pytest.mark.parametrize("inverse", [False, True])
def test_readings_are_named_in_the_words_of_the_file(stored, into_opencv, axes, turn, inverse) -> None:
    """A transforms.json in OpenCV's axes was told to be in OpenGL's, and to need OpenCV's."""
    up = np.array([0.0, 1, 0])
    true = np.stack([look_at(np.array([x, 1.0, 2.0]), np.zeros(3), up=up) for x in (3, 4)])
    held = invert_poses(true @ turn) if inverse else true @ turn
    motion = invert_poses(true[:1]) @ true[1:]
    named = [
        name
        for name, found in other_readings(into_opencv(held), stored)
        if np.allclose(invert_poses(found[:1]) @ found[1:], motion)
    ]
    if (axes, inverse) == (stored.axes, stored.world_to_camera):
        assert named == []
        return
    assert len(named) == 1
    assert f"{axes} axes" in named[0]
    other_way = "camera-to-world (not inverted)" if stored.world_to_camera else "world-to-camera (inverted)"
    assert (other_way in named[0]) == (inverse != stored.world_to_camera)
