"""Camera paths through a cavity: the recording that trains, and clips that leave it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from data_catalog.cavities.free_space import FreeSpace
from data_catalog.cavities.surface import unit
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, look_at, pixel_rays, rotation_about

__all__ = ["CLIP_VIEWS", "UNSEEN", "recording_poses", "target_clips", "unseen_share"]

CLIP_VIEWS = 5
UNSEEN = (0.10, 0.60)
"""Share of never-seen pixels, mean over a clip, that clips are chosen for."""
_TRIES = 14
_COARSE = (16, 12)
_NEAREST_CLIP = 0.5
"""What a clip looks at is farther than this times what the recording looks at."""
_NEAREST_SHARE = 1.8
"""What is in the middle of the picture is farther than this times the lens's margin."""


@dataclass(frozen=True)
class _Turns:
    """Slow random turns of a hand-held scope: sines of a few periods."""

    amplitude: float
    rates: Float[np.ndarray, "k"]
    phases: Float[np.ndarray, "k"]

    @classmethod
    def random(cls, rng: np.random.Generator, amplitude: float) -> _Turns:
        return cls(amplitude, rng.uniform(0.6, 3.0, 3), rng.uniform(0, 2 * np.pi, 3))

    def __call__(self, share: float) -> float:
        return float(self.amplitude * np.sin(2 * np.pi * self.rates * share + self.phases).sum() / 1.7)


def recording_poses(
    space: FreeSpace,
    rng: np.random.Generator,
    frames: int,
    *,
    tube: bool,
    facing: Float[np.ndarray, "3"] | None,
    radius_mm: float,
) -> Float[np.ndarray, "f 4 4"]:
    """Poses of a recording.

    Args:
        space: where the lens may be.
        rng: source of randomness.
        frames: how many.
        tube: whether to look along the way instead of about.
        facing: where to look on the whole, or None.
        radius_mm: typical distance to the wall; steps are a share of it.
    """
    way = space.way(rng, stops=2 if tube else int(rng.integers(3, 6)))
    step = rng.uniform(0.08, 0.4) * min(radius_mm, 30)
    length = min(len(way) - 1, max(4, int(step * (frames - 1))))
    begin = int(rng.integers(0, max(1, len(way) - length)))
    at = begin + np.linspace(0, length, frames)
    aside = [_Turns.random(rng, rng.uniform(0.0, 0.35)) for _ in range(3)]
    tilt = [_Turns.random(rng, np.radians(rng.uniform(3, 22 if tube else 40))) for _ in range(2)]
    roll = _Turns.random(rng, np.radians(rng.uniform(0, 20)))
    heading = unit(rng.standard_normal(3)).astype(np.float64) if facing is None else facing
    swing = unit(np.cross(heading, rng.standard_normal(3))).astype(np.float64)
    sweep = rng.uniform(0.3, 2.2) * rng.choice([-1, 1]) if facing is None else 0.0
    up = unit(rng.standard_normal(3)).astype(np.float64)
    ahead = rng.uniform(0.4, 1.2) * radius_mm
    poses = []
    for k in range(frames):
        share = k / max(frames - 1, 1)
        place = np.array([np.interp(at[k], np.arange(len(way)), way[:, axis]) for axis in range(3)])
        room = float(space.rays.clearance_mm(place[None].astype(np.float32))[0])
        offset = np.array([turn(share) for turn in aside]) * max(0.0, room - space.margin_mm)
        for factor in (1.0, 0.6, 0.3, 0.0):
            center = place + factor * offset
            if factor == 0.0 or bool(space.clear(center[None])[0]):
                break
        if tube:
            last = min(at[k] + ahead, len(way) - 1.0)
            target = np.array([np.interp(last, np.arange(len(way)), way[:, axis]) for axis in range(3)])
            back = np.array(
                [np.interp(max(at[k] - 3, 0), np.arange(len(way)), way[:, axis]) for axis in range(3)]
            )
            forward = target - center if np.linalg.norm(target - center) > 2 else target - back
        else:
            forward = heading * np.cos(sweep * share) + swing * np.sin(sweep * share)
        base = look_at(center, center + forward, up)
        base[:3, :3] = base[:3, :3] @ _turned(tilt[0](share), tilt[1](share), roll(share))
        poses.append(_open_view(base, space))
    return np.stack(poses)


def target_clips(
    space: FreeSpace, rng: np.random.Generator, train: Cameras, *, clips: int
) -> tuple[Float[np.ndarray, "t 4 4"], Int[np.ndarray, "t"]]:
    """Clips of consecutive views that leave the recording's path, and the clip of each view.

    Each is drawn until between a tenth and six tenths of its pixels show what no training frame sees; what
    comes nearest to that is taken when no draw does.

    Args:
        space: where the lens may be.
        rng: source of randomness.
        train: cameras of the recording.
        clips: how many.
    """
    usual = [
        np.median(space.rays.cast(train.centers[k], _middle_rays(pose)).distance)
        for k, pose in enumerate(train.world_from_camera)
    ]
    nearest = _NEAREST_CLIP * float(np.median(usual))
    poses, index = [], []
    for clip in range(clips):
        way = ("aside", "turned", "turned", "nearer", "back")[int(rng.integers(5))]
        severity, best, best_miss = 1.0, None, np.inf
        for _ in range(_TRIES):
            drawn = _clip(space, rng, train, way, severity, nearest)
            if drawn is None:
                severity *= 0.9
                continue
            unseen = float(unseen_share(space.rays, train, _like(train, drawn)).mean())
            miss = max(UNSEEN[0] - unseen, unseen - UNSEEN[1], 0.0)
            if miss < best_miss:
                best, best_miss = drawn, miss
            if miss == 0:
                break
            severity = float(np.clip(severity * (1.25 if unseen < UNSEEN[0] else 0.75), 0.15, 2.0))
        if best is None:
            # Nothing was clear of the wall: stay on the path and turn.
            base = train.world_from_camera[int(rng.integers(len(train)))]
            best = np.stack([base @ _pose(_turned(0.1 * k, 0.05 * k, 0.0)) for k in range(CLIP_VIEWS)])
        poses.append(best)
        index += [clip] * CLIP_VIEWS
    return np.concatenate(poses), np.array(index)


