"""Camera paths of the phantom's recordings.

Recording B (it trains) advances along the tube a little off its axis and looks ahead, swaying. Recording A
(it evaluates) passes the same stretch again: in the setting `sparse` off the axis on another side and turned
moderately; in `distanced` on the far side of the lumen and turned towards the walls.

Measured over scenes 0 to 7 (median over scenes, range in brackets), evaluation against training frames:

====================================  =====================  =====================
..                                    sparse                 distanced
====================================  =====================  =====================
distance to nearest camera, median    7.4 mm (6.9 to 7.7)    9.1 mm (8.5 to 9.9)
the same, largest                     10.1 mm (9.2 to 11.8)  11.8 mm (10.3 to 13.5)
angle to that camera's axis, median   28 deg (25 to 34)      50 deg (41 to 58)
the same, largest                     43 deg (39 to 54)      76 deg (71 to 82)
pixels on unseen surface, mean        8.8 % (5.0 to 12.7)    22 % (21 to 26)
the same, worst frame                 41 % (27 to 50)        71 % (59 to 78)
clearance of the lens, smallest       6.0 mm                 6.1 mm
====================================  =====================  =====================
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_catalog.phantom.config import PhantomConfig, PhantomSetting, stream
from data_catalog.phantom.geometry import Wall
from data_catalog.ray_casting import RayCaster
from extrags.cameras import compose, look_at, rotation_about
from extrags.errors import ConfigError

__all__ = [
    "DISTANCED",
    "MIN_CLEARANCE_MM",
    "TRAINING",
    "PathStyle",
    "camera_path",
    "path_style",
    "styled_path",
]

MIN_CLEARANCE_MM = 5.5
"""The lens keeps this distance from the wall; checked against the wall's triangles."""
_DENSE = 201


@dataclass(frozen=True)
class PathStyle:
    """Parameters in which recordings differ."""

    start_mm: float
    end_mm: float
    side_rad: float
    """Side of the lumen, relative to the scene's own reference direction."""
    offset_mm: float
    sway_mm: float
    look_ahead_mm: float
    turn_deg: float
    """Mean angle between the view and the way ahead; its direction goes round slowly."""
    turn_swing_deg: float
    roll_deg: float


TRAINING = PathStyle(
    start_mm=12.0,
    end_mm=88.0,
    side_rad=0.0,
    offset_mm=4.0,
    sway_mm=1.2,
    look_ahead_mm=24.0,
    turn_deg=6.0,
    turn_swing_deg=5.0,
    roll_deg=6.0,
)
_SPARSE = PathStyle(
    start_mm=12.0,
    end_mm=86.0,
    side_rad=2.1,
    offset_mm=4.5,
    sway_mm=1.5,
    look_ahead_mm=22.0,
    turn_deg=23.0,
    turn_swing_deg=7.0,
    roll_deg=15.0,
)
DISTANCED = PathStyle(
    start_mm=10.0,
    end_mm=90.0,
    side_rad=float(np.pi),
    offset_mm=6.0,
    sway_mm=1.5,
    look_ahead_mm=18.0,
    turn_deg=50.0,
    turn_swing_deg=12.0,
    roll_deg=30.0,
)
_EVALUATION: dict[str, PathStyle] = {"sparse": _SPARSE, "distanced": DISTANCED}


def path_style(recording: str, setting: PhantomSetting) -> PathStyle:
    """The style of recording `a` (evaluates) or `b` (trains, the same in both settings).

    Raises:
        ConfigError: for recording `a` in a setting that has one recording only.
    """
    if recording == "b":
        return TRAINING
    if setting not in _EVALUATION:
        raise ConfigError(f"the setting {setting} has no recording {recording}")
    return _EVALUATION[setting]


