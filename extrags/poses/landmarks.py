"""Initial poses of frames with depth, from features shared with other frames.

`alignment` refines them and decides which one is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrags.cameras import invert_poses, unproject_pixels
from extrags.feature_matches import mutual_matches, sift_features
from extrags.metrics.pose import umeyama
from extrags.sequence import EndoscopicSequence

__all__ = ["Landmarks", "landmarks", "relative_pose"]

MIN_MATCHES = 8
TRIPLETS = 400
CLOSE_SHARE = 0.03
"""Landmarks that lie this near to each other, as a share of their depth, are the same."""


@dataclass(frozen=True)
class Landmarks:
    """Features with depth.

    Args:
        points: in camera axes, [n, 3].
        descriptors: of unit length, [n, 128].
    """

    points: Float[np.ndarray, "n 3"]
    descriptors: Float[np.ndarray, "n 128"]


def landmarks(sequence: EndoscopicSequence, frame: int) -> Landmarks:
    """SIFT features of a frame, inside the mask and where depth is known."""
    if sequence.depth_mm is None:
        return Landmarks(np.zeros((0, 3)), np.zeros((0, 128), np.float32))
    depth = sequence.depth_mm[frame]
    told = sequence.supervised_mask(frame) & (depth > 0) & np.isfinite(depth)
    features = sift_features(sequence.rgb[frame], told)
    row, column = features.rows_and_columns(sequence.height, sequence.width)
    kept = told[row, column]
    z = depth[row, column].astype(np.float64)
    points = unproject_pixels(features.pixels, sequence.K[frame]) * z[:, None]
    return Landmarks(points[kept], features.descriptors[kept])


def relative_pose(
    moving: Landmarks, reference: Landmarks, *, seed: int
) -> tuple[Float[np.ndarray, "4 4"] | None, int]:
    """`reference_from_moving` by three-point samples, and how many matches agree with it.

    Args:
        moving: landmarks of the frame that is looked for.
        reference: of the other one.
        seed: of the samples.

    Returns:
        None for the pose where fewer than eight matches agree.

    Source: Fischler and Bolles: Random sample consensus, CACM 1981.
    """
    matches = mutual_matches(moving.descriptors, reference.descriptors)
    if len(matches) < MIN_MATCHES:
        return None, 0
    source, target = moving.points[matches[:, 0]], reference.points[matches[:, 1]]
    reach = CLOSE_SHARE * np.minimum(source[:, 2], target[:, 2])
    generator = np.random.default_rng(seed)
    triplets = np.argsort(generator.random((TRIPLETS, len(matches))), axis=1)[:, :3]
    best = np.zeros(len(matches), dtype=bool)
    for motion in _rigid_motions(source[triplets], target[triplets]):
        fits = _distances(motion, source, target) < reach
        if fits.sum() > best.sum():
            best = fits
    if best.sum() < MIN_MATCHES:
        return None, int(best.sum())
    for _ in range(3):
        rigid = umeyama(source[best], target[best], with_scale=False)
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rigid.rotation, rigid.translation
        fits = _distances(motion, source, target) < reach
        if fits.sum() < MIN_MATCHES:
            return None, int(fits.sum())
        best = fits
    return motion, int(best.sum())


def _rigid_motions(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Least-squares motions of many small sets at once, [t, 4, 4]."""
    mean_source, mean_target = source.mean(1), target.mean(1)
    spread = np.einsum("tni,tnj->tij", target - mean_target[:, None], source - mean_source[:, None])
    u, _, vt = np.linalg.svd(spread)
    signs = np.ones((len(u), 3))
    signs[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    motions = np.tile(np.eye(4), (len(u), 1, 1))
    motions[:, :3, :3] = (u * signs[:, None]) @ vt
    motions[:, :3, 3] = mean_target - np.einsum("tij,tj->ti", motions[:, :3, :3], mean_source)
    return motions


def _distances(motion: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The larger of the distances, in either frame."""
    there = source @ motion[:3, :3].T + motion[:3, 3]
    back = invert_poses(motion)
    here = target @ back[:3, :3].T + back[:3, 3]
    return np.asarray(
        np.maximum(np.linalg.norm(there - target, axis=1), np.linalg.norm(here - source, axis=1))
    )
