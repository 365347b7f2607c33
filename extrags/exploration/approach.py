"""Straight ways to destinations that are worth more for each view than the moves from where the camera is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import rotation_angle_deg
from extrags.exploration.measurements import Destinations
from extrags.exploration.primitives import orthonormalised
from extrags.exploration.seen import Value

__all__ = ["Approaches", "straight_way"]

MAX_TRIED = 12
"""Destinations tried from one view; the first that can be reached is taken."""


class Approaches:
    """Destinations of one branch, with upper bounds of what they are worth.

    What a view is worth only falls as more becomes known, so the worth at the start of the branch bounds
    that at every state of it, and is measured anew only for destinations that could still be the best
    (Minoux 1978).

    Args:
        destinations: views a path may make for.
        value: what newly shown rows are worth.
        coverage: what is known at the start of the branch, [R].
        step_mm: longest step between two views.
        turn_deg: largest turn between two views.
    """

    def __init__(
        self,
        destinations: Destinations,
        value: Value,
        coverage: np.ndarray,
        *,
        step_mm: float,
        turn_deg: float,
    ) -> None:
        self.destinations = destinations
        self.value = value
        self.step_mm = step_mm
        self.turn_deg = turn_deg
        self.bounds = np.array([value.gain(coverage, destinations.seen(i)) for i in range(len(destinations))])

    def better(
        self, pose: Float[np.ndarray, "4 4"], known: np.ndarray, left: int, least: float
    ) -> Iterator[tuple[float, Float[np.ndarray, "k 4 4"]]]:
        """Ways that are worth more than `least` for each view, the best first; not tested for obstacles.

        Args:
            pose: `world_from_camera` to start from.
            known: what is known there, [R].
            left: views that the trajectory may still have.
            least: worth of the best single move.

        Yields:
            What the destination is worth divided by the number of views to it, and their poses.
        """
        views = self._views_to(pose)
        bounds = np.where(views <= left, self.bounds / views, 0.0)
        order = np.argsort(-bounds, kind="stable")
        rates: dict[int, float] = {}
        tried = 0
        position = 0
        while tried < MAX_TRIED:
            # Lazily: the best rate that is known holds against the next bound, or that is measured first.
            top = max(rates, key=lambda index: (rates[index], -index), default=None)
            if position < len(order) and bounds[order[position]] > max(
                least, -np.inf if top is None else rates[top]
            ):
                index = int(order[position])
                rates[index] = self.value.gain(known, self.destinations.seen(index)) / views[index]
                position += 1
                continue
            if top is None or rates[top] <= least:
                return
            yield rates.pop(top), straight_way(pose, self.destinations.poses[top], int(views[top]))
            tried += 1

    def _views_to(self, pose: Float[np.ndarray, "4 4"]) -> Int[np.ndarray, "p"]:
        """How many views a straight way to each destination takes."""
        poses = self.destinations.poses
        steps = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) / self.step_mm
        here = np.broadcast_to(pose[:3, :3], (len(poses), 3, 3))
        turns = rotation_angle_deg(here, poses[:, :3, :3]) / self.turn_deg
        # A hair less: a way of exactly two steps takes two views, whatever the rounding.
        return np.asarray(np.maximum(1, np.ceil(np.maximum(steps, turns) - 1e-6)), dtype=np.int64)


def straight_way(
    start: Float[np.ndarray, "4 4"], end: Float[np.ndarray, "4 4"], views: int
) -> Float[np.ndarray, "k 4 4"]:
    """Poses at equal steps and turns from one pose to another, the first left out.

    Args:
        start: `world_from_camera`.
        end: `world_from_camera` of the last view.
        views: how many.
    """
    from scipy.spatial.transform import Rotation

    share = np.arange(1, views + 1) / views
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    poses = np.broadcast_to(np.eye(4), (views, 4, 4)).copy()
    poses[:, :3, :3] = orthonormalised(
        start[:3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    )
    poses[:, :3, 3] = start[:3, 3] + share[:, None] * (end[:3, 3] - start[:3, 3])
    return poses
