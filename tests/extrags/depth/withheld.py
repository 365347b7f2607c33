"""A short stretch of a phantom whose depth is withheld, with or without points of its surface."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.recording import EVALUATES, Phantom
from data_catalog.specular import with_specular
from extrags.cameras import pixel_rays
from extrags.sequence import EndoscopicSequence, Split

NUMBERS = np.round(np.linspace(0, 27, 23)).astype(int)
"""Of the frames of a recording that a source of at most forty frames has."""


def withheld_phantom(frames: int = 10, *, width: int = 96, height: int = 72) -> EndoscopicSequence:
    """The first frames of a recording train and have no depth; its last one is held out and keeps its own."""
    return recorded(frames, width, height).without_training_depth()


@cache
def recorded(frames: int, width: int, height: int) -> EndoscopicSequence:
    """Rendered once a process, and no other frame with them; nobody writes into it."""
    config = PhantomConfig(scene=0, width=width, height=height)
    phantom = Phantom(config)
    sensor = recording_sensor(config, EVALUATES, phantom.scene_gain())
    numbers = [*NUMBERS[:frames].tolist(), int(NUMBERS[-1])]
    cameras = phantom.cameras("a", np.array(numbers) / (config.test_frames - 1))
    images = [phantom.photograph(cameras[k], sensor, EVALUATES, number) for k, number in enumerate(numbers)]
    depth = np.stack([phantom.z_depth(cameras[k]) for k in range(len(cameras))])
    sequence = EndoscopicSequence(
        name="phantom/0@stretch",
        rgb=np.stack([image for image, _ in images]),
        K=cameras.K,
        mask=np.isfinite(depth),
        split=Split("stretch", np.arange(frames), np.array([frames])),
        world_from_camera=cameras.world_from_camera,
        depth_mm=np.where(np.isfinite(depth), depth, 0).astype(np.float32),
        metric=True,
    )
    return with_specular(sequence)


def true_training_depth(sequence: EndoscopicSequence) -> np.ndarray:
    """What was withheld of the training frames."""
    assert sequence.withheld_depth_mm is not None
    return sequence.withheld_depth_mm[sequence.train]


def with_points(sequence: EndoscopicSequence, count: int = 80) -> EndoscopicSequence:
    """Points of the true surface, so that nothing has to be triangulated."""
    part, truth = sequence.training_part(), true_training_depth(sequence)
    chosen = np.random.default_rng(0).choice(np.flatnonzero((truth > 0) & part.mask), count, replace=False)
    frame = chosen // (part.height * part.width)
    rays = pixel_rays(part.cameras).reshape(-1, 3)[chosen]
    points = part.cameras.centers[frame] + truth.reshape(-1)[chosen][:, None] * rays
    return replace(sequence, points=points, points_rgb=np.full((count, 3), 128, np.uint8))
