"""Rendering of a cavern into an `EndoscopicSequence` with exact ground truth.

Axes are OpenCV's, lengths millimetres, depth is z-depth at pixel centres. Frames of recording B (training)
come first, then those of recording A (evaluation), as the phantom has it: B goes along the chain of chambers
and looks ahead; A passes again on another side, turned a little (`sparse`) or towards the walls
(`distanced`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from data_catalog.caverns.config import GENERATOR_VERSION, CavernConfig, stream
from data_catalog.caverns.geometry import Passage, build_cavern
from data_catalog.caverns.texture import make_texture
from data_catalog.cavities.camera import Painted, pinhole, radiance, z_depth
from data_catalog.cavities.lamps import Lamps
from data_catalog.phantom.imaging import Sensor
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, look_at, pixel_rays, rotation_about
from extrags.events import Progress, emit
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["MIN_CLEARANCE_MM", "record", "recorded", "recording_cameras"]

MIN_CLEARANCE_MM = 2.5
"""The lens keeps this distance from the wall wherever the line through the chambers does.

That line does not go round boulders: of caverns 0 to 39 seven (8, 9, 12, 19, 20, 35 and 38) have frames
nearer to the wall, and of caverns 0 to 99 two (12 and 35) have one frame of a recording within the rock.
"""
_EVALUATES, _TRAINS = 0, 1
_LOOK_AHEAD_MM = 15.0
# Share of the chain, side of the lumen, share of the room, mean turn and its swing in degrees.
_STYLES: dict[str, tuple[float, float, float, float, float]] = {
    "b": (0.86, 0.0, 0.35, 6.0, 6.0),
    "sparse": (0.82, 2.3, 0.5, 26.0, 9.0),
    "distanced": (0.94, np.pi, 0.7, 66.0, 16.0),
}
_LEVEL = 0.15
_EXPOSURE_SPREAD, _BALANCE_SPREAD, _DRIFT = 0.08, 0.02, 0.015


def record(config: CavernConfig, name: str) -> EndoscopicSequence:
    """Render a cavern's two recordings and their ground truth."""
    cavern = build_cavern(config.scene)
    truth = {"generator_version": GENERATOR_VERSION, "caverns": config.model_dump()}
    return recorded(config, name, cavern, make_texture(config.scene, cavern.wall), truth)


def recorded(
    config: CavernConfig, name: str, passage: Passage, texture: Painted, truth: dict[str, Any]
) -> EndoscopicSequence:
    """Two recordings of a passage and their ground truth.

    Args:
        config: of the recordings.
        name: of the sequence.
        passage: that the cameras follow.
        texture: of its wall.
        truth: what the passage was made from.
    """
    rays = RayCaster(passage.wall.vertices, passage.wall.triangles)
    lamps = Lamps.random(stream(config.seed, "light"))
    train, test = _frames(config)
    parts = {_TRAINS: ("b", train, config.train_frames), _EVALUATES: ("a", test, config.test_frames)}
    total = len(train) + len(test)
    rgb, cameras, recording, names, exposures = [], [], [], [], []
    gain = _gain(config, passage, texture, lamps, rays)
    for index, (letter, frames, count) in parts.items():
        views = recording_cameras(config, passage, rays, letter, frames / max(count - 1, 1))
        sensor = _sensor(config, index, gain)
        for k, frame in enumerate(frames):
            rng = stream(config.seed, "noise", index, int(frame))
            exposure = sensor.exposure(rng)
            light = radiance(passage.wall, texture, lamps, rays, views[k], config.supersample)
            rgb.append(sensor.develop(light, exposure, rng))
            exposures.append(exposure)
            recording.append(index)
            names.append(f"{letter}_{int(frame):04d}")
            emit(Progress("ingest", len(rgb), total))
        cameras.append(views)
    every = Cameras.concatenated(cameras)
    depth = np.stack([z_depth(rays, every[k]) for k in range(len(every))])
    valid = np.isfinite(depth)
    depth = np.where(valid, depth, 0).astype(np.float32)
    seen = np.arange(len(train))
    observed = np.zeros(depth.shape, dtype=bool)
    for k in range(len(train), len(every)):
        directions = pixel_rays(every[k])[0][valid[k]]
        points = every.centers[k] + directions * depth[k][valid[k]][:, None].astype(np.float64)
        observed[k][valid[k]] = rays.seen_by(points, every[seen])
    unseen = float(1 - observed[len(train) :].mean())
    return EndoscopicSequence(
        name=name,
        rgb=np.stack(rgb),
        K=every.K,
        mask=valid,
        split=Split(config.setting, seen, np.arange(len(train), len(every))),
        world_from_camera=every.world_from_camera,
        depth_mm=depth,
        recording=np.asarray(recording),
        frame_names=tuple(names),
        metric=True,
        observed=observed,
        truth={**truth, "exposure": exposures, "unseen_share_mean": unseen},
    )