def unseen_share(rays: RayCaster, train: Cameras, views: Cameras) -> Float[np.ndarray, "v"]:
    """Share of each view's pixels, on a coarse grid, that show surface no training frame sees."""
    coarse = views.resized(*_COARSE)
    directions = pixel_rays(coarse)
    result = np.zeros(len(views))
    for k in range(len(views)):
        depth = rays.cast(coarse.centers[k], directions[k]).distance
        found = np.isfinite(depth)
        points = coarse.centers[k] + directions[k][found] * depth[found][:, None].astype(np.float64)
        result[k] = 1 - rays.seen_by(points, train).mean() if len(points) else 1.0
    return result


def _clip(
    space: FreeSpace, rng: np.random.Generator, train: Cameras, way: str, severity: float, nearest_mm: float
) -> Float[np.ndarray, "v 4 4"] | None:
    """Poses of a clip, or None when it would touch the wall or look into it."""
    base = train.world_from_camera[int(rng.integers(len(train)))]
    center, rotation = base[:3, 3], base[:3, :3]
    room = float(space.rays.clearance_mm(center[None].astype(np.float32))[0])
    across = np.array([np.cos(turn := rng.uniform(0, 2 * np.pi)), np.sin(turn), 0.0])
    angle, shift = 0.0, np.zeros(3)
    if way == "aside":
        shift = rotation @ across * room * rng.uniform(0.3, 1.2) * severity
        angle = np.radians(rng.uniform(5, 45)) * severity
    elif way == "turned":
        shift = rotation @ rng.standard_normal(3) * 0.25 * room
        angle = np.radians(min(rng.uniform(35, 100) * severity, 110))
    elif way == "nearer":
        angle = np.radians(rng.uniform(10, 70)) * severity
        view = rotation @ rotation_about(across, angle)
        depth = float(space.rays.cast(center, view[None, :, 2]).distance[0])
        if not np.isfinite(depth):
            return None
        shift = view[:, 2] * depth * rng.uniform(0.25, 0.7)
    else:
        shift = rotation @ np.array([0, 0, 1.0]) * room * rng.uniform(0.0, 1.5)
        angle = np.radians(rng.uniform(110, 180))
    spin = rotation_about(across, angle) @ rotation_about(np.array([0, 0, 1.0]), rng.uniform(-0.8, 0.8))
    pace = unit(rng.standard_normal(3)).astype(np.float64) * room * rng.uniform(0.02, 0.10)
    turn_axis = unit(rng.standard_normal(3)).astype(np.float64)
    turn_step = np.radians(rng.uniform(0.5, 6))
    poses = []
    for k in range(CLIP_VIEWS):
        pose = np.eye(4)
        pose[:3, :3] = rotation @ spin @ rotation_about(turn_axis, turn_step * (k - 2))
        pose[:3, 3] = center + shift + (k - 2) * pace
        poses.append(pose)
    found = np.stack(poses)
    margin = max(1.0, (0.45 if way == "nearer" else 0.7) * space.margin_mm)
    if not space.clear(found[:, :3, 3], margin).all():
        return None
    for pose in (found[0], found[2], found[-1]):
        ahead = np.median(space.rays.cast(pose[:3, 3], _middle_rays(pose)).distance)
        # Light falls with the square of the distance: much nearer than the recording all would be white.
        if not max(1.6 * margin, nearest_mm) < ahead < np.inf:
            return None
    # The line of sight between the path and the clip must be free: the scope cannot pass through walls.
    offset = found[2, :3, 3] - center
    length = float(np.linalg.norm(offset))
    if length > 1e-3 and space.rays.cast(center, (offset / length)[None]).distance[0] < length:
        return None
    return found


def _open_view(pose: Float[np.ndarray, "4 4"], space: FreeSpace) -> Float[np.ndarray, "4 4"]:
    """The pose, turned away from a wall right before the lens."""
    for _ in range(4):
        directions = _middle_rays(pose)
        depth = space.rays.cast(pose[:3, 3], directions).distance
        depth = np.where(np.isfinite(depth), depth, 1e3)
        if np.median(depth) > _NEAREST_SHARE * space.margin_mm:
            return pose
        open_way = unit((directions * np.minimum(depth, 60)[:, None]).sum(axis=0))
        forward = pose[:3, 2]
        axis = np.cross(forward, open_way)
        length = float(np.linalg.norm(axis))
        if length < 1e-6:
            return pose
        pose = pose.copy()
        pose[:3, :3] = rotation_about(axis, 0.35) @ pose[:3, :3]
    return pose


def _middle_rays(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 5), np.linspace(-0.7, 0.7, 5))
    local = unit(np.stack([x.ravel(), y.ravel(), np.ones(25)], axis=1)).astype(np.float64)
    return np.asarray(local @ pose[:3, :3].T)


def _turned(right: float, up: float, roll: float) -> Float[np.ndarray, "3 3"]:
    y, x, z = np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    return np.asarray(rotation_about(y, right) @ rotation_about(x, up) @ rotation_about(z, roll))


def _pose(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def _like(cameras: Cameras, poses: Float[np.ndarray, "v 4 4"]) -> Cameras:
    return Cameras(np.repeat(cameras.K[:1], len(poses), 0), poses, cameras.width, cameras.height)
