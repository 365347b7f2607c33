"""A recording that looks everywhere: the settings `covered` and `pocket` of the phantom.

One examination passes the colon six times: ahead, ahead on the far side, twice turned to the walls, and twice
looking back. As in recording B every tenth video frame trains. Held-out frames lie half-way between two that
train, spread over all passes.

`covered` trains on all of them: what a held-out frame shows, several others show from both sides. `pocket`
leaves out those that show much of one patch of the wall, in the middle of the colon, so that the patch is
known from far or at a grazing angle; held-out frames stay the same. Measured over scenes 11 to 13:

====================================  =====================  ======================
..                                    covered                pocket
====================================  =====================  ======================
frames that train, and evaluate       120, 28                79 to 87, 28
distance to nearest camera, median    1.7 to 2.0 mm          1.9 to 2.3 mm
angle to that camera's axis, median   6 to 7 deg             8 to 16 deg
pixels on unseen surface, mean        0.01 to 0.03 %         3.6 to 6.3 %
the same, worst frame                 0.2 to 0.9 %           31 to 57 %
====================================  =====================  ======================
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.geometry import Wall
from data_catalog.phantom.trajectories import DISTANCED, TRAINING, PathStyle, styled_path
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, pixel_rays
from extrags.errors import ConfigError

__all__ = ["PASSES", "Plan", "examination", "sees_pocket"]

_SIDEWAYS = replace(DISTANCED, offset_mm=3.0, turn_deg=85.0)
_BACK = replace(DISTANCED, offset_mm=3.0, turn_deg=135.0)

PASSES: tuple[tuple[str, PathStyle, int], ...] = (
    ("b", TRAINING, 1),
    ("c", DISTANCED, 2),
    ("d", replace(_SIDEWAYS, side_rad=1.0), 3),
    ("e", replace(_SIDEWAYS, side_rad=-2.0), 4),
    ("f", replace(_BACK, side_rad=4.0), 5),
    ("g", replace(_BACK, side_rad=2.0, offset_mm=4.0, turn_deg=165.0, turn_swing_deg=8.0), 6),
)
"""Letter in frame names, style, and number of the random stream of each pass."""

POCKET_ARC_MM = 50.0
"""Where along the colon's axis the pocket is."""
POCKET_RADIUS_MM = 14.0
POCKET_SHARE = 0.05
"""A frame that has more than this share of its pixels on the pocket is left out."""


@dataclass(frozen=True)
class Plan:
    """Which frames an examination has.

    Args:
        passed: of each frame, its position in `PASSES`, [N].
        number: of each frame, its number in the video of its pass; those held out lie half-way, [N].
        trains: whether it trains, [N].
    """

    passed: Int[np.ndarray, "n"]
    number: Int[np.ndarray, "n"]
    trains: Bool[np.ndarray, "n"]


def examination(config: PhantomConfig) -> Plan:
    """The frames of a thorough examination in the order of time.

    Raises:
        ConfigError: when no frame lies between two that train.
    """
    if not 2 <= config.train_every < config.video_frames:
        raise ConfigError(
            f"the setting {config.setting} holds out frames that lie between two that train; there are none "
            f"with train_every={config.train_every} and video_frames={config.video_frames}"
        )
    video = np.arange(0, config.video_frames, config.train_every)
    passed = np.repeat(np.arange(len(PASSES)), len(video))
    number = np.tile(video, len(PASSES))
    gaps = np.flatnonzero(np.diff(number) > 0)
    held_out = gaps[np.round(np.linspace(0, len(gaps) - 1, min(config.test_frames, len(gaps)))).astype(int)]
    passed = np.concatenate([passed, passed[held_out]])
    trains = np.repeat([True, False], [len(number), len(held_out)])
    number = np.concatenate([number, number[held_out] + config.train_every // 2])
    order = np.lexsort((number, passed))
    return Plan(passed[order], number[order], trains[order])


def poses(config: PhantomConfig, wall: Wall, rays: RayCaster, plan: Plan) -> Float[np.ndarray, "n 4 4"]:
    """`world_from_camera` of the frames of an examination, [N, 4, 4]."""
    found = np.empty((len(plan.passed), 4, 4))
    last = max(config.video_frames - 1, 1)
    for index, (_, style, stream) in enumerate(PASSES):
        own = plan.passed == index
        if own.any():
            found[own] = styled_path(config, wall, rays, style, stream, plan.number[own] / last)
    return found


def sees_pocket(wall: Wall, cameras: Cameras, depth_mm: Float[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Frames that show more than `POCKET_SHARE` of the pocket in their pixels.

    Args:
        wall: the anatomy; the pocket is the patch within `POCKET_RADIUS_MM` of one of its points.
        cameras: of the frames.
        depth_mm: exact z-depth of the frames; zero or infinite where there is none.
    """
    row = int(np.argmin(np.abs(wall.u_mm - POCKET_ARC_MM)))
    middle = wall.points[row, 0]
    rays = pixel_rays(cameras)
    points = cameras.centers[:, None, None] + rays * np.where(np.isfinite(depth_mm), depth_mm, 0)[..., None]
    near = np.linalg.norm(points - middle, axis=-1) < POCKET_RADIUS_MM
    return np.asarray((near & (depth_mm > 0)).mean(axis=(1, 2)) > POCKET_SHARE)
