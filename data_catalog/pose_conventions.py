"""How formats store poses, and what else poses may have been meant as, in the words of their file.

Sequences hold poses in OpenCV axes (x right, y down, z forward), camera to world, whatever their file holds.
A mistake in a file is told by what the file should hold, and by what it seems to hold: axes that look like
OpenGL's once a reader has turned OpenGL's into OpenCV's are OpenCV's in the file.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from extrags.cameras import invert_poses

__all__ = ["LLFF", "OPENCV", "OPENGL", "USUAL_MISTAKES", "PoseConvention", "other_readings"]

Axes = Literal["OpenCV", "OpenGL", "LLFF"]
"""Axes of cameras in files that are read here."""
USUAL_MISTAKES = 3
"""How many of `other_readings`, the first ones, are mistakes that people make."""
_EXPECTED: dict[Axes, str] = {
    "OpenCV": "OpenCV axes (x right, y down, z forward)",
    "OpenGL": "OpenGL axes (x right, y up, z backward)",
    "LLFF": "LLFF axes (down, right, backward)",
}
_FOUND: dict[Axes, str] = {
    "OpenCV": "OpenCV axes",
    "OpenGL": "OpenGL axes (y up, z backward: columns y and z negated)",
}
_OPENCV_IN: dict[Axes, Float[np.ndarray, "3 3"]] = {
    "OpenCV": np.eye(3),
    "OpenGL": np.diag([1.0, -1.0, -1.0]),
    "LLFF": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
}
"""OpenCV's x, y and z in other axes, as columns."""


@dataclass(frozen=True)
class PoseConvention:
    """Poses as a format stores them.

    Args:
        axes: of the cameras.
        world_to_camera: whether matrices map world to camera, and are inverted on reading.
    """

    axes: Axes = "OpenCV"
    world_to_camera: bool = False

    @property
    def expected(self) -> str:
        """What a file should hold, in words."""
        return f"{_EXPECTED[self.axes]}, {'world to camera' if self.world_to_camera else 'camera to world'}"

    def reading_name(self, axes: Float[np.ndarray, "3 3"], *, inverted: bool) -> str:
        """What a file holds whose poses are right once they are turned, and inverted before.

        Args:
            axes: columns are the right axes in those that the reader has made.
            inverted: whether the inverse of what the reader has made is right.
        """
        if not inverted:
            return _axes_in_words(_OPENCV_IN[self.axes] @ axes)
        # The reader's turn is one of the world then, which may lie as it likes.
        named = _axes_in_words(axes)
        if self.world_to_camera:
            return f"camera-to-world (not inverted), {named}"
        return f"world-to-camera (inverted), {named}"


OPENCV = PoseConvention()
OPENGL = PoseConvention("OpenGL")
LLFF = PoseConvention("LLFF")


def other_readings(
    poses: Float[np.ndarray, "f 4 4"], stored: PoseConvention = OPENCV
) -> Iterator[tuple[str, Float[np.ndarray, "f 4 4"]]]:
    """Poses as they may have been meant, each with the name of that reading; all but the given one.

    The usual mistakes come first: the inverse, OpenGL axes for OpenCV's or these for those, and both. Then
    all other rotations that map axes to axes, and their inverses.

    Args:
        poses: as a reader made them, camera to world in OpenCV axes.
        stored: as their file should hold them; readings are named accordingly.
    """
    open_gl, open_cv = np.diag([1.0, -1.0, -1.0]), np.eye(3)
    usual = [(open_cv, True), (open_gl, False), (open_gl, True)]
    others = [
        (axes, inverted)
        for axes in _axis_rotations()
        for inverted in (False, True)
        if not any(np.array_equal(axes, common) for common in (open_cv, open_gl))
    ]
    inverses = invert_poses(poses)
    for axes, inverted in [*usual, *others]:
        turn = np.eye(4)
        turn[:3, :3] = axes
        yield stored.reading_name(axes, inverted=inverted), (inverses if inverted else poses) @ turn


def _axis_rotations() -> list[Float[np.ndarray, "3 3"]]:
    """The 24 rotations that map axes to axes; OpenGL's flip of y and z is one of them."""
    readings = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[list(order), range(3)] = signs
            if np.linalg.det(matrix) > 0:
                readings.append(matrix)
    return readings


def _axes_in_words(axes: Float[np.ndarray, "3 3"]) -> str:
    """What a user calls axes."""
    for name, in_words in _FOUND.items():
        if np.array_equal(axes, _OPENCV_IN[name]):
            return in_words
    letters = "xyz"
    parts = []
    for k in range(3):
        source = int(np.argmax(np.abs(axes[:, k])))
        parts.append(("" if axes[source, k] > 0 else "-") + letters[source])
    return f"axes ({', '.join(parts)})"
