"""Metric scale of a reconstruction from known depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.frame_quantiles import median_of_frames
from extrags.sparse_depth import MIN_POINTS_PER_VIEW, interpolated_depth, pixel_lattice

__all__ = ["DENSE_SHARE", "DepthScale", "depth_scale", "typical_depth", "working_distance_scale"]

MIN_OBSERVATIONS = 20
"""A median over fewer is no measurement of scale."""

DENSE_SHARE = 0.5
"""Of the valid pixels: depth that is known at fewer need not be typical of the others."""


@dataclass(frozen=True, slots=True)
class DepthScale:
    """How long one unit of a reconstruction is.

    Args:
        mm_per_unit: median over observations of true depth / reconstructed depth.
        relative_spread: median absolute deviation of the ratios, divided by their median; small when
            the reconstruction has the true shape.
        n_observations: observations the median is taken over.
    """

    mm_per_unit: float
    relative_spread: float
    n_observations: int


def depth_scale(
    world_from_camera: Float[np.ndarray, "f 4 4"],
    points: Float[np.ndarray, "p 3"],
    observed_frame: Int[np.ndarray, "o"],
    observed_point: Int[np.ndarray, "o"],
    observed_px: Float[np.ndarray, "o 2"],
    depth_mm: Float[np.ndarray, "f h w"],
    mask: Bool[np.ndarray, "f h w"],
) -> DepthScale | None:
    """Robust ratio of known depth to reconstructed depth where triangulated points were observed.

    The median of ratios ignores the points that sit on a fold's edge in one of the two, and those that
    COLMAP placed badly.

    Args:
        world_from_camera: poses in the reconstruction's unit.
        points: triangulated points in the same unit.
        observed_frame: frame of each observation.
        observed_point: index of the point it observes.
        observed_px: where in the image, in pixels, centres at +0.5.
        depth_mm: true z-depth, 0 where unknown.
        mask: pixels whose depth counts.

    Returns:
        The scale, or None when fewer than 20 observations have a known depth.
    """
    height, width = depth_mm.shape[1:]
    column = np.floor(observed_px[:, 0]).astype(np.int64)
    row = np.floor(observed_px[:, 1]).astype(np.int64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    frame, point = observed_frame[inside], observed_point[inside]
    column, row = column[inside], row[inside]
    true = depth_mm[frame, row, column].astype(np.float64)
    pose = world_from_camera[frame]
    found = np.einsum("oi,oi->o", pose[:, :3, 2], points[point] - pose[:, :3, 3])
    counts = mask[frame, row, column] & np.isfinite(true) & (true > 0) & (found > 0)
    if int(counts.sum()) < MIN_OBSERVATIONS:
        return None
    ratios = true[counts] / found[counts]
    median = float(np.median(ratios))
    return DepthScale(median, float(np.median(np.abs(ratios - median)) / median), int(counts.sum()))


def typical_depth(
    depth: Float[np.ndarray, "f h w"],
    mask: Bool[np.ndarray, "f h w"],
    frames: Int[np.ndarray, "n"],
    *,
    least_share: float = 0.0,
) -> float | None:
    """Median depth of the valid pixels of frames.

    Args:
        depth: z-depth, 0 where unknown.
        mask: pixels that count.
        frames: whose pixels.
        least_share: of the valid pixels that must have depth.

    Returns:
        In the unit of the depth; None where too few pixels have any.
    """
    known, valid = 0, 0
    for frame in frames:
        known += int((mask[frame] & (depth[frame] > 0)).sum())
        valid += int(mask[frame].sum())
    if known == 0 or known < least_share * valid:
        return None
    return median_of_frames(lambda: (depth[k][mask[k] & (depth[k] > 0)] for k in frames))


def working_distance_scale(
    world_from_camera: Float[np.ndarray, "f 4 4"],
    points: Float[np.ndarray, "p 3"],
    observed_frame: Int[np.ndarray, "o"],
    observed_point: Int[np.ndarray, "o"],
    observed_px: Float[np.ndarray, "o 2"],
    mask: Bool[np.ndarray, "f h w"],
    working_distance_mm: float,
) -> float:
    """Millimetres per unit, so that surface is so far from the frames, in the median over pixels.

    Over pixels and not over points: points lie where features are, in a tube mostly far away. Depth is
    interpolated between the points that each frame observes.

    Args:
        world_from_camera: poses in the reconstruction's unit.
        points: triangulated points in the same unit.
        observed_frame: frame of each observation.
        observed_point: index of the point it observes.
        observed_px: where in the image, in pixels, centres at +0.5.
        mask: pixels that count.
        working_distance_mm: the distance that the median becomes.
    """
    pose = world_from_camera[observed_frame]
    z = np.einsum("oi,oi->o", pose[:, :3, 2], points[observed_point] - pose[:, :3, 3])
    found = []
    for frame in np.unique(observed_frame):
        rows = (observed_frame == frame) & (z > 0)
        if rows.sum() >= MIN_POINTS_PER_VIEW:
            found.append(interpolated_depth(observed_px[rows], z[rows], pixel_lattice(mask[frame])))
    return working_distance_mm / float(np.median(np.concatenate(found) if found else z[z > 0]))
