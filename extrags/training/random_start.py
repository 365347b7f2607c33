"""Where a surface may be when nothing but cameras is known: random depths to start from.

Source: Kerbl et al.: 3D Gaussian Splatting for Real-Time Radiance Field Rendering, ACM TOG 2023, section 7.3
(random starting points); the ranges are this project's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrags.cameras import Cameras, pixel_rays
from extrags.errors import CaptureError

__all__ = ["DepthRange", "depth_range", "random_depth"]

MIN_AXES_SPREAD = 0.05
"""Mean squared sine of the angle between optical axes and their main direction, below which they are as good
as parallel and do not meet anywhere."""
MIN_SHARE_IN_FRONT = 0.9
"""Share of cameras that must have the meeting point in front of them."""
MAX_MISS_SHARE = 0.25
"""Median distance of the axes from the point they meet at, as a share of its depth."""
MAX_OBJECT_SHARE = 0.7
"""Half the thickness of an object, at most, as a share of its distance."""
NEAREST_SHARE, FARTHEST_SHARE = 1 / 8, 4.0
"""Depths beside a path, in radii of the path: surface nearer than that would be touched, surface farther away
shows hardly any parallax."""
SAME_PLACE_SHARE = 1e-6


@dataclass(frozen=True)
class DepthRange:
    """Depths among which the surface is looked for, in world units.

    Args:
        near: smallest z-depth.
        typical: the scene's length scale.
        far: largest z-depth.
        meeting: the point that the optical axes meet at, as in captures of an object; None where they do not.
    """

    near: float
    typical: float
    far: float
    meeting: Float[np.ndarray, "3"] | None = None


def depth_range(cameras: Cameras, name: str) -> DepthRange:
    """Depths at which cameras may see surface, from nothing but where they stand and look.

    Captures of an object look at it: where the optical axes meet within a quarter of the depth, in front of
    nine tenths of the cameras, the range surrounds that point by as much as the image shows of it. An
    endoscope looks along its path: the range is then a multiple of the path's radius, since only what is not
    much farther away than the cameras have moved shows parallax.

    Args:
        cameras: the training views.
        name: of the sequence, for errors.

    Raises:
        CaptureError: when all cameras stand in one place.
    """
    centres, forward = cameras.centers, cameras.forward
    away = centres - centres.mean(axis=0)
    radius = float(np.linalg.norm(away, axis=1).max())
    if radius <= SAME_PLACE_SHARE * max(1.0, float(np.abs(centres).max())):
        raise CaptureError(
            f"{name}: neither depth nor sparse points are known, and all {len(cameras)} training cameras "
            "stand in one place, so that nothing tells how far the surface is; provide depth, or a recording "
            "that moves"
        )
    # Least squares: the point nearest to all axes.
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.mean(axis=0)
    if float(np.linalg.eigvalsh(total)[0]) > MIN_AXES_SPREAD:
        meeting = np.linalg.solve(total, np.einsum("cij,cj->ci", across, centres).mean(axis=0))
        z = ((meeting - centres) * forward).sum(axis=1)
        distance = float(np.median(z))
        miss = float(np.median(np.linalg.norm(np.einsum("cij,cj->ci", across, meeting - centres), axis=1)))
        if (z > 0).mean() >= MIN_SHARE_IN_FRONT and miss < MAX_MISS_SHARE * distance:
            half_width = min(
                float(np.median(cameras.width / 2 / cameras.K[:, 0, 0])),
                float(np.median(cameras.height / 2 / cameras.K[:, 1, 1])),
            )
            half = min(half_width, MAX_OBJECT_SHARE) * distance
            return DepthRange(distance - half, distance, distance + half, meeting)
    near, far = NEAREST_SHARE * radius, FARTHEST_SHARE * radius
    return DepthRange(near, float(np.sqrt(near * far)), far)


def random_depth(cameras: Cameras, within: DepthRange, *, seed: int) -> Float[np.ndarray, "c h w"]:
    """A random z-depth for each pixel: uniform in a ball about an object, else uniform in its logarithm.

    In a capture of an object each camera would otherwise have points before it that no other sees, and every
    image could be explained by what hangs before its own lens.

    Args:
        cameras: the views.
        within: the range.
        seed: of the random numbers.

    Returns:
        Depths in world units, float32; 0 for points outside the ball.
    """
    share = np.random.default_rng(seed).random(
        (len(cameras), cameras.height, cameras.width), dtype=np.float32
    )
    if within.meeting is not None:
        z = np.asarray(within.near + share * (within.far - within.near), dtype=np.float32)
        points = cameras.centers[:, None, None] + z[..., None] * pixel_rays(cameras)
        from_middle = np.linalg.norm(points - within.meeting, axis=-1)
        return np.where(from_middle < (within.far - within.near) / 2, z, np.float32(0))
    return np.asarray(within.near * (within.far / within.near) ** share, dtype=np.float32)