def recording_cameras(
    config: CavernConfig, passage: Passage, rays: RayCaster, letter: str, share: Float[np.ndarray, "n"]
) -> Cameras:
    """Cameras of recording `a` (evaluates) or `b` (trains) at shares of its duration."""
    style = "b" if letter == "b" else config.setting
    length, side, room_share, turn, swing = _STYLES[style]
    reference = stream(config.seed, "trajectory").uniform(0, 2 * np.pi)
    phases = stream(config.seed, "trajectory", 1 + list(_STYLES).index(style)).uniform(0, 2 * np.pi, 6)
    last = len(passage.middle) - 1
    at = last * (0.5 + length * (share - 0.5)) + 3 * np.sin(2 * np.pi * 2.7 * share + phases[0])
    at = np.clip(at, 0, last)
    up = np.array([0.0, 0.6, 0.8])
    poses = []
    for k, place in enumerate(at):
        center, ahead = _along(passage.middle, place), _along(passage.middle, place + 2 * _LOOK_AHEAD_MM)
        if np.linalg.norm(ahead - center) < 2:
            ahead = 2 * center - _along(passage.middle, place - 2 * _LOOK_AHEAD_MM)
        base = look_at(center, ahead, up)[:3, :3]
        angle = reference + side + 0.5 * np.sin(2 * np.pi * 0.9 * share[k] + phases[1])
        aside = base @ np.array([np.cos(angle), np.sin(angle), 0.0])
        free = float(rays.clearance_mm(center[None].astype(np.float32))[0]) - MIN_CLEARANCE_MM
        for factor in (1.0, 0.7, 0.4, 0.2, 0.0):
            moved = center + factor * room_share * config.aside * max(free, 0.0) * aside
            if float(rays.clearance_mm(moved[None].astype(np.float32))[0]) >= MIN_CLEARANCE_MM:
                break
        tilt = np.radians(turn + swing * np.sin(2 * np.pi * 2.1 * share[k] + phases[2]))
        heading = phases[3] + 2 * np.pi * 1.3 * share[k]
        roll = 0.25 * np.sin(2 * np.pi * 1.1 * share[k] + phases[4])
        across = np.array([np.cos(heading), np.sin(heading), 0.0])
        pose = np.eye(4)
        local = rotation_about(across, tilt) @ rotation_about(np.array([0.0, 0.0, 1.0]), roll)
        pose[:3, :3] = look_at(moved, ahead + 0.3 * (moved - center), up)[:3, :3] @ local
        pose[:3, 3] = moved
        poses.append(pose)
    K = pinhole(config.width, config.height, config.field_of_view_deg)
    return Cameras(np.repeat(K[None], len(poses), 0), np.stack(poses), config.width, config.height)


def _along(middle: Float[np.ndarray, "k 3"], place: float) -> Float[np.ndarray, "3"]:
    at = np.clip(place, 0, len(middle) - 1)
    return np.array([np.interp(at, np.arange(len(middle)), middle[:, axis]) for axis in range(3)])


def _gain(config: CavernConfig, passage: Passage, texture: Painted, lamps: Lamps, rays: RayCaster) -> float:
    """Exposure that suits the passage: from a few small views of the training recording."""
    small = config.model_copy(update={"width": 40, "height": 32})
    probe = recording_cameras(small, passage, rays, "b", np.linspace(0.1, 0.9, 5))
    levels = [
        np.quantile(radiance(passage.wall, texture, lamps, rays, probe[k], 1).mean(axis=2), 0.6)
        for k in range(5)
    ]
    return float(_LEVEL / np.median(levels))


def _sensor(config: CavernConfig, index: int, gain: float) -> Sensor:
    rng = stream(config.seed, "exposure", index)
    factor = 1 + _EXPOSURE_SPREAD * rng.uniform(-1, 1)
    balance = 1 + _BALANCE_SPREAD * rng.uniform(-1, 1, 3)
    common = stream(config.seed, "exposure")
    return Sensor(
        gain * factor,
        (float(balance[0]), float(balance[1]), float(balance[2])),
        _DRIFT,
        True,
        vignetting=float(common.uniform(0.05, 0.4)),
        gamma=float(common.uniform(1.7, 2.2)),
    )


def _frames(config: CavernConfig) -> tuple[Int[np.ndarray, "a"], Int[np.ndarray, "b"]]:
    """Frames of both recordings, at most `max_frames`, spread evenly; both keep their share."""
    train, test = config.train_frames, config.test_frames
    most = config.max_frames
    if most is None or train + test <= most:
        return np.arange(train), np.arange(test)
    kept = int(np.clip(round(most * train / (train + test)), 1, most - 1))
    return (
        np.linspace(0, train - 1, kept).round().astype(int),
        np.linspace(0, test - 1, min(most - kept, test)).round().astype(int),
    )
