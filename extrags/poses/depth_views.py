"""Frames prepared for alignment: points, normals, and textures invariant to the moving light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_erosion, gaussian_filter

from extrags.cameras import unproject_pixels
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["LEVELS", "DepthView", "depth_view"]

LEVELS = (6.0, 3.0, 1.5, 0.7)
"""Blur of the textures from coarse to fine, in pixels of the working size."""
NEIGHBOURHOOD_PX = 12.0
"""Textures are taken against the mean and spread of so wide a neighbourhood: the lamp rides on the scope,
so brightness belongs to the view and not to the tissue."""
MIN_SPREAD = 0.02
"""Spread of the logarithm below which there is only noise."""
EDGE_SHARE = 0.05
"""A step in depth larger than this share of it is an edge, where points mix two surfaces."""
SAMPLES = 3000


@dataclass(frozen=True)
class DepthView:
    """One frame at the working size.

    Args:
        K: intrinsics of the working size, [3, 3].
        points: in camera axes, in the unit of the depth, [h, w, 3]; meaningless where not `valid`.
        normals: unit, towards the camera, [h, w, 3]; zero where unknown.
        valid: depth is known, [h, w].
        texture: per level two channels (luminance, redness) and their derivatives along x and y,
            [levels, h, w, 2, 3]; zero where not `textured`.
        textured: colours say something, [h, w].
        samples: flat indices of pixels spread evenly over those with depth and normal, [s].
        median_depth: of the valid pixels.
    """

    K: Float[np.ndarray, "3 3"]
    points: Float[np.ndarray, "h w 3"]
    normals: Float[np.ndarray, "h w 3"]
    valid: Bool[np.ndarray, "h w"]
    texture: Float[np.ndarray, "levels h w 2 3"]
    textured: Bool[np.ndarray, "h w"]
    samples: np.ndarray
    median_depth: float


def depth_view(sequence: EndoscopicSequence, frame: int, max_width: int) -> DepthView | None:
    """Prepare a frame; None where it has too little depth to be aligned.

    The size is divided by a whole number, and so by blocks of pixels: colours are averaged over each, and
    depth is that in its middle, never mixed across a fold.

    Args:
        sequence: with depth.
        frame: which.
        max_width: of the working size, in pixels.
    """
    if sequence.depth_mm is None:
        return None
    step = -(-sequence.width // max_width)
    height, width = sequence.height // step, sequence.width // step
    K = sequence.K[frame].astype(np.float64, copy=True)
    K[:2] /= step
    depth, valid = _middle_depth(sequence.depth_mm[frame], sequence.mask[frame], step)
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    points = depth[..., None] * unproject_pixels(pixels, K)
    normals = _normals(points, depth, valid)
    usable = np.flatnonzero(valid & (np.abs(normals).sum(-1) > 0))
    if len(usable) < SAMPLES // 20:
        return None
    spread = np.unique(np.linspace(0, len(usable) - 1, min(SAMPLES, len(usable))).round().astype(np.int64))
    blocks = sequence.rgb[frame][: height * step, : width * step]
    color = blocks.reshape(height, step, width, step, 3).mean(axis=(1, 3))
    told = sequence.supervised_mask(frame) & ~saturated_mask(sequence.rgb[frame])
    # A block with one bad pixel is bad: highlights move with the scope.
    told = told[: height * step, : width * step].reshape(height, step, width, step).all(axis=(1, 3))
    texture, textured = _textures(color, told)
    return DepthView(
        K, points, normals, valid, texture, textured, usable[spread], float(np.median(depth[valid]))
    )


def _middle_depth(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], step: int
) -> tuple[Float[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """Depth in the middle of each block of `step` x `step` pixels, 0 where unknown, and where it is known.

    Blocks of an odd number of pixels have a middle one. In others four pixels meet in the middle: one of them
    would be half a pixel off the block's colours, to another side in a frame that is rolled.
    """
    height, width = (size // step * step for size in depth.shape)
    known = mask & np.isfinite(depth) & (depth > 0)
    # Of a plane, the inverse depth is linear in the image.
    inverse = np.where(known, 1 / np.where(known, depth, 1).astype(np.float64), 0)
    around = range((step - 1) // 2, step // 2 + 1)
    parts = np.stack([inverse[i:height:step, j:width:step] for i in around for j in around])
    mean = parts.mean(axis=0)
    valid = (parts > 0).all(axis=0) & (np.ptp(parts, axis=0) < EDGE_SHARE * mean)
    return np.where(valid, 1 / np.where(valid, mean, 1), 0), valid


def _normals(points: np.ndarray, depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """From central differences; zero at edges of folds and of the mask."""
    normals = np.zeros_like(points)
    inner = np.s_[1:-1, 1:-1]
    along_x = points[1:-1, 2:] - points[1:-1, :-2]
    along_y = points[2:, 1:-1] - points[:-2, 1:-1]
    whole = valid[inner] & valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1] & valid[:-2, 1:-1]
    # A slanted wall changes fast but evenly: what tells an edge is the second difference.
    for behind, ahead in (
        (depth[1:-1, :-2], depth[1:-1, 2:]),
        (depth[:-2, 1:-1], depth[2:, 1:-1]),
    ):
        whole &= np.abs(behind + ahead - 2 * depth[inner]) < EDGE_SHARE * depth[inner]
    across = np.cross(along_y, along_x)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    facing = np.sign((across * -points[inner]).sum(-1, keepdims=True))
    unit = facing * across / np.where(length > 0, length, 1)
    normals[inner] = np.where(whole[..., None] & (length > 0), unit, 0)
    return normals


def _textures(
    color: UInt8[np.ndarray, "h w 3"] | np.ndarray, told: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    channels = np.log(color.astype(np.float64) + 4)
    luminance = channels.mean(-1)
    redness = channels[..., 0] - channels[..., 1]
    weight = told.astype(np.float64)
    # Near the edge of the mask the neighbourhood is lopsided.
    textured = binary_erosion(told, iterations=2)
    levels = []
    for sigma in LEVELS:
        flat = np.stack([_against_neighbourhood(c, weight, sigma) for c in (luminance, redness)], axis=-1)
        flat = np.where(told[..., None], flat, 0)
        along_y, along_x = np.gradient(flat, axis=(0, 1))
        levels.append(np.stack([flat, along_x, along_y], axis=-1))
    return np.stack(levels), textured


def _against_neighbourhood(channel: np.ndarray, weight: np.ndarray, sigma: float) -> np.ndarray:
    """Blurred by sigma, minus the local mean, over the local spread; pixels without weight are left out."""

    def smooth(values: np.ndarray, width: float) -> np.ndarray:
        total = gaussian_filter(weight, width)
        return np.asarray(gaussian_filter(values * weight, width) / np.maximum(total, 1e-6))

    wide = max(NEIGHBOURHOOD_PX, 3 * sigma)
    mean = smooth(channel, wide)
    fine = smooth(channel, sigma) - mean
    spread = np.sqrt(smooth(fine**2, wide))
    return np.asarray(np.clip(fine / np.maximum(spread, MIN_SPREAD), -3, 3))
