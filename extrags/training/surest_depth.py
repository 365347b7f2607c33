"""Which points of estimated depth are worth starting from, and where all frames together have them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.cameras import pixel_rays
from extrags.sequence import EndoscopicSequence

__all__ = ["agreed_depth", "surest_points"]

SURER_FACTOR = 1.5
"""A point is left out where another frame that sees its place expects an error so many times smaller."""

HIDDEN_ERRORS = 3.0
"""A point farther behind what a frame sees, in expected errors of both together, is hidden from it."""

AGREEING_ERRORS = 3.0
"""Depths of two frames that differ by at most so many expected errors of both together are of one surface."""

PLANE_WINDOW_PX = 1.0
"""Standard deviation of the window that a plane is fitted in."""

LEAST_SHARE = 0.3
"""Of such a window with less that is known no plane is fitted."""


@dataclass(frozen=True)
class _Sight:
    """What one frame says of some of the points.

    Args:
        of: which points these are.
        pixel: flat positions of their pixels in the frame.
        z: their depth in the frame.
        depth: what the frame estimates at their pixels, above zero.
        error: what it expects to be wrong by there, in world units.
    """

    of: Int[np.ndarray, "k"]
    pixel: Int[np.ndarray, "k"]
    z: Float[np.ndarray, "k"]
    depth: Float[np.ndarray, "k"]
    error: Float[np.ndarray, "k"]


def _sight(
    points: Float[np.ndarray, "n 3"],
    sequence: EndoscopicSequence,
    frame: int,
    depth_mm: Float[np.ndarray, "h w"],
) -> _Sight:
    """What a frame says of the points that it has in its image, with depth where it is above zero."""
    assert sequence.depth_error is not None
    (pixels,), (z,) = sequence.cameras[frame].project(points)
    inside = np.flatnonzero(sequence.cameras.contains(pixels))
    column, row = pixels[inside].astype(np.int64).T
    flat = row * sequence.width + column
    depth = np.where(sequence.mask[frame], depth_mm, 0).reshape(-1)[flat].astype(np.float64)
    known = depth > 0
    inside, flat, depth = inside[known], flat[known], depth[known]
    return _Sight(inside, flat, z[inside], depth, sequence.depth_error[frame].reshape(-1)[flat] * depth)


def surest_points(
    points: Float[np.ndarray, "n 3"],
    error: Float[np.ndarray, "n"],
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
) -> Bool[np.ndarray, "n"]:
    """Points of frames' estimated depth of whose place no other frame knows much better.

    Frames see the same surface from near and from far, and are wrong about it in different ways. Together
    their points fill a shell around it, and thinned out in voxels, most of what is left are the few that lie
    far off, each in a voxel of its own. So a point is left out where a frame that expects less than
    `1 / SURER_FACTOR` of its error has the same surface there, or looks through the point. What all much
    surer frames have hidden or outside their images stays, however unsure it is.

    Args:
        points: back-projected pixels of the frames, in world units.
        error: expected error of the depth of each, in world units.
        sequence: posed frames with estimated depth.
        frames: those that may be looked at.

    Returns:
        False for points to leave out; the surest of all is never among them.
    """
    assert sequence.depth_mm is not None
    least = np.array(error)
    for frame in frames.tolist():
        sight = _sight(points, sequence, frame, sequence.depth_mm[frame])
        hidden = sight.z - sight.depth > HIDDEN_ERRORS * np.hypot(sight.error, error[sight.of])
        speaking = sight.of[~hidden]
        least[speaking] = np.minimum(least[speaking], sight.error[~hidden])
    return np.asarray(error <= SURER_FACTOR * least)


def agreed_depth(
    centers: Float[np.ndarray, "n 3"],
    rays: Float[np.ndarray, "n 3"],
    z: Float[np.ndarray, "n"],
    error: Float[np.ndarray, "n"],
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
    depth_mm: Float[np.ndarray, "m h w"],
) -> Float[np.ndarray, "n"]:
    """Depth of pixels as all frames that see their surface have it: the mean by inverse squared errors.

    In each frame a plane is fitted to the estimates round the pixel that a point falls on, and cut with the
    point's own ray: frames look at a wall from different sides, and what is one millimetre along the ray of
    one is several along that of another. Where a plane lies off by more than `AGREEING_ERRORS` expected
    errors of both, the frame sees another surface and has no say.

    Args:
        centers: of the cameras that the pixels belong to, in world units.
        rays: from there, to depth one, in world axes.
        z: depth of the pixels.
        error: expected error of the depth of each, in world units.
        sequence: posed frames with estimated depth.
        frames: those that may be looked at, as a rule the pixels' own among them.
        depth_mm: depth of these frames, 0 where it has no say.

    Returns:
        New depth of each pixel.
    """
    total, weight = np.zeros(len(z)), np.zeros(len(z))
    points = centers + z[:, None] * rays
    for frame, depth in zip(frames.tolist(), depth_mm, strict=True):
        camera = sequence.cameras[frame]
        sight = _sight(points, sequence, frame, depth)
        normal = _planes(sequence, frame, depth)[sight.pixel]
        rotation = camera.world_from_camera[0, :3, :3]
        start = np.einsum("ni,ni->n", (centers[sight.of] - camera.centers[0]) @ rotation, normal)
        ahead = np.einsum("ni,ni->n", rays[sight.of] @ rotation, normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            met = (1 - start) / ahead
            own = sight.error / (sight.depth * ahead)
            agrees = np.abs(met - z[sight.of]) <= AGREEING_ERRORS * np.hypot(own, error[sight.of])
        agrees &= (own > 0) & (met > 0) & np.isfinite(own)
        share = 1 / own[agrees] ** 2
        total[sight.of[agrees]] += share * met[agrees]
        weight[sight.of[agrees]] += share
    return np.asarray(np.divide(total, weight, out=np.array(z, dtype=np.float64), where=weight > 0))


def _planes(
    sequence: EndoscopicSequence, frame: int, depth_mm: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "p 3"]:
    """Of each pixel the plane that fits the depth round it, as n with n . x = 1 in the camera's axes.

    Over a plane the inverse of depth is linear in the coordinates of rays: a least-squares fit in a Gaussian
    window. Zero, which no ray meets, where too little is known, and where the plane is off from the estimate
    itself by more than that expects to be wrong: at jumps of depth, where it lies between both surfaces.
    """
    assert sequence.depth_error is not None
    camera = sequence.cameras[frame]
    rotation = camera.world_from_camera[0, :3, :3]
    x, y, _ = np.moveaxis(pixel_rays(camera)[0] @ rotation, -1, 0)
    depth = depth_mm.astype(np.float64)
    known = (depth > 0) & sequence.mask[frame]
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=known)

    def mean(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        blurred = np.asarray(cv2.GaussianBlur(np.where(known, values, 0), (0, 0), PLANE_WINDOW_PX))
        return np.asarray(np.divide(blurred, share, out=np.zeros_like(blurred), where=share > LEAST_SHARE))

    share = cv2.GaussianBlur(known.astype(np.float64), (0, 0), PLANE_WINDOW_PX)
    mx, my, mq = mean(x), mean(y), mean(inverse)
    xx, xy, yy = mean(x * x) - mx * mx, mean(x * y) - mx * my, mean(y * y) - my * my
    xq, yq = mean(x * inverse) - mx * mq, mean(y * inverse) - my * mq
    determinant = xx * yy - xy * xy
    fitted = known & (share > LEAST_SHARE) & (determinant > 1e-3 * (xx + yy) ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.where(fitted, (yy * xq - xy * yq) / determinant, 0)
        b = np.where(fitted, (xx * yq - xy * xq) / determinant, 0)
    c = mq - a * mx - b * my
    fitted &= np.abs((a * x + b * y + c) * depth - 1) <= sequence.depth_error[frame]
    return np.where(fitted[..., None], np.stack([a, b, c], axis=-1), 0.0).reshape(-1, 3)
