"""Small corrections of the training frames' poses, learned together with the Gaussians.

A frame's rotation and centre are corrected apart: `R = exp(turn) R0`, `c = c0 + shift`, both in world axes.
Corrections that translate, rotate or scale all frames together have no effect on the images, since the
Gaussians follow; they are projected out after every step (the gauge), so the world frame stays fixed. Images
of held-out frames are never used; where poses were estimated, `with_refined_poses` moves these frames with
the training frames next to them, since they were registered in the same map and share its distortions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from extrags.cameras import Cameras, invert_poses
from extrags.config import PoseRefinementConfig
from extrags.errors import ShapeError
from extrags.sequence import EndoscopicSequence
from extrags.store.storable import Storable
from extrags.training.starting import median_depth
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["TRIAL_UPDATES", "PoseRefinement", "RefinedPoses", "with_refined_poses"]

PRIOR_TURN_RAD = math.radians(1.0)
PRIOR_SHIFT_SHARE = 0.01
BETAS = (0.9, 0.99)
"""A frame is drawn once in an epoch: its own Adam must not remember longer than that lasts."""
EPSILON = 1e-15
TRIAL_UPDATES = 10
"""Of each pose before it is decided: after fewer, corrections say more of their number than of the poses."""
NEIGHBOURHOOD = 0.3
"""Range, in median depths or radians, within which training frames move a held-out frame with them."""


@dataclass(frozen=True)
class RefinedPoses(Storable):
    """Poses after refinement.

    Args:
        world_from_camera: of the frames trained on, [M, 4, 4].
        mean_shift: mean length of the corrections of the centres, in world units.
        mean_turn_deg: mean angle of the corrections of the rotations.
    """

    stored_as: ClassVar[str] = "refined_poses"

    world_from_camera: Float[np.ndarray, "m 4 4"]
    mean_shift: float
    mean_turn_deg: float

    def save(self, path: Path) -> None:
        """Write a zarr v3 group."""
        with new_group(path) as group:
            write_array(group, "world_from_camera", self.world_from_camera)
            group.attrs.update({"mean_shift": self.mean_shift, "mean_turn_deg": self.mean_turn_deg})

    @classmethod
    def load(cls, path: Path) -> RefinedPoses:
        """Read what `save` wrote."""
        group = open_group(path)
        attributes: dict[str, Any] = dict(group.attrs)
        return cls(read_array(group, "world_from_camera"), **attributes)


class PoseRefinement:
    """Holds the corrections of all training frames and moves one of them along its gradient.

    `corrections` [M, 6] are turns in radians and shifts in depths, all zero at the start.

    Args:
        cameras: training frames as they were given, in the order of `View.frame`.
        config: rates and prior.
        depth: median depth of the scene: the length a turn of one radian is compared with.
        iterations: of the whole optimisation.
        tried: whether corrections that stay small are taken back (`PoseRefinementConfig.trial_share`).
    """

    def __init__(
        self,
        cameras: Cameras,
        config: PoseRefinementConfig,
        depth: float,
        iterations: int,
        *,
        tried: bool = False,
    ) -> None:
        self._config, self._depth, self._iterations = config, depth, iterations
        self._start = int(config.start_share * iterations)
        # At the last iteration at the latest.
        self._decided_at = min(math.ceil(config.trial_share * iterations), iterations - 1) if tried else None
        self.kept = True
        self._given = cameras.world_from_camera.astype(np.float64)
        self._focal_px = float(cameras.K[:, [0, 1], [0, 1]].mean())
        count = len(cameras)
        # Turns in radians and shifts in depths: one rate serves both.
        self.corrections = np.zeros((count, 6))
        self._mean, self._square = np.zeros((count, 6)), np.zeros((count, 6))
        self._steps = np.zeros(count, dtype=np.int64)
        self._gauge = _gauge(cameras.centers / depth)

    def active(self, iteration: int) -> bool:
        """Whether poses move at an iteration.

        Before some, the Gaussians settle on the given ones; after a trial that found little, they stay.
        """
        if iteration == self._decided_at and self._small:
            self.kept = False
            self.corrections[:] = 0
        return self.kept and iteration >= self._start

    @property
    def mean_correction_deg(self) -> float:
        """Mean over the frames of turn and shift together, as the angle that the image shows.

        A shift counts as the angle under which it is seen from the median depth.
        """
        return float(np.degrees(np.linalg.norm(self.corrections, axis=1)).mean())

    @property
    def _small(self) -> bool:
        found_px = math.radians(self.mean_correction_deg) * self._focal_px
        # Not what is not a number either.
        return not (
            self.mean_correction_deg >= self._config.kept_from_deg and found_px >= self._config.kept_from_px
        )

    def viewmat(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Camera from world of a training frame as it stands now, float64."""
        return np.asarray(invert_poses(self._corrected(np.array([frame])))[0])

    def step(self, frame: int, viewmat_gradient: Float[np.ndarray, "4 4"], iteration: int) -> None:
        """Move the pose of the frame just drawn.

        Args:
            frame: position among the training frames.
            viewmat_gradient: of the loss with respect to what `viewmat` gave.
            iteration: sets the learning rate.
        """
        config = self._config
        scale = np.repeat([PRIOR_TURN_RAD, PRIOR_SHIFT_SHARE], 3)
        gradient = self.gradient(frame, viewmat_gradient)
        gradient += 2 * config.prior * self.corrections[frame] / scale**2 / 6
        self._steps[frame] += 1
        first, second = BETAS
        self._mean[frame] += (1 - first) * (gradient - self._mean[frame])
        # One size of step for the three turns, and one for the shifts: their directions are arbitrary.
        size = np.repeat((gradient**2).reshape(2, 3).mean(1), 3)
        self._square[frame] += (1 - second) * (size - self._square[frame])
        done = int(self._steps[frame])
        mean = self._mean[frame] / (1 - first**done)
        square = self._square[frame] / (1 - second**done)
        self.corrections[frame] -= self._rate(iteration) * mean / (np.sqrt(square) + EPSILON)
        self.corrections -= (self._gauge @ (self._gauge.T @ self.corrections.reshape(-1))).reshape(-1, 6)

    def gradient(self, frame: int, viewmat_gradient: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
        """From the view matrix to turn (radians) and shift (depths) of a frame."""
        given = np.asarray(viewmat_gradient, dtype=np.float64)
        pose = self._corrected(np.array([frame]))[0]
        rotation, centre = pose[:3, :3], pose[:3, 3]
        # With V = [R^T | -R^T c] and R -> exp(w) R, c -> c + t at w = t = 0.
        turned = rotation @ given[:3, :3]
        pushed = rotation @ given[:3, 3]
        vee = np.array(
            [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
        )
        turn = np.cross(centre, pushed) - vee
        # exp(x + dx) = exp(J dx) exp(x).
        turn = _left_jacobian(self.corrections[frame, :3]).T @ turn
        return np.concatenate([turn, -pushed * self._depth])

    def refined(self) -> RefinedPoses:
        """All poses as they stand now."""
        return RefinedPoses(
            world_from_camera=self._corrected(np.arange(len(self.corrections))),
            mean_shift=float(np.linalg.norm(self.corrections[:, 3:], axis=1).mean() * self._depth),
            mean_turn_deg=float(np.degrees(np.linalg.norm(self.corrections[:, :3], axis=1)).mean()),
        )

    def _corrected(self, frames: np.ndarray) -> np.ndarray:
        poses = self._given[frames].copy()
        x = self.corrections[frames]
        poses[:, :3, :3] = Rotation.from_rotvec(x[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += x[:, 3:] * self._depth
        return np.asarray(poses)

    def _rate(self, iteration: int) -> float:
        share = (iteration - self._start) / max(1, self._iterations - self._start)
        first, last = self._config.learning_rate, self._config.learning_rate_final
        return math.exp((1 - share) * math.log(first) + share * math.log(last))


def with_refined_poses(
    sequence: EndoscopicSequence, refined: Float[np.ndarray, "m 4 4"]
) -> EndoscopicSequence:
    """A sequence with the training poses that a reconstruction has corrected, to which its scene belongs.

    Held-out poses that the source gave stay: all methods are evaluated at these. Where they were estimated,
    the correction of one is the mean of the training frames' corrections, weighted by how near they are and
    how similar their directions are. Its image is not used.

    Args:
        sequence: whose training frames, in order, were refined.
        refined: their new poses.

    Raises:
        ShapeError: when there are not as many poses as training frames.
    """
    train, given = sequence.train, sequence.cameras.world_from_camera
    if len(refined) != len(train):
        raise ShapeError(f"{sequence.name}: {len(refined)} refined poses for {len(train)} training frames")
    poses = given.copy()
    poses[train] = refined
    before = given[train]
    turns = Rotation.from_matrix(refined[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)).as_rotvec()
    shifts = refined[:, :3, 3] - before[:, :3, 3]
    unit = median_depth(sequence, train)
    for frame in () if sequence.pose_source == "given" else sequence.test:
        apart = np.linalg.norm(before[:, :3, 3] - given[frame, :3, 3], axis=1) / unit
        angle = np.arccos(np.clip(before[:, :3, 2] @ given[frame, :3, 2], -1, 1))
        distance = apart**2 + angle**2
        weight = np.exp(-(distance - distance.min()) / (2 * NEIGHBOURHOOD**2))
        weight /= weight.sum()
        poses[frame, :3, :3] = Rotation.from_rotvec(weight @ turns).as_matrix() @ given[frame, :3, :3]
        poses[frame, :3, 3] += weight @ shifts
    return sequence.with_poses(poses, "refined")


def _gauge(centres: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the corrections that only move, turn or scale the whole, [6 m, 7 or fewer]."""
    count = len(centres)
    arm = centres - centres.mean(axis=0)
    basis = np.zeros((count, 6, 7))
    for axis in range(3):
        unit = np.eye(3)[axis]
        basis[:, 3:, axis] = unit
        basis[:, :3, 3 + axis] = unit
        basis[:, 3:, 3 + axis] = np.cross(unit, arm)
    basis[:, 3:, 6] = arm
    u, singular, _ = np.linalg.svd(basis.reshape(6 * count, 7), full_matrices=False)
    return np.asarray(u[:, singular > 1e-9 * singular[0]])


def _left_jacobian(turn: np.ndarray) -> np.ndarray:
    """Of the exponential map of rotations."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-6:
        return np.asarray(np.eye(3) + cross / 2)
    first = (1 - math.cos(angle)) / angle**2
    second = (angle - math.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))
