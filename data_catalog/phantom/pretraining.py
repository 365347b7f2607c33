"""Scenes to pretrain the restorer on: colons of the phantom's family that are never evaluated.

Each differs from the catalogue's scenes in anatomy, mucosa, lamps, sensor, camera and number of frames. It is
recorded once, as a training recording; what is to be restored are clips of views far off that path,
photographed without noise at the recording's mean exposure.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig, Setting, stream
from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.recording import TRAINS, Phantom
from data_catalog.phantom.trajectories import camera_path
from extrags.cameras import Cameras, rotation_about
from extrags.restoration.training_data.recordings import PretrainingRecording
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["FIRST_PRETRAINING_SCENE", "pretraining_recording", "pretraining_scene_config"]

FIRST_PRETRAINING_SCENE = 100_000
"""Pretraining scenes are numbered from here; the catalogue's scenes lie far below."""
_SIZES = ((160, 128), (144, 144), (176, 112), (160, 128), (136, 128))
_CLIP_VIEWS = 5
_CLIPS: tuple[tuple[str, int], ...] = (("between", 1), ("sparse", 2), ("distanced", 4), ("searching", 3))
"""Clips on each path; their views follow each other."""


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


def pretraining_recording(index: int, *, to_restore: bool = True) -> PretrainingRecording:
    """A pretraining scene with its clips of views to restore; training frames come first.

    Args:
        index: from 0.
        to_restore: whether there are such views; the training frames are the same without.
    """
    config = pretraining_scene_config(index)
    phantom = Phantom(config)
    rng = stream(config.scene, "variation", 2)
    gain = phantom.scene_gain()
    sensor = recording_sensor(config, TRAINS, gain)
    video = np.arange(0, config.video_frames, config.train_every)
    train = phantom.cameras("b", video / (config.video_frames - 1))
    targets = _target_cameras(phantom, rng) if to_restore else train[np.arange(0)]
    rgb, exposures = [], []
    for k, frame in enumerate(video):
        image, exposure = phantom.photograph(train[k], sensor, TRAINS, int(frame))
        rgb.append(image)
        exposures.append(exposure)
    quiet = replace(sensor, noise=False, drift=0.0)

    def photographed(camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        # Without noise and drift the number of the frame says nothing.
        return phantom.photograph(camera, quiet, TRAINS, config.video_frames)[0]

    rgb += [photographed(targets[k]) for k in range(len(targets))]
    cameras = Cameras.concatenated([train, targets])
    depth = np.stack([phantom.z_depth(cameras[k]) for k in range(len(cameras))])
    valid = np.isfinite(depth)
    depth = np.where(valid, depth, 0)
    truth: dict[str, Any] = {
        "generator_version": GENERATOR_VERSION,
        "phantom": config.model_dump(),
        "exposure": exposures + [1.0] * len(targets),
    }
    sequence = EndoscopicSequence(
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
    clip = np.repeat(np.arange(len(targets) // _CLIP_VIEWS), _CLIP_VIEWS)
    return PretrainingRecording(sequence, clip, "phantom", phantom.z_depth, photographed)


def _target_cameras(phantom: Phantom, rng: np.random.Generator) -> Cameras:
    """Views to restore: between the training frames, on both evaluating paths, and looking about."""
    config = phantom.config
    parts = []
    for kind, clips in _CLIPS:
        start = rng.uniform(0.03, 0.92, (clips, 1))
        share = (start + rng.uniform(0.003, 0.012, (clips, 1)) * np.arange(_CLIP_VIEWS)).ravel()
        recording = "b" if kind == "between" else "a"
        setting: Setting = "sparse" if kind == "sparse" else "distanced"
        path = config.model_copy(update={"setting": setting})
        poses = camera_path(path, phantom.wall, phantom.rays, recording, share)
        if kind == "searching":
            inner = camera_path(path, phantom.wall, phantom.rays, "b", share)
            # Between the two paths the lens is clear of the wall: the lumen is wide there.
            mix = np.repeat(rng.uniform(0, 1, (clips, 1)), _CLIP_VIEWS, axis=0)
            poses = poses.copy()
            poses[:, :3, 3] = mix * poses[:, :3, 3] + (1 - mix) * inner[:, :3, 3]
            for clip in range(clips):
                turn, axis = _random_turn(rng), rng.standard_normal(3)
                step = np.radians(rng.uniform(0.5, 5))
                for view in range(_CLIP_VIEWS):
                    k = clip * _CLIP_VIEWS + view
                    poses[k, :3, :3] = inner[k, :3, :3] @ turn @ rotation_about(axis, step * view)
        parts.append(poses)
    poses = np.concatenate(parts)
    K = phantom.intrinsics(config.width, config.height)
    return Cameras(np.repeat(K[None], len(poses), 0), poses, config.width, config.height)


def _random_turn(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    heading, tilt, roll = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 100)), rng.uniform(-1, 1)
    across = np.array([np.cos(heading), np.sin(heading), 0.0])
    return np.asarray(rotation_about(across, tilt) @ rotation_about(np.array([0.0, 0.0, 1.0]), roll))
