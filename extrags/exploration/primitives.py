"""The fourteen moves of a virtual camera, each a rigid motion in the camera's own frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from extrags.cameras import compose, rotation_about
from extrags.errors import ConfigError

__all__ = ["PRIMITIVES", "apply_primitives", "orthonormalised", "primitive_motions"]

PRIMITIVES: tuple[str, ...] = (
    "move_right",
    "move_left",
    "move_down",
    "move_up",
    "move_forward",
    "move_back",
    "turn_right",
    "turn_left",
    "turn_up",
    "turn_down",
    "orbit_right",
    "orbit_left",
    "orbit_up",
    "orbit_down",
)
"""Six translations, four rotations about the camera's centre, four about the look-at point."""


def primitive_motions(
    step_mm: float, rotation_deg: float, orbit_deg: float, look_at_mm: float
) -> Float[np.ndarray, "14 4 4"]:
    """`camera_from_moved_camera` of every primitive, in the order of `PRIMITIVES`.

    Right-multiplying `world_from_camera` by one of them moves the camera; only rotations and
    translations are composed, so a pose stays in SE(3) however many moves follow each other.
    An orbit turns the camera about the point `look_at_mm` in front of it: the point keeps its place in
    the image. "orbit_right" carries the camera to its right.

    Args:
        step_mm: length of a translation, in world units.
        rotation_deg: angle of a turn.
        orbit_deg: angle of an orbit.
        look_at_mm: z-depth of the look-at point, in world units.

    Raises:
        ConfigError: for lengths that are not positive and finite.
    """
    for name, value in (("step", step_mm), ("look-at distance", look_at_mm)):
        if not (np.isfinite(value) and value > 0):
            raise ConfigError(f"the {name} of the motion primitives must be positive, found {value}")
    right, down, forward = np.eye(3)
    motions = [
        compose(np.eye(3), sign * step_mm * axis) for axis in (right, down, forward) for sign in (1, -1)
    ]
    # About the y axis (down) a positive angle turns the view to the right, about x upwards.
    turn, orbit = np.radians(rotation_deg), np.radians(orbit_deg)
    motions += [
        compose(rotation_about(axis, sign * turn), np.zeros(3)) for axis in (down, right) for sign in (1, -1)
    ]
    target = look_at_mm * forward
    # Going right round the target means turning left, going up means turning down.
    for axis in (down, right):
        for sign in (-1, 1):
            rotation = rotation_about(axis, sign * orbit)
            motions.append(compose(rotation, target - rotation @ target))
    return np.stack(motions)


def apply_primitives(
    world_from_camera: Float[np.ndarray, "4 4"], motions: Float[np.ndarray, "a 4 4"]
) -> Float[np.ndarray, "a 4 4"]:
    """The candidate poses of one expansion, rounding errors of the rotation removed."""
    moved = np.asarray(world_from_camera @ motions)
    moved[:, :3, :3] = orthonormalised(moved[:, :3, :3])
    return moved


def orthonormalised(rotation: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """The nearest rotations to matrices that are rotations up to rounding."""
    u, _, vt = np.linalg.svd(rotation)
    return np.asarray(u @ vt)
