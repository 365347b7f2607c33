"""Consistency of poses with feature matches.

Features are matched between neighbouring frames; a match supports the poses when it lies near its epipolar
line and its point in front of both cameras. The same is counted for other readings of the axes.

Source: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004 (features, ratio test);
Hartley and Zisserman, "Multiple view geometry", 2003, section 11.4 (Sampson distance).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_catalog.checks import neighbouring_frames
from data_catalog.pose_conventions import OPENCV, PoseConvention, other_readings
from extrags.cameras import invert_poses, unproject_pixels
from extrags.sequence import EndoscopicSequence

__all__ = ["FrameMatches", "PoseSupport", "match_neighbours", "pose_support"]

_FEATURES = 1500
_CONTRAST = 0.005
_RATIO = 0.75
_NEAR_SHARE = 0.004
"""A match this near its epipolar line (share of the width, at least 1.5 px) supports the poses."""
_MIN_MATCHES = 12


@dataclass(frozen=True)
class FrameMatches:
    """Features found in two frames.

    Args:
        first: index of a frame.
        second: index of the other.
        first_px: [M, 2], centres at +0.5.
        second_px: [M, 2].
    """

    first: int
    second: int
    first_px: Float[np.ndarray, "m 2"]
    second_px: Float[np.ndarray, "m 2"]


@dataclass(frozen=True)
class PoseSupport:
    """How well poses explain matches.

    Args:
        matches: how many there are, all pairs together.
        as_given: share that supports the poses as they are.
        best: largest share of any reading.
        best_name: that reading; empty where it is the given one.
        distance: median depth of the supporting matches' points, in the unit of the poses; 0 without any.
    """

    matches: int
    as_given: float
    best: float
    best_name: str
    distance: float


def match_neighbours(sequence: EndoscopicSequence, pairs: int = 6) -> list[FrameMatches]:
    """SIFT matches of neighbouring frames, spread over the sequence; pairs with few matches are left out."""
    import cv2

    detector = cv2.SIFT.create(_FEATURES, contrastThreshold=_CONTRAST)
    found: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}

    def features(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        if index not in found:
            grey = cv2.cvtColor(sequence.rgb[index], cv2.COLOR_RGB2GRAY)
            keypoints, descriptors = detector.detectAndCompute(
                grey, (sequence.mask[index] * 255).astype(np.uint8)
            )
            # OpenCV counts from pixel centres.
            located = np.array([point.pt for point in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
            found[index] = (located, descriptors)
        return found[index]

    matches = []
    for first, second in neighbouring_frames(sequence, pairs):
        (here, mine), (there, theirs) = features(first), features(second)
        if mine is None or theirs is None or len(theirs) < 2:
            continue
        candidates = cv2.BFMatcher().knnMatch(mine, theirs, k=2)
        good = [best for best, other in candidates if best.distance < _RATIO * other.distance]
        if len(good) >= _MIN_MATCHES:
            matches.append(
                FrameMatches(
                    first,
                    second,
                    here[[match.queryIdx for match in good]],
                    there[[match.trainIdx for match in good]],
                )
            )
    return matches


def pose_support(
    sequence: EndoscopicSequence, matches: list[FrameMatches], stored: PoseConvention = OPENCV
) -> PoseSupport:
    """Count the matches that support the poses as given, and in every other reading of the axes.

    Args:
        sequence: with poses.
        matches: what `match_neighbours` found.
        stored: how the file should hold poses, in whose words a reading is named.
    """
    poses = np.asarray(sequence.cameras.world_from_camera, dtype=np.float64)
    total = sum(len(match.first_px) for match in matches)
    if not total:
        return PoseSupport(0, 0.0, 0.0, "", 0.0)
    supporting, depths = _supporting(sequence, poses, matches)
    distance = float(np.median(depths)) if depths.size else 0.0
    as_given = best = supporting / total
    best_name = ""
    for name, read in other_readings(poses, stored):
        share = _supporting(sequence, read, matches)[0] / total
        if share > best:
            best, best_name = share, name
    return PoseSupport(total, as_given, best, best_name, distance)


def _supporting(
    sequence: EndoscopicSequence, poses: Float[np.ndarray, "f 4 4"], matches: list[FrameMatches]
) -> tuple[int, Float[np.ndarray, "s"]]:
    near = max(1.5, _NEAR_SHARE * sequence.width)
    count, depths = 0, []
    for match in matches:
        relative = invert_poses(poses[match.second][None])[0] @ poses[match.first]
        rotation, shift = relative[:3, :3], relative[:3, 3]
        K_first, K_second = sequence.K[match.first], sequence.K[match.second]
        here = unproject_pixels(match.first_px, K_first, sequence.lens)
        there = unproject_pixels(match.second_px, K_second, sequence.lens)
        length = float(np.linalg.norm(shift))
        if length < 1e-12:
            continue
        cross = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
        essential = cross @ rotation / length
        to_second, to_first = here @ essential.T, there @ essential
        residual = np.abs((there * to_second).sum(axis=1))
        slope = np.sqrt(
            (to_second[:, :2] ** 2).sum(axis=1) / K_second[0, 0] ** 2
            + (to_first[:, :2] ** 2).sum(axis=1) / K_first[0, 0] ** 2
        )
        close = residual / np.maximum(slope, 1e-12) < near
        # Depths a, b with a R here + shift = b there, by least squares.
        turned = here @ rotation.T
        aa, ab, bb = (turned**2).sum(1), (turned * there).sum(1), (there**2).sum(1)
        ca, cb = turned @ shift, there @ shift
        determinant = np.maximum(aa * bb - ab * ab, 1e-15)
        first_depth = (-bb * ca + ab * cb) / determinant
        second_depth = (aa * cb - ab * ca) / determinant
        supports = close & (first_depth > 0) & (second_depth > 0)
        count += int(supports.sum())
        depths.append(first_depth[supports])
    return count, np.concatenate(depths) if depths else np.zeros(0)
