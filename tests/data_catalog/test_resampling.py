"""Cropping and shrinking what belongs to a frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from data_catalog.resampling import Resampling
from extrags.config import IngestConfig
from extrags.errors import ConfigError


def test_depth_of_a_slanted_plane_is_exact() -> None:
    """z-depth of a plane is linear in inverse depth: shrinking must not bend it."""
    focal, size = 60.0, 96
    u = (np.arange(size) + 0.5 - size / 2) / focal
    plane = (20 / (1 + 0.4 * u[None, :] + 0.2 * u[:, None])).astype(np.float32)
    plan = Resampling.planned(size, size, IngestConfig(width=40))
    v = (np.arange(40) + 0.5 - 20) / (focal * 40 / size)
    expected = 20 / (1 + 0.4 * v[None, :] + 0.2 * v[:, None])
    np.testing.assert_allclose(plan.depth(plane), expected, rtol=1e-5)


def test_depth_is_not_mixed_across_a_fold() -> None:
    depth = np.full((32, 32), 10, np.float32)
    depth[:, 15:] = 30
    depth[5, 5] = 0
    small = Resampling.planned(32, 32, IngestConfig(downscale=2)).depth(depth)
    assert set(np.unique(small)) <= {0.0, 10.0, 30.0}


def test_depth_of_frames_that_are_not_shrunk_stays_as_it_is() -> None:
    depth = np.random.default_rng(0).uniform(0, 30, (40, 48)).astype(np.float32)
    depth[depth < 3] = 0
    plan = Resampling.planned(48, 40, IngestConfig(size="source"), box=(3, 5, 32, 30))
    np.testing.assert_array_equal(plan.depth(depth), depth[5:35, 3:35])


def test_crop_moves_the_principal_point() -> None:
    plan = Resampling.planned(100, 90, IngestConfig(downscale=2), box=(10, 6, 61, 70))
    assert (plan.width, plan.height, plan.crop_width) == (30, 35, 60)
    K = np.array([[80.0, 0, 50], [0, 80, 45], [0, 0, 1]])
    np.testing.assert_allclose(plan.intrinsics(K), [[40, 0, 20], [0, 40, 19.5], [0, 0, 1]])


def test_mask_needs_every_pixel_below() -> None:
    mask = np.ones((32, 32), bool)
    mask[3, 3] = False
    small = Resampling.planned(32, 32, IngestConfig(downscale=2)).mask(mask)
    assert not small[1, 1]
    assert small.sum() == 255


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 64, "height": 20}, "would squeeze"),
        ({"width": 200}, "larger than the source"),
        ({"downscale": 8}, "too small"),
        ({"height": 32}, "needs ingest.width"),
    ],
)
def test_impossible_sizes(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Resampling.planned(100, 100, IngestConfig(**settings))
