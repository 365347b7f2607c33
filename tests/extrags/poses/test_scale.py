"""Metric scale from depth, with outliers."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.cameras import compose, rotation_about
from extrags.poses.scale import depth_scale

MM_PER_UNIT = 3.7


def observations(n_points: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Two cameras in COLMAP's unit that look at points; true depth in mm where they fall."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1, -1, 4), (1, 1, 6), (n_points, 3))
    poses = np.stack([np.eye(4), compose(rotation_about(np.array([0.0, 1, 0]), 0.1), np.array([0.4, 0, 0]))])
    depth = np.zeros((2, 64, 64), dtype=np.float32)
    frames, indices, pixels = [], [], []
    for frame, pose in enumerate(poses):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        uv = 60 * local[:, :2] / local[:, 2:] + 32
        for index, (u, v) in enumerate(uv):
            if 0 <= u < 64 and 0 <= v < 64 and depth[frame, int(v), int(u)] == 0:
                depth[frame, int(v), int(u)] = MM_PER_UNIT * local[index, 2]
                frames.append(frame)
                indices.append(index)
                pixels.append((u, v))
    return {
        "world_from_camera": poses,
        "points": points,
        "observed_frame": np.array(frames),
        "observed_point": np.array(indices),
        "observed_px": np.array(pixels),
        "depth_mm": depth,
        "mask": np.ones((2, 64, 64), dtype=bool),
    }


def test_exact() -> None:
    found = depth_scale(**observations(60))
    assert found is not None
    assert found.mm_per_unit == pytest.approx(MM_PER_UNIT, rel=1e-6)
    assert found.relative_spread < 1e-6
    assert found.n_observations > 80


def test_a_third_of_outliers_and_unknown_depth() -> None:
    given = observations(90)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(given["observed_frame"])) < 0.3
    rows = given["observed_px"][wrong].astype(int)
    given["depth_mm"][given["observed_frame"][wrong], rows[:, 1], rows[:, 0]] *= np.where(
        rng.random(wrong.sum()) < 0.5, 4, 0.2
    )
    given["depth_mm"][1, :10] = 0
    found = depth_scale(**given)
    assert found is not None
    assert found.mm_per_unit == pytest.approx(MM_PER_UNIT, rel=1e-4)


@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_the_spread_is_a_share_whatever_the_unit(unit: float) -> None:
    given = observations(60)
    signs = np.random.default_rng(2).choice([0.9, 1.0, 1.1], given["depth_mm"].shape, p=[0.4, 0.2, 0.4])
    given["depth_mm"] = (unit * signs * given["depth_mm"]).astype(np.float32)
    found = depth_scale(**given)
    assert found is not None
    assert found.mm_per_unit == pytest.approx(unit * MM_PER_UNIT, rel=1e-4)
    assert found.relative_spread == pytest.approx(0.1, rel=1e-3)


def test_depth_outside_the_mask_does_not_count() -> None:
    given = observations(60)
    given["mask"][:, :, 40:] = False
    given["depth_mm"][:, :, 40:] *= 5
    found = depth_scale(**given)
    assert found is not None
    assert found.relative_spread < 1e-6
    assert found.n_observations < len(given["observed_frame"])


def test_masked_and_missing_depth_give_no_scale() -> None:
    given = observations(60)
    assert depth_scale(**given | {"mask": np.zeros_like(given["mask"])}) is None
    assert depth_scale(**given | {"depth_mm": np.full_like(given["depth_mm"], np.nan)}) is None
    assert depth_scale(**observations(8)) is None
