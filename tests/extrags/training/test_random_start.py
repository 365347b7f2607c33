"""Depths from nothing but where cameras stand and look."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.errors import CaptureError
from extrags.training.random_start import depth_range, random_depth
from tests.extrags.object_capture import RADIUS, object_cameras


def path(poses: list[np.ndarray]) -> Cameras:
    K = np.array([[20.0, 0, 12], [0, 20.0, 9], [0, 0, 1]])
    return Cameras(np.tile(K, (len(poses), 1, 1)), np.stack(poses), 24, 18)


def test_an_object_is_where_the_axes_meet() -> None:
    cameras = object_cameras(12)
    within = depth_range(cameras, "object")
    assert within.meeting is not None
    np.testing.assert_allclose(within.meeting, [0, 0, 0.3], atol=1e-6)
    assert within.near < within.typical < within.far
    assert within.typical == pytest.approx(RADIUS, rel=0.1)
    depth = random_depth(cameras, within, seed=0)
    points = cameras.centers[:, None, None] + depth[..., None] * pixel_rays(cameras)
    away = np.linalg.norm(points - within.meeting, axis=-1)[depth > 0]
    # A ball that all cameras see, as large as the images show: nothing hangs before a single lens.
    assert away.max() <= (within.far - within.near) / 2 * 1.001
    assert 0.2 < (depth > 0).mean() < 0.9
    np.testing.assert_array_equal(depth, random_depth(cameras, within, seed=0))


def test_an_endoscope_looks_along_its_path() -> None:
    """Forward in a bent tube: the axes meet nowhere; the range is that of what shows parallax."""
    angles = np.linspace(0, 0.6, 12)
    poses = [
        look_at(
            np.array([60 * np.sin(a), 60 * np.cos(a), 0]),
            np.array([60 * np.sin(a + 0.2), 60 * np.cos(a + 0.2), 0]),
            np.array([0, 0, 1.0]),
        )
        for a in angles
    ]
    within = depth_range(path(poses), "tube")
    assert within.meeting is None
    # The path is 36 long; a colon's wall is seen at a third of that to twice that.
    assert within.near < 8
    assert within.far > 50
    depth = random_depth(path(poses), within, seed=1)
    assert depth.min() >= within.near * 0.999
    assert depth.max() <= within.far * 1.001
    assert float(np.median(depth)) == pytest.approx(within.typical, rel=0.1)


def test_the_unit_does_not_matter() -> None:
    cameras = object_cameras(8)
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] *= 1000
    one, thousand = (
        depth_range(Cameras(cameras.K, pose, cameras.width, cameras.height), "object")
        for pose in (cameras.world_from_camera, poses)
    )
    assert thousand.typical == pytest.approx(1000 * one.typical)


def test_looking_outwards_from_a_ring_meets_behind() -> None:
    """Axes that meet behind the lenses are no capture of an object."""
    cameras = object_cameras(10)
    turned = cameras.world_from_camera.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
    assert depth_range(Cameras(cameras.K, turned, *(64, 48)), "inside out").meeting is None


def test_a_single_place_tells_nothing() -> None:
    poses = [
        look_at(np.ones(3), np.array([np.cos(a), np.sin(a), 5.0]), np.array([0, 1.0, 0])) for a in (0, 1, 2)
    ]
    with pytest.raises(
        CaptureError, match=r"turning: neither depth .* all 3 training cameras stand in one place"
    ):
        depth_range(path(poses), "turning")
