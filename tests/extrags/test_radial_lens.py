"""Radial lenses: against OpenCV, there and back, fits, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from extrags.cameras import Cameras, field_mask, pixel_rays, project_points, unproject_pixels
from extrags.errors import ShapeError, SourceError
from extrags.lens import Lens, Undistortion, distortion_of_pinhole
from extrags.radial_lens import LARGEST_ANGLE_RAD, RadialLens, fitted_lens

LENS = RadialLens((-0.209, 0.0397, 0.00787, -0.00334), float(np.radians(80)))
K = np.array([[30.0, 0, 33], [0, 31.0, 24], [0, 0, 1]])


def test_pixels_are_those_of_opencv() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)) * [1, 1, 0.3] + [0, 0, 1.2]
    points = points[points[:, 2] > 0.25]
    found = project_points(points, K, LENS)
    # OpenCV counts from pixel centres, which changes nothing: the principal point does so, too.
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), K, np.array(LENS.coefficients)
    )
    seen = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]) <= LENS.max_angle_rad
    assert seen.sum() > 20
    np.testing.assert_allclose(found[seen], expected[seen, 0], rtol=0, atol=1e-9)
    assert np.isnan(found[~seen]).all()


def test_behind_the_camera_and_outside_the_field_there_is_no_pixel() -> None:
    away = np.array([[0.0, 0, -1], [1, 0, 0], [1, 0, np.tan(np.radians(5))], [0.2, 0.1, -0.01]])
    assert np.isnan(project_points(away, K, LENS)).all()


def test_rays_lead_back_to_their_pixels() -> None:
    cameras = Cameras(K[None], np.eye(4)[None], 66, 48, LENS)
    rays = pixel_rays(cameras)
    assert np.isfinite(rays).all()
    (pixels,), _ = cameras.project(rays[0] * 7.0)
    seen = np.isfinite(pixels[..., 0])
    assert (seen | ~cameras.field[0]).all()
    v, u = np.mgrid[:48, :66] + 0.5
    np.testing.assert_allclose(pixels[seen], np.stack([u, v], -1)[seen], rtol=0, atol=1e-9)
    pixel = np.array([[12.3, 40.1]])
    np.testing.assert_allclose(
        project_points(3 * unproject_pixels(pixel, K, LENS), K, LENS), pixel, atol=1e-9
    )


def test_the_series_is_the_lens_near_its_axis() -> None:
    angle = np.linspace(0.01, 0.4, 40)
    series = np.polynomial.polynomial.polyval(np.tan(angle) ** 2, LENS.series)
    np.testing.assert_allclose(series, LENS.radius(angle) / np.tan(angle), rtol=1e-8)


def test_beyond_its_field_the_lens_goes_on_straight() -> None:
    step = 1e-3
    inside, at, outside = LENS.radius(LENS.max_angle_rad + np.array([-step, 0, step]))
    assert outside - at == pytest.approx(at - inside, rel=1e-2)
    assert LENS.angle(np.array(LENS.max_radius)) == pytest.approx(LENS.max_angle_rad, abs=1e-12)


def test_the_field_is_masked() -> None:
    centred = np.array([[30.0, 0, 50], [0, 30.0, 50], [0, 0, 1]])
    mask = field_mask(centred, LENS, 100, 100)
    v, u = np.nonzero(mask)
    farthest = np.hypot(np.abs(u + 0.5 - 50) + 0.5, np.abs(v + 0.5 - 50) + 0.5)
    assert farthest.max() <= 30 * LENS.max_radius
    assert mask.sum() == pytest.approx(np.pi * (30 * LENS.max_radius) ** 2, rel=0.08)
    assert not mask[0, 0]


def test_fits_of_known_lenses() -> None:
    truth = Lens("OPENCV_FISHEYE", (300.0, 310.0, 320.0, 240.0, 0.05, -0.02, 0.01, -0.003), 640, 480)
    found = truth.radial()
    assert found.error_px < 1e-9
    np.testing.assert_allclose(found.lens.coefficients, truth.parameters[4:], atol=1e-9)
    np.testing.assert_allclose(found.K, truth.K, atol=1e-9)
    assert np.degrees(found.lens.max_angle_rad) == pytest.approx(71.8, abs=0.3)  # the corners
    barrel = Lens("SIMPLE_RADIAL", (500.0, 320.0, 240.0, -0.2), 640, 480).radial()
    assert barrel.error_px < 0.05
    tangential = Lens("OPENCV", (500.0, 500.0, 320.0, 240.0, -0.1, 0.0, 0.004, 0.0), 640, 480).radial()
    assert tangential.error_px > 1.0


@pytest.mark.parametrize(
    ("coefficients", "angle", "said"),
    [
        ((-1.0, 0.0, 0.0, 0.0), 1.2, "folds back"),
        ((0.0, 0.0, 0.0, np.nan), 1.2, "finite"),
        ((0.0, 0.0, 0.0, 0.0), 1.55, "at most 85"),
    ],
)
def test_no_lens(coefficients: tuple[float, float, float, float], angle: float, said: str) -> None:
    with pytest.raises(SourceError, match=said):
        RadialLens(coefficients, angle)


def test_nothing_in_the_image() -> None:
    with pytest.raises(SourceError, match="no direction"):
        fitted_lens(lambda x, y: (x * np.nan, y), K, 10, 10, LARGEST_ANGLE_RAD)


def test_to_a_pinhole_and_back() -> None:
    v, u = np.mgrid[:48, :66].astype(np.float32)
    image = np.sin(u / 9) + np.cos(v / 7)
    plan = Undistortion.of_radial(K, LENS, 66, 48, 90.0)
    assert np.degrees(2 * np.arctan(33 / plan.K[0, 0])) == pytest.approx(90)
    assert plan.valid.all()
    back = distortion_of_pinhole(K, LENS, plan.K, 66, 48)
    returned = back.image(plan.image(image))
    assert 0.2 < back.valid.mean() < 0.9
    assert np.abs(returned - image)[back.valid].max() < 0.03


def test_cameras_keep_their_lens() -> None:
    cameras = Cameras(np.repeat(K[None], 3, 0), np.repeat(np.eye(4)[None], 3, 0), 66, 48, LENS)
    for other in (cameras[1:], cameras.resized(33, 24), cameras.interpolated(2)):
        assert other.lens == LENS
    flat = cameras.as_pinholes()
    assert flat.lens is None
    assert flat.as_pinholes() is flat
    assert Cameras.concatenated([cameras, cameras]).lens == LENS
    with pytest.raises(ShapeError, match="lenses"):
        Cameras.concatenated([cameras, flat])
    assert RadialLens.from_json(LENS.to_json()) == LENS


@pytest.mark.parametrize("focal", [1600.0, 2000.0, 2600.0])
def test_a_narrow_field_is_fitted_by_what_does_not_fold_beyond_it(focal: float) -> None:
    rng = np.random.default_rng(0)
    fewer = 0
    for _ in range(12):
        k1, k2, (p1, p2) = rng.uniform(-0.5, 0.1), rng.uniform(0, 0.4), rng.normal(0, 1.5e-3, 2)
        found = Lens("OPENCV", (focal, focal, 325.0, 236.0, k1, k2, p1, p2), 640, 480).radial()
        # Tangential terms, which no radial lens has, make nearly all of it.
        assert found.rms_px < 0.3
        angle = np.linspace(0, found.lens.projected_up_to_rad, 100)
        assert (np.diff(found.lens.radius(angle)) > 0).all()
        fewer += found.lens.coefficients[3] == 0
    assert 0 < fewer < 12


def test_a_fold_is_refused_where_points_are_projected_and_no_farther() -> None:
    end = float(np.radians(10))
    # 1 + 3 k1 x^2 vanishes at x.
    with pytest.raises(SourceError, match=r"folds back 9\.0 degrees from its axis, inside its field of 10"):
        RadialLens((-1 / (3 * np.radians(9) ** 2), 0.0, 0.0, 0.0), end)
    with pytest.raises(SourceError, match=r"beyond its field of 10\.0 degrees, but before the 18\.6 degrees"):
        RadialLens((-1 / (3 * np.radians(15) ** 2), 0.0, 0.0, 0.0), end)
    lens = RadialLens((-1 / (3 * np.radians(20) ** 2), 0.0, 0.0, 0.0), end)
    angle = np.linspace(0, np.radians(60), 50)
    np.testing.assert_allclose(lens.angle(lens.radius(angle)), angle, atol=1e-12)


def test_a_fold_inside_a_wide_field_is_not_fitted_away() -> None:
    def folding(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.hypot(x, y)
        angle = np.arctan(slope)
        gain = angle * (1 - angle**2 / 3) / np.maximum(slope, 1e-12)
        return 100 * gain * x + 64, 100 * gain * y + 64

    pinhole = np.array([[100.0, 0, 64], [0, 100.0, 64], [0, 0, 1]])
    with pytest.raises(SourceError, match=r"folds back 57\.. degrees from its axis, inside its field"):
        fitted_lens(folding, pinhole, 128, 128, LARGEST_ANGLE_RAD)
