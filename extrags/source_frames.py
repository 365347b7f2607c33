"""Which frames each frame is compared with: those that see the same surface from another place."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

__all__ = ["select_sources"]

BEST_ANGLE_DEG = 10.0
"""Angle between two views' rays to the surface that matches best: larger ones change what is seen."""

ANGLE_SPREAD = 0.9
"""Standard deviation, of the angle's logarithm, of the preference for `BEST_ANGLE_DEG`."""

MAX_TURN_DEG = 60.0
"""Frames whose optical axes differ by more share too little."""

AT_ONCE = 64
"""Candidates that are compared with a frame together."""


def select_sources(
    world_from_camera: Float[np.ndarray, "f 4 4"],
    K: Float[np.ndarray, "f 3 3"],
    size: tuple[int, int],
    typical_depth: Float[np.ndarray, "f"],
    count: int,
    which: Int[np.ndarray, "k"] | None = None,
) -> Int[np.ndarray, "f s"]:
    """The frames that each frame is matched with: shared view times a triangulation angle near ten degrees.

    Views are compared by points in front of the reference at half, once and twice its typical depth. What
    is chosen lies on different sides of the reference where it can: the score of a candidate falls with
    its closeness to those already chosen.

    Args:
        world_from_camera: poses.
        K: intrinsics in pixels.
        size: height and width in pixels.
        typical_depth: median depth of each frame, in the poses' unit.
        count: S, at most one less than the frames.
        which: frames that are asked for, the others have none; None: all.

    Returns:
        Indices of frames, the best first; -1 where there are fewer than S useful ones.
    """
    height, width = size
    frames = len(world_from_camera)
    chosen = np.full((frames, max(0, min(count, frames - 1))), -1, dtype=np.int64)
    columns, rows = np.meshgrid((np.arange(7) + 0.5) / 7 * width, (np.arange(5) + 0.5) / 5 * height)
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], axis=1)
    centers, axes = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    from_world = np.linalg.inv(world_from_camera)
    for frame in range(frames) if which is None else which.tolist():
        rays = pixels @ np.linalg.inv(K[frame]).T
        shells = np.concatenate([rays * typical_depth[frame] * share for share in (0.6, 1.0, 1.7)])
        points = shells @ world_from_camera[frame, :3, :3].T + centers[frame]
        baseline = np.linalg.norm(centers - centers[frame], axis=1)
        turn = np.degrees(np.arccos(np.clip(axes @ axes[frame], -1, 1)))
        candidate = (baseline > 1e-9 * typical_depth[frame]) & (turn <= MAX_TURN_DEG)
        candidate[frame] = False
        scores = np.zeros(frames)
        candidates = np.flatnonzero(candidate)
        # Not all at once: of many frames, what lies between would not fit into the processor's caches.
        for some in np.array_split(candidates, -(-len(candidates) // AT_ONCE)) if len(candidates) else ():
            of_some = points, centers[frame], centers[some], from_world[some], K[some]
            scores[some] = _shared_views(*of_some, width, height)
        for slot in range(chosen.shape[1]):
            best = int(np.argmax(scores))
            if scores[best] < 1e-3:
                break
            chosen[frame, slot] = best
            toward = centers[best] - centers[frame]
            offset = centers - centers[best]
            near = np.linalg.norm(offset, axis=1) / (np.linalg.norm(toward) + 1e-12)
            scores *= 1 - 0.6 * np.exp(-0.5 * (near / 0.5) ** 2)
            scores[best] = 0
    return chosen


def _shared_views(
    points: Float[np.ndarray, "n 3"],
    center: Float[np.ndarray, "3"],
    centers: Float[np.ndarray, "k 3"],
    from_world: Float[np.ndarray, "k 4 4"],
    K: Float[np.ndarray, "k 3 3"],
    width: int,
    height: int,
) -> Float[np.ndarray, "k"]:
    """How well candidates match a frame: the mean worth of angles, which is 0 where they do not see a point.

    Args:
        points: in world coordinates.
        center: of the frame.
        centers: of the candidates.
        from_world: camera-from-world poses of the candidates.
        K: intrinsics of the candidates in pixels.
        width: of all images in pixels.
        height: of all images in pixels.
    """
    local = points @ from_world[:, :3, :3].transpose(0, 2, 1) + from_world[:, None, :3, 3]
    z = np.maximum(local[..., 2], 1e-9)
    u = K[:, None, 0, 0] * local[..., 0] / z + K[:, None, 0, 2]
    v = K[:, None, 1, 1] * local[..., 1] / z + K[:, None, 1, 2]
    seen = (local[..., 2] > 1e-6) & (u > 0) & (u < width) & (v > 0) & (v < height)
    to_first, to_second = points - center, points - centers[:, None]
    cosine = np.einsum("ni,kni->kn", to_first, to_second)
    cosine /= np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_second, axis=2) + 1e-12
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    worth = np.exp(-0.5 * (np.log(np.maximum(angle, 1e-6) / BEST_ANGLE_DEG) / ANGLE_SPREAD) ** 2)
    return np.asarray((worth * seen).mean(axis=1))
