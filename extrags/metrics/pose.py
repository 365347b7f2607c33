"""Errors of camera poses: alignment, absolute and relative trajectory error.

Poses are `world_from_camera`, OpenCV axes. Source: Sturm, Engelhard, Endres, Burgard, Cremers: A
Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from extrags.cameras import invert_poses, rotation_angle_deg
from extrags.errors import ConfigError, NonFiniteError, ShapeError

__all__ = [
    "Alignment",
    "RelativePoseErrors",
    "Similarity",
    "TrajectoryErrors",
    "absolute_trajectory_error",
    "relative_pose_error",
    "umeyama",
]

Alignment = Literal["sim3", "se3", "none"]


@dataclass(frozen=True)
class Similarity:
    """A similarity transform: `target = scale * rotation @ source + translation`.

    Args:
        scale: above zero.
        rotation: [3, 3], det +1.
        translation: [3].
    """

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Transform points."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.translation)

    def apply_to_poses(self, world_from_camera: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Transform camera poses; they remain rigid motions, only their centres are scaled."""
        moved = world_from_camera.astype(np.float64, copy=True)
        moved[:, :3, :3] = self.rotation @ world_from_camera[:, :3, :3]
        moved[:, :3, 3] = self.apply(world_from_camera[:, :3, 3])
        return moved


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Distances between camera centres after alignment, in the unit of the true poses."""

    rmse: float
    mean: float
    median: float
    max: float
    rotation_mean_deg: float
    """Mean angle between the orientations after alignment."""


@dataclass(frozen=True, slots=True)
class RelativePoseErrors:
    """Errors of the relative motion over a fixed number of frames (drift)."""

    translation_rmse: float
    rotation_rmse_deg: float
    n_pairs: int


def umeyama(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], *, with_scale: bool = True
) -> Similarity:
    """Least-squares similarity (or rigid motion) between two point sets.

    For collinear points the rotation about their line is undetermined; one of the optimal motions is
    returned.

    Args:
        source: points to move.
        target: where they should be, in the same order.
        with_scale: False keeps the scale at 1.

    Raises:
        ShapeError: for fewer than three points, or different numbers of them.
        NonFiniteError: for NaN or infinity.

    Source: Umeyama: Least-squares estimation of transformation parameters between two point patterns,
    TPAMI 13(4), 1991, equations 40 to 42.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[0] < 3:
        raise ShapeError(
            f"an alignment needs the same three or more points twice; found {source.shape} and {target.shape}"
        )
    for name, points in (("source", source), ("target", target)):
        if not np.isfinite(points).all():
            raise NonFiniteError(f"the {name} points of an alignment hold NaN or infinity")
    mean_source, mean_target = source.mean(0), target.mean(0)
    from_source, from_target = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd(from_target.T @ from_source / len(source))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    spread = float((from_source**2).sum() / len(source))
    scale = float((singular * signs).sum() / spread) if with_scale and spread > 0 else 1.0
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def absolute_trajectory_error(
    estimated: Float[np.ndarray, "n 4 4"],
    truth: Float[np.ndarray, "n 4 4"],
    alignment: Alignment = "sim3",
) -> TrajectoryErrors:
    """Distances between estimated and true camera centres after aligning the centres.

    Args:
        estimated: `world_from_camera` of each frame.
        truth: the same frames.
        alignment: `sim3` for poses without a known scale, `se3` for metric ones, `none` for poses that
            should already stand in the true frame.

    Raises:
        ShapeError: for no poses, fewer than three that are to be aligned, or different numbers of them.
        NonFiniteError: for NaN or infinity.
        ConfigError: for an unknown alignment.
    """
    aligned = _aligned(estimated, truth, alignment)
    distances = np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)
    angles = rotation_angle_deg(aligned[:, :3, :3], np.asarray(truth[:, :3, :3], dtype=np.float64))
    return TrajectoryErrors(
        rmse=float(np.sqrt(np.mean(distances**2))),
        mean=float(distances.mean()),
        median=float(np.median(distances)),
        max=float(distances.max()),
        rotation_mean_deg=float(angles.mean()),
    )


def relative_pose_error(
    estimated: Float[np.ndarray, "n 4 4"],
    truth: Float[np.ndarray, "n 4 4"],
    *,
    frames_apart: int = 1,
    alignment: Alignment = "sim3",
) -> RelativePoseErrors:
    """Errors of the motion between each frame and the one `frames_apart` later.

    Args:
        estimated: `world_from_camera` of each frame, in the order of time.
        truth: the same frames.
        frames_apart: length of the motions.
        alignment: only its scale matters here; `se3` and `none` give the same errors.

    Raises:
        ShapeError: when there are too few poses, or different numbers of them.
        NonFiniteError: for NaN or infinity.
        ConfigError: for `frames_apart` below 1 or an unknown alignment.
    """
    if frames_apart < 1:
        raise ConfigError(f"frames_apart must be at least 1, found {frames_apart}")
    if len(estimated) <= frames_apart:
        raise ShapeError(f"no two of {len(estimated)} poses are {frames_apart} frames apart")
    aligned = _aligned(estimated, truth, alignment)

    def motions(poses: np.ndarray) -> np.ndarray:
        return np.asarray(invert_poses(poses[:-frames_apart]) @ poses[frames_apart:])

    error = invert_poses(motions(np.asarray(truth, dtype=np.float64))) @ motions(aligned)
    angles = rotation_angle_deg(error[:, :3, :3], np.broadcast_to(np.eye(3), error[:, :3, :3].shape))
    return RelativePoseErrors(
        translation_rmse=float(np.sqrt(np.mean((error[:, :3, 3] ** 2).sum(1)))),
        rotation_rmse_deg=float(np.sqrt(np.mean(angles**2))),
        n_pairs=len(error),
    )


def _aligned(estimated: np.ndarray, truth: np.ndarray, alignment: Alignment) -> np.ndarray:
    if estimated.shape != truth.shape:
        raise ShapeError(f"{estimated.shape} estimated poses do not fit {truth.shape} true ones")
    if len(truth) == 0:
        raise ShapeError("there is no pose to compare")
    if alignment not in ("sim3", "se3", "none"):
        raise ConfigError(f"no alignment {alignment!r}; known: sim3, se3, none")
    for name, poses in (("estimated", estimated), ("true", truth)):
        if not np.isfinite(poses).all():
            raise NonFiniteError(f"the {name} poses hold NaN or infinity")
    if alignment == "none":
        return np.asarray(estimated, dtype=np.float64)
    similarity = umeyama(
        np.asarray(estimated[:, :3, 3], dtype=np.float64),
        np.asarray(truth[:, :3, 3], dtype=np.float64),
        with_scale=alignment == "sim3",
    )
    return similarity.apply_to_poses(np.asarray(estimated, dtype=np.float64))
