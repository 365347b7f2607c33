"""A short stretch of a phantom whose depth is withheld, with or without points of its surface."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from data_catalog import read
from extrags.cameras import pixel_rays
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence, Split


def withheld_phantom(frames: int = 10, *, width: int = 96, height: int = 72) -> EndoscopicSequence:
    """The last frames of a recording train and have no depth, those before are held out and keep theirs."""
    whole = recorded(width, height)
    assert whole.recording is not None
    stretch = np.flatnonzero(whole.recording == whole.recording[-1])[:frames]
    others = np.setdiff1d(np.arange(len(whole)), stretch)
    return replace(whole, split=Split("stretch", stretch, others)).without_training_depth()


@cache
def recorded(width: int, height: int) -> EndoscopicSequence:
    """Rendered once a process; nobody writes into it."""
    return read("phantom/0@sparse", IngestConfig(width=width, height=height, max_frames=40))


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