def camera_path(
    config: PhantomConfig, wall: Wall, rays: RayCaster, recording: str, share: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Poses of a recording at shares of its duration.

    Args:
        config: the scene and setting.
        wall: its anatomy.
        rays: the wall as a target, for the clearance.
        recording: `a` or `b`.
        share: 0 at the start, 1 at the end, [N].

    Returns:
        `world_from_camera`, [N, 4, 4].
    """
    style = path_style(recording, config.setting)
    # Of the random stream: 0 for `a` in the setting sparse, 1 for `b`, 2 for `a` in distanced.
    index = 1 if recording == "b" else 2 * list(_EVALUATION).index(config.setting)
    return styled_path(config, wall, rays, style, index, share)


def styled_path(
    config: PhantomConfig,
    wall: Wall,
    rays: RayCaster,
    style: PathStyle,
    index: int,
    share: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n 4 4"]:
    """Poses of a path of any style at shares of its duration.

    Args:
        config: the scene.
        wall: its anatomy.
        rays: the wall as a target, for the clearance.
        style: of the path.
        index: of its random stream.
        share: 0 at the start, 1 at the end, [N].

    Returns:
        `world_from_camera`, [N, 4, 4].
    """
    # The reference direction belongs to the scene, the sway to the recording.
    reference = stream(config.scene, "trajectory").uniform(0, 2 * np.pi)
    phases = stream(config.scene, "trajectory", index).uniform(0, 2 * np.pi, 10)

    dense = np.linspace(0, 1, _DENSE)
    arc = _arc(style, dense, phases)
    offset = _offset(style, dense, phases, reference)
    keep = _clear_share(wall, rays, arc, offset)

    arc = _arc(style, share, phases)
    offset = _offset(style, share, phases, reference) * np.interp(share, dense, keep)[:, None]
    centers = _positions(wall, arc, offset)
    targets = wall.center_line.point(arc + style.look_ahead_mm) + 0.3 * (
        centers - wall.center_line.point(arc)
    )
    frames = wall.center_line.frame(arc)
    turn = np.radians(style.turn_deg + style.turn_swing_deg * np.sin(2 * np.pi * 2.3 * share + phases[6]))
    heading = phases[7] + 2 * np.pi * 1.15 * share + 0.5 * np.sin(2 * np.pi * 1.7 * share + phases[8])
    roll = np.radians(style.roll_deg) * np.sin(2 * np.pi * 0.9 * share + phases[9])
    poses = np.empty((share.size, 4, 4))
    for k in range(share.size):
        ahead = look_at(centers[k], targets[k], -frames[k, :, 1])
        across = np.array([np.cos(heading[k]), np.sin(heading[k]), 0.0])
        local = rotation_about(across, turn[k]) @ rotation_about(np.array([0.0, 0.0, 1.0]), roll[k])
        poses[k] = compose(ahead[:3, :3] @ local, centers[k])
    return poses


def _arc(
    style: PathStyle, share: Float[np.ndarray, "n"], phases: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "n"]:
    # Hands do not push evenly; the amplitude keeps the speed positive.
    uneven = 0.022 * np.sin(2 * np.pi * 3.1 * share + phases[0]) - 0.022 * np.sin(phases[0])
    return np.asarray(style.start_mm + (style.end_mm - style.start_mm) * np.clip(share + uneven, -0.05, 1.05))


def _offset(
    style: PathStyle, share: Float[np.ndarray, "n"], phases: Float[np.ndarray, "p"], reference: float
) -> Float[np.ndarray, "n 2"]:
    """Offset from the axis in the frame across the tube."""
    side = reference + style.side_rad + 0.35 * np.sin(2 * np.pi * 0.8 * share + phases[1])
    length = style.offset_mm * (1 + 0.15 * np.sin(2 * np.pi * 1.4 * share + phases[2]))
    x = length * np.cos(side) + style.sway_mm * np.sin(2 * np.pi * 2.7 * share + phases[3])
    y = length * np.sin(side) + style.sway_mm * np.sin(2 * np.pi * 2.1 * share + phases[4])
    return np.stack([x, y], axis=1)


def _positions(
    wall: Wall, arc: Float[np.ndarray, "n"], offset: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    frame = wall.center_line.frame(arc)
    across = np.einsum("nij,nj->ni", frame[:, :, :2], offset)
    return np.asarray(wall.center_line.point(arc) + across)


def _clear_share(
    wall: Wall, rays: RayCaster, arc: Float[np.ndarray, "n"], offset: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Share of the wanted offset that keeps the lens clear of the wall, smooth along the path."""
    candidates = np.linspace(1, 0, 11)
    positions = np.concatenate([_positions(wall, arc, c * offset) for c in candidates])
    distance = rays.clearance_mm(positions).reshape(len(candidates), -1)
    # A little more than asked for, since the smoothed share is not the one that was tested.
    clear = distance >= MIN_CLEARANCE_MM + 0.5
    allowed = np.where(clear.any(axis=0), candidates[np.argmax(clear, axis=0)], 0.0)
    reach = 6
    padded = np.pad(allowed, 2 * reach, mode="edge")
    lowest = np.array([padded[k : k + 2 * reach + 1].min() for k in range(padded.size - 2 * reach)])
    window = np.hanning(2 * reach + 3)[1:-1]
    return np.convolve(lowest, window / window.sum(), mode="valid")
