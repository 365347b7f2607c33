"""Cameras of a viewer: from an orientation and a field of view, and where to begin."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras, look_at
from extrags.errors import ConfigError
from extrags.scene import Scene

__all__ = ["overview", "pinhole", "typical_depth"]

_FOV_DEG = 60.0
_SHOWN_DEVIATIONS = 2.0
"""So many standard deviations of a Gaussian that stands alone are in view."""
_SAMPLE = 20_000
"""So many Gaussians tell where a scene lies."""


def pinhole(
    world_from_camera: Float[np.ndarray, "4 4"], fov_rad: float, aspect: float, width: int
) -> Cameras:
    """One camera with square pixels and the principal point in the middle.

    Args:
        world_from_camera: its pose.
        fov_rad: vertical field of view.
        aspect: width by height.
        width: of the image in pixels.

    Raises:
        ConfigError: for a field of view or an aspect that no camera has.
    """
    if not 0 < fov_rad < math.pi or not 0 < aspect < math.inf:
        raise ConfigError(f"no camera has a field of view of {fov_rad:g} rad and an aspect of {aspect:g}")
    height = max(1, round(width / aspect))
    focal = height / 2 / math.tan(fov_rad / 2)
    K = np.array([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]])
    return Cameras(K, np.asarray(world_from_camera, dtype=np.float64)[None], width, height)


def overview(scene: Scene, width: int) -> Cameras:
    """A camera outside that has most of a scene in view: where to begin when there are no frames.

    It looks along the direction in which the scene extends least; the image's right is that in which it
    extends most.

    Args:
        scene: the scene.
        width: of the image in pixels; the aspect is 4:3.

    Raises:
        ConfigError: for a scene without Gaussians.
    """
    points = _sample(scene, scene.gaussians.means)
    if not len(points):
        raise ConfigError("the scene holds no Gaussians to look at")
    middle = np.median(points, axis=0)
    offsets = points - middle
    # Strays, which reconstructions have, do not count: three quarters of the Gaussians are in view.
    distance = np.linalg.norm(offsets, axis=1)
    reach = max(float(np.quantile(distance, 0.75)), 1e-6)
    inner = offsets[distance <= 2 * reach]
    # One Gaussian alone, or several at one place, reach as far as they are large.
    size = float(np.median(np.exp(_sample(scene, scene.gaussians.scales).max(axis=1))))
    reach = max(reach, _SHOWN_DEVIATIONS * size, 0.0 if scene.light is None else scene.near)
    axes = np.linalg.svd(inner, full_matrices=False)[2] if len(points) > 3 else np.eye(3)
    pose = look_at(middle - axes[2] * reach / math.tan(math.radians(_FOV_DEG / 2)) * 1.5, middle, axes[1])
    return pinhole(pose, math.radians(_FOV_DEG), 4 / 3, width)


def typical_depth(scene: Scene, camera: Cameras) -> float:
    """How far away things are, in world units: what turning about a point of the scene turns about.

    The light's reference distance, or the median distance of the Gaussians in front of the camera.
    """
    if scene.light is not None:
        return float(scene.light.reference_distance)
    along = (_sample(scene, scene.gaussians.means) - camera.centers[0]) @ camera.forward[0]
    ahead = along[along > 0]
    return float(np.median(ahead)) if len(ahead) else 1.0


def _sample(scene: Scene, values: Float[Tensor, "m 3"]) -> Float[np.ndarray, "n 3"]:
    """Of the Gaussians that tell where a scene lies."""
    every = values.detach().cpu().numpy()
    return np.asarray(every[:: max(1, len(scene.gaussians) // _SAMPLE)].astype(np.float64))
