"""The choice of sources, against its definition one pair of frames after the other."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float, Int

from extrags.cameras import rotation_about
from extrags.source_frames import ANGLE_SPREAD, BEST_ANGLE_DEG, MAX_TURN_DEG, select_sources

SIZE = (64, 96)


def pair_by_pair(
    world_from_camera: Float[np.ndarray, "f 4 4"],
    K: Float[np.ndarray, "f 3 3"],
    typical_depth: np.ndarray,
    count: int,
) -> Int[np.ndarray, "f s"]:
    """`select_sources` without any vectors over frames."""
    (height, width), frames = SIZE, len(K)
    chosen = np.full((frames, max(0, min(count, frames - 1))), -1, dtype=np.int64)
    columns, rows = np.meshgrid((np.arange(7) + 0.5) / 7 * width, (np.arange(5) + 0.5) / 5 * height)
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], axis=1)
    centers, axes = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    for frame in range(frames):
        rays = pixels @ np.linalg.inv(K[frame]).T
        shells = np.concatenate([rays * typical_depth[frame] * share for share in (0.6, 1.0, 1.7)])
        points = shells @ world_from_camera[frame, :3, :3].T + centers[frame]
        scores = np.zeros(frames)
        for other in range(frames):
            baseline = float(np.linalg.norm(centers[other] - centers[frame]))
            turn = np.degrees(np.arccos(np.clip(axes[frame] @ axes[other], -1, 1)))
            if other == frame or baseline <= 1e-9 * typical_depth[frame] or turn > MAX_TURN_DEG:
                continue
            from_world = np.linalg.inv(world_from_camera[other])
            local = points @ from_world[:3, :3].T + from_world[:3, 3]
            z = np.maximum(local[:, 2], 1e-9)
            u = K[other, 0, 0] * local[:, 0] / z + K[other, 0, 2]
            v = K[other, 1, 1] * local[:, 1] / z + K[other, 1, 2]
            seen = (local[:, 2] > 1e-6) & (u > 0) & (u < width) & (v > 0) & (v < height)
            first, second = points - centers[frame], points - centers[other]
            lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
            cosine = (first * second).sum(axis=1) / (lengths + 1e-12)
            angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            away = np.log(np.maximum(angle, 1e-6) / BEST_ANGLE_DEG) / ANGLE_SPREAD
            scores[other] = float((np.exp(-0.5 * away**2) * seen).mean())
        for slot in range(chosen.shape[1]):
            best = int(np.argmax(scores))
            if scores[best] < 1e-3:
                break
            chosen[frame, slot] = best
            near = np.linalg.norm(centers - centers[best], axis=1)
            near /= np.linalg.norm(centers[best] - centers[frame]) + 1e-12
            scores *= 1 - 0.6 * np.exp(-0.5 * (near / 0.5) ** 2)
            scores[best] = 0
    return chosen


@pytest.mark.parametrize("frames", [1, 2, 30, 80])
def test_as_pair_by_pair(frames: int) -> None:
    rng = np.random.default_rng(frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = rng.normal(0, 4, (frames, 3))
    for pose in poses:
        pose[:3, :3] = rotation_about(rng.normal(size=3), float(rng.uniform(0, 1.2)))
    K = np.tile([[80.0, 0, 48], [0, 80.0, 32], [0, 0, 1]], (frames, 1, 1))
    K[:, 0, 0] += rng.uniform(-5, 5, frames)
    # Some stand in one place, and some look far away.
    poses[: frames // 10, :3, 3] = poses[0, :3, 3]
    depth = rng.uniform(5, 20, frames)
    found = select_sources(poses, K, SIZE, depth, 6)
    np.testing.assert_array_equal(found, pair_by_pair(poses, K, depth, 6))
    if frames >= 30:
        assert (found >= 0).mean() > 0.5
        assert (found < 0).any()
