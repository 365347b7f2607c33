"""What holds of two rendered recordings of one place, whatever the place."""

from __future__ import annotations

import numpy as np

from data_catalog import read
from data_catalog.ray_casting import RayCaster
from extrags.cameras import pixel_rays
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence


def off_the_surface_mm(sequence: EndoscopicSequence, frame: int, rays: RayCaster) -> np.ndarray:
    """Distance of the point that each pixel of a frame shows from a surface."""
    assert sequence.depth_mm is not None
    camera = sequence.cameras[frame]
    depth = sequence.depth_mm[frame][..., None].astype(np.float64)
    points = camera.centers[0] + pixel_rays(camera)[0] * depth
    return rays.clearance_mm(points.reshape(-1, 3))


def check_the_same_again(sequence: EndoscopicSequence, config: IngestConfig, shape: tuple[int, ...]) -> None:
    """It is the same when it is read anew, and knows depth and what training saw."""
    again = read(sequence.name, config)
    np.testing.assert_array_equal(again.rgb, sequence.rgb)
    assert sequence.rgb.shape[1:] == shape
    assert sequence.depth_mm is not None
    assert sequence.observed is not None
    assert (sequence.depth_mm > 0).all()
    assert not sequence.observed[sequence.train].any()
    assert 0.3 < sequence.observed[sequence.test].mean() < 1
