"""Where the explorer would look in a pretraining scene."""

from __future__ import annotations

import logging

import numpy as np

from extrags.cameras import Cameras
from extrags.config import PipelineConfig
from extrags.errors import CaptureError
from extrags.exploration import explore
from extrags.freespace import carve
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.surface import fuse_surface
from extrags.surface_error import surface_error_mm

__all__ = ["explored_cameras"]

logger = logging.getLogger(__name__)


def explored_cameras(
    scene: Scene, sequence: EndoscopicSequence, config: PipelineConfig, *, every: int
) -> list[Cameras]:
    """Virtual cameras of each trajectory that a run would choose; none where it finds none.

    Where the views see no surface, or nothing is free, there is nothing to explore: other views of the scene
    may serve all the same.

    Args:
        scene: reconstructed from `sequence`.
        sequence: training frames alone, as the reconstruction was given them.
        config: settings of a run.
        every: neighbours on a trajectory show nearly the same: one of so many is taken, the first among them.
    """
    masks = sequence.training_masks
    try:
        mesh = fuse_surface(scene, sequence.training_cameras, config.surface, masks=masks)
        free = carve(
            scene,
            mesh,
            sequence.training_cameras,
            config.freespace,
            surface_error_mm=surface_error_mm(mesh, sequence),
            masks=masks,
        )
        trajectories = explore(scene, sequence, config.explore, freespace=free).trajectories
    except CaptureError as error:
        logger.info("%s: not explored (%s)", sequence.name, error)
        return []
    return [cameras[np.arange(0, len(cameras), every)] for cameras in trajectories]
