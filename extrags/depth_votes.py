"""What other frames say of a frame's measured depth: they look through a point, or have the surface there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from extrags.cameras import project_points, transform_points, unproject_pixels
from extrags.carried_depth import CarriedDepth

__all__ = ["DepthVotes", "depth_votes"]


class DepthVotes(NamedTuple):
    """Numbers of other frames, for each point of a frame.

    Args:
        looks_through: those that see the surface behind the point.
        clearly: those of them that see it far behind.
        supports: those that have the surface where the point is.
    """

    looks_through: Int[np.ndarray, "p"]
    clearly: Int[np.ndarray, "p"]
    supports: Int[np.ndarray, "p"]


def depth_votes(
    carried: CarriedDepth,
    position: int,
    others: list[int],
    pixels: tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]],
    in_front: float,
    far_in_front: float,
) -> DepthVotes:
    """What frames say of pixels of another one.

    A frame looks through a point where all four pixels round its place have a surface behind it. Between the
    nearest and the farthest of these may be an edge: anything from the one to the other supports a point.

    Args:
        carried: depth of the training frames, on its grid.
        position: of the frame, among the training frames.
        others: positions of the frames that are asked.
        pixels: rows and columns on the grid, of pixels whose depth is known.
        in_front: log-ratio of the surface's depth to a point's from which on it lies behind the point.
        far_in_front: from which on it does so clearly.
    """
    cameras, poses = carried.cameras, carried.cameras.world_from_camera
    rows, columns = pixels
    z = carried.known(position)[rows, columns]
    centers = np.stack([columns, rows], axis=1) + 0.5
    points = unproject_pixels(centers, cameras.K[position], cameras.lens) * z[:, None]
    looks_through, clearly, supports = np.zeros((3, len(z)), dtype=np.int64)
    for other in others:
        motion = np.linalg.inv(poses[other]) @ poses[position]
        there = transform_points(motion, points)
        place = project_points(there, cameras.K[other], cameras.lens) - 0.5
        with np.errstate(invalid="ignore"):
            inside = (place >= 0).all(1) & (place < (cameras.width - 1, cameras.height - 1)).all(1)
        column, row = np.floor(place[inside]).astype(np.int64).T
        surface = carried.known(other)
        corners = np.stack([surface[row + j, column + i] for j in (0, 1) for i in (0, 1)])
        measured = (corners > 0).all(0)
        which, reached = np.flatnonzero(inside)[measured], there[inside, 2][measured]
        nearest, farthest = (np.log(end[measured] / reached) for end in (corners.min(0), corners.max(0)))
        looks_through[which] += nearest > in_front
        clearly[which] += nearest > far_in_front
        supports[which] += (nearest <= in_front) & (farthest >= -in_front)
    return DepthVotes(looks_through, clearly, supports)
