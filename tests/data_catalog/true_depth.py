"""How far true depth lies off a true surface."""

from __future__ import annotations

import numpy as np

from data_catalog.ray_casting import RayCaster
from extrags.cameras import pixel_rays
from extrags.sequence import EndoscopicSequence


def off_the_surface_mm(sequence: EndoscopicSequence, frame: int, rays: RayCaster) -> np.ndarray:
    """Distance of the point that each pixel of a frame shows from a surface."""
    assert sequence.depth_mm is not None
    camera = sequence.cameras[frame]
    depth = sequence.depth_mm[frame][..., None].astype(np.float64)
    points = camera.centers[0] + pixel_rays(camera)[0] * depth
    return rays.clearance_mm(points.reshape(-1, 3))
