"""Scenes to pretrain the restorer on: colons of the phantom's family that are never evaluated.

Each differs from the catalogue's scenes in anatomy, mucosa, lamps, sensor, camera, number of frames and
quality of the depth. It is recorded once, as a training recording; what is to be restored are views far
off that path, photographed without noise at the recording's mean exposure.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig, Setting, stream
from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.recording import TRAINS, Phantom
from data_catalog.phantom.trajectories import camera_path
from extrags.cameras import Cameras, rotation_about
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["FIRST_PRETRAINING_SCENE", "pretraining_scene_config", "pretraining_sequence"]

FIRST_PRETRAINING_SCENE = 100_000
"""Pretraining scenes are numbered from here; the catalogue's scenes lie far below."""
_SIZES = ((160, 128), (144, 144), (176, 112), (160, 128), (136, 128))
_TARGETS: tuple[tuple[str, int], ...] = (("between", 6), ("sparse", 10), ("distanced", 20), ("searching", 12))


def pretraining_scene_config(index: int) -> PhantomConfig:
    """Settings of a pretraining scene: everything that is not anatomy is drawn from its number."""
    scene = FIRST_PRETRAINING_SCENE + index
    rng = stream(scene, "variation", 1)
    width, height = _SIZES[int(rng.integers(len(_SIZES)))]
    return PhantomConfig(
        scene=scene,
        width=width,
        height=height,
        field_of_view_deg=float(rng.uniform(72, 118)),
        train_every=int(rng.integers(6, 21)),
        polyps=int(rng.integers(0, 7)),
        exposure_drift=float(rng.choice([0.0, 0.015, 0.05])),
        white_balance_spread=0.0,
        exposure_spread=0.0,
        variation=1.0,
    )


def pretraining_sequence(index: int) -> EndoscopicSequence:
    """A pretraining scene with its views to restore.

    Returns:
        Training frames first; the test frames are the views to restore, with exact depth. The training
        frames' depth carries up to two percent of smooth and of white noise.
    """
    config = pretraining_scene_config(index)
    phantom = Phantom(config)
    rng = stream(config.scene, "variation", 2)
    gain = phantom.scene_gain()
    sensor = recording_sensor(config, TRAINS, gain)
    video = np.arange(0, config.video_frames, config.train_every)
    train = phantom.cameras("b", video / (config.video_frames - 1))
    targets = _target_cameras(phantom, rng)
    rgb, exposures = [], []
    for k, frame in enumerate(video):
        image, exposure = phantom.photograph(train[k], sensor, TRAINS, int(frame))
        rgb.append(image)
        exposures.append(exposure)
    quiet = replace(sensor, noise=False, drift=0.0)
    rgb += [
        phantom.photograph(targets[k], quiet, TRAINS, config.video_frames + k)[0] for k in range(len(targets))
    ]
    cameras = Cameras.concatenated([train, targets])
    depth = np.stack([phantom.z_depth(cameras[k]) for k in range(len(cameras))])
    valid = np.isfinite(depth)
    depth = np.where(valid, depth, 0)
    depth[: len(train)] *= _depth_noise(rng, depth[: len(train)].shape)
    truth: dict[str, Any] = {
        "generator_version": GENERATOR_VERSION,
        "phantom": config.model_dump(),
        "exposure": exposures,
    }
    return EndoscopicSequence(
        name=f"pretraining/{index}",
        rgb=np.stack(rgb),
        K=cameras.K,
        mask=valid,
        split=Split("pretraining", np.arange(len(train)), np.arange(len(train), len(cameras))),
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth.astype(np.float32),
        recording=np.zeros(len(cameras), dtype=np.int64),
        frame_names=tuple(f"p_{k:04d}" for k in range(len(cameras))),
        metric=True,
        truth=truth,
    )


def _target_cameras(phantom: Phantom, rng: np.random.Generator) -> Cameras:
    """Views to restore: between the training frames, on both evaluating paths, and looking about."""
    config = phantom.config
    parts = []
    for kind, count in _TARGETS:
        share = np.sort(rng.uniform(0.03, 0.97, count))
        recording = "b" if kind == "between" else "a"
        setting: Setting = "sparse" if kind == "sparse" else "distanced"
        path = config.model_copy(update={"setting": setting})
        poses = camera_path(path, phantom.wall, phantom.rays, recording, share)
        if kind == "searching":
            inner = camera_path(path, phantom.wall, phantom.rays, "b", share)
            # Between the two paths the lens is clear of the wall: the lumen is wide there.
            mix = rng.uniform(0, 1, (count, 1))
            poses = poses.copy()
            poses[:, :3, 3] = mix * poses[:, :3, 3] + (1 - mix) * inner[:, :3, 3]
            for k in range(count):
                poses[k, :3, :3] = inner[k, :3, :3] @ _random_turn(rng)
        parts.append(poses)
    poses = np.concatenate(parts)
    K = phantom.intrinsics(config.width, config.height)
    return Cameras(np.repeat(K[None], len(poses), 0), poses, config.width, config.height)


def _random_turn(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    heading, tilt, roll = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 100)), rng.uniform(-1, 1)
    across = np.array([np.cos(heading), np.sin(heading), 0.0])
    return np.asarray(rotation_about(across, tilt) @ rotation_about(np.array([0.0, 0.0, 1.0]), roll))


def _depth_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "f h w"]:
    """Factors near one: waves of some twenty pixels, and white noise; none in a third of the scenes."""
    import cv2

    frames, height, width = shape
    if rng.random() < 1 / 3:
        return np.ones(shape)
    smooth, white = rng.uniform(0, 0.02), rng.uniform(0, 0.02)
    coarse = rng.standard_normal((frames, 7, 9))
    waves = np.stack([cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC) for part in coarse])
    return np.asarray(np.exp(smooth * waves + white * rng.standard_normal(shape)))
