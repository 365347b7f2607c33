"""Initial poses of frames with depth, from features shared with other frames.

`alignment` refines them and decides which one is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import invert_poses, unproject_pixels
from extrags.metrics.pose import umeyama
from extrags.sequence import EndoscopicSequence

__all__ = ["Landmarks", "landmarks", "match_landmarks", "relative_pose"]

FEATURES = 1500
CONTRAST = 0.004
RATIO = 0.9
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
    """SIFT features of a frame, inside the mask and where depth is known.

    Source: Lowe: Distinctive image features from scale-invariant keypoints, IJCV 2004; root of the
    descriptors: Arandjelović and Zisserman, CVPR 2012.
    """
    import cv2

    nothing = Landmarks(np.zeros((0, 3)), np.zeros((0, 128), np.float32))
    if sequence.depth_mm is None:
        return nothing
    depth = sequence.depth_mm[frame]
    told = sequence.supervised_mask(frame) & (depth > 0) & np.isfinite(depth)
    grey = cv2.cvtColor(np.ascontiguousarray(sequence.rgb[frame]), cv2.COLOR_RGB2GRAY)
    # Mucosa is pale and unevenly lit: contrast is raised block by block.
    grey = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(grey)
    finder = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=CONTRAST, edgeThreshold=20)  # type: ignore[attr-defined]
    keypoints, descriptors = finder.detectAndCompute(grey, told.astype(np.uint8) * 255)
    if descriptors is None or len(keypoints) == 0:
        return nothing
    pixels = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
    column = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, sequence.width - 1)
    row = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, sequence.height - 1)
    kept = told[row, column]
    # Threads find features in any order.
    order = np.lexsort((descriptors[:, 0], descriptors[:, 1], pixels[:, 0], pixels[:, 1]))
    order = order[kept[order]]
    z = depth[row, column].astype(np.float64)
    points = unproject_pixels(pixels, sequence.K[frame]) * z[:, None]
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return Landmarks(points[order], roots[order].astype(np.float32))


def match_landmarks(first: Landmarks, second: Landmarks) -> Int[np.ndarray, "m 2"]:
    """Rows that are each other's nearest and clearly nearer than the second nearest."""
    if len(first.points) < 2 or len(second.points) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    likeness = first.descriptors @ second.descriptors.T
    best = likeness.argmax(1)
    mutual = likeness.argmax(0)[best] == np.arange(len(best))
    two = -np.partition(-likeness, 1, axis=1)[:, :2]
    distance = np.sqrt(np.clip(2 - 2 * two, 1e-12, None))
    kept = np.flatnonzero(mutual & (distance[:, 0] < RATIO * distance[:, 1]))
    return np.stack([kept, best[kept]], axis=1)


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
    matches = match_landmarks(moving, reference)
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
