"""Lens models against COLMAP's own, and resampling against images computed ray by ray."""

from __future__ import annotations

import cv2
import numpy as np
import PIL.Image  # noqa: F401  (the same)
import pytest

from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.lens import (
    LENS_PARAMETERS,
    Lens,
    Undistortion,
    left_out_share,
    pinhole_size,
    resized_depth,
    sample_depth,
)

WIDTH, HEIGHT = 160, 128
DISTORTION = {
    "k1": -0.12, "k2": 0.03, "k3": 0.004, "k4": -0.002, "k5": 0.01, "k6": 0.002,
    "p1": 0.003, "p2": -0.002, "sx1": 0.002, "sy1": -0.003, "omega": 0.8,
    "k": -0.2, "alpha": 0.6, "beta": 1.2,
}  # fmt: skip
WITH_THIN_PRISM = {
    "k0": -0.12, "k1": 0.03, "k2": 0.004, "k3": -0.002, "k4": 0.001, "k5": 0.0005,
    "p0": 0.003, "p1": -0.002, "s0": 0.002, "s1": -0.003, "s2": 0.001, "s3": 0.0015,
}  # fmt: skip


def lens_of(model: str) -> Lens:
    linear = {"f": 110.0, "fx": 110.0, "fy": 113.0, "cx": 83.5, "cy": 61.0}
    values = {**linear, **(WITH_THIN_PRISM if model.startswith("RAD_TAN") else DISTORTION)}
    return Lens(model, tuple(values[name] for name in LENS_PARAMETERS[model]), WIDTH, HEIGHT)


@pytest.mark.parametrize("model", LENS_PARAMETERS)
def test_projection_is_colmaps(model) -> None:
    import pycolmap

    lens = lens_of(model)
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(lens.parameters))
    rays = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 2))
    u, v = lens.project(rays[:, 0], rays[:, 1])
    expected = camera.img_from_cam(np.column_stack([rays, np.ones(200)]))
    np.testing.assert_allclose(np.column_stack([u, v]), expected, atol=1e-9)


@pytest.mark.parametrize(
    "model",
    [
        *("OPENCV", "OPENCV_FISHEYE", "FOV", "SIMPLE_RADIAL"),
        *("EUCM", "DIVISION", "FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    ],
)
def test_resampling_error_is_below_a_tenth_of_a_pixel(model) -> None:
    """An image whose colour says its ray: what is read off after resampling is the ray of another pixel."""
    import pycolmap

    lens = lens_of(model)
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(lens.parameters))
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1).reshape(-1, 2)
    rays = camera.cam_from_img(pixels).reshape(HEIGHT, WIDTH, 2)
    plan = Undistortion.planned(lens)
    assert plan.K[0, 0] == plan.K[1, 1]
    assert (plan.K[0, 2], plan.K[1, 2]) == (WIDTH / 2, HEIGHT / 2)
    assert plan.valid.mean() > 0.75
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / plan.K[0, 0]
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / plan.K[1, 1]
    for axis, expected in enumerate(np.meshgrid(x, y)):
        # Eight bits would round more than is asked for: resample the numbers themselves.
        moved = cv2.remap(rays[..., axis].astype(np.float32), *plan._maps(), cv2.INTER_LINEAR)
        error_px = np.abs(moved - expected)[plan.valid] * plan.K[0, 0]
        assert error_px.max() < 0.1


def test_models_have_colmaps_numbers() -> None:
    import pycolmap

    for number, model in enumerate(LENS_PARAMETERS):
        assert int(getattr(pycolmap.CameraModelId, model)) == number
        assert len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 8, 8).params) == len(
            LENS_PARAMETERS[model]
        )
    # What another version of COLMAP adds is to be read or refused by name, too.
    assert set(pycolmap.CameraModelId.__members__) - set(LENS_PARAMETERS) == {
        "INVALID",
        "EQUIRECTANGULAR",
    }


def test_what_a_division_model_has_no_place_for_is_left_out() -> None:
    """With k above 0 rays beyond 1 / (2 sqrt(k)) have no image, as pycolmap says."""
    import pycolmap

    lens = Lens("DIVISION", (60.0, 61.0, 83.5, 61.0, 0.3), WIDTH, HEIGHT)
    camera = pycolmap.Camera(model=lens.model, width=WIDTH, height=HEIGHT, params=list(lens.parameters))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1.5, 1.5, 31), np.linspace(-1.5, 1.5, 31)))
    expected = camera.img_from_cam(np.column_stack([x, y, np.ones(len(x))]))
    found = np.column_stack(lens.project(x, y))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    assert np.isnan(found).any()
    np.testing.assert_allclose(found, expected, atol=1e-9)
    plan = Undistortion.planned(lens, 110.0)
    assert 0.2 < plan.valid.mean() < 0.9
    depth = plan.depth(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    np.testing.assert_array_equal(depth, np.where(plan.valid, np.float32(3), 0))
    assert (plan.color(np.full((HEIGHT, WIDTH, 3), 9, np.uint8))[~plan.valid] == 0).all()


@pytest.mark.parametrize("model", ["EUCM", "DIVISION", "FISHEYE", "SIMPLE_DIVISION", "SIMPLE_FISHEYE"])
def test_symmetric_models_are_radial_lenses(model) -> None:
    assert lens_of(model).radial().error_px < 1e-3


def test_models_without_distortion_are_pinholes() -> None:
    for model, last in (("EUCM", (0.0, 1.3)), ("DIVISION", (0.0,))):
        assert Lens(model, (100.0, 100.0, 80.0, 64.0, *last), WIDTH, HEIGHT).is_pinhole
    for model, last in (("EUCM", (0.5, 1.0)), ("DIVISION", (0.1,)), ("FISHEYE", ())):
        assert not Lens(model, (100.0, 100.0, 80.0, 64.0, *last), WIDTH, HEIGHT).is_pinhole


@pytest.mark.parametrize("model", sorted(LENS_PARAMETERS))
def test_a_lens_of_larger_images_sees_the_same_rays(model: str) -> None:
    values = {"f": 100.0, "fx": 100.0, "fy": 102.0, "cx": 61.0, "cy": 47.0, "omega": 0.9}
    lens = Lens(model, tuple(values.get(name, 0.01) for name in LENS_PARAMETERS[model]), 120, 90)
    larger = lens.scaled(240, 180)
    assert (larger.width, larger.height) == (240, 180)
    np.testing.assert_array_equal(larger.K[:2], 2 * lens.K[:2])
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 5))
    np.testing.assert_array_equal(larger.distorted(x, y), lens.distorted(x, y))
    assert larger.scaled(120, 90) == lens


def test_a_plane_keeps_its_depth() -> None:
    """z-depth of a slanted plane seen through a lens, resampled to the pinhole."""
    import pycolmap

    lens = lens_of("OPENCV")
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=list(lens.parameters))
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1).reshape(-1, 2)
    rays = camera.cam_from_img(pixels).reshape(HEIGHT, WIDTH, 2)

    def plane(x, y):
        return 30 / (1 + 0.3 * x - 0.2 * y)

    plan = Undistortion.planned(lens)
    found = plan.depth(plane(rays[..., 0], rays[..., 1]).astype(np.float32))
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2)[None] / plan.K[0, 0]
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2)[:, None] / plan.K[1, 1]
    error = np.abs(found - plane(x, y))[plan.valid]
    assert error.max() < 0.02
    assert (found[~plan.valid] == 0).all()


def test_depth_is_not_mixed_across_a_fold() -> None:
    depth = np.full((20, 20), 10, np.float32)
    depth[:, 10:] = 30
    depth[3, 3] = 0
    u, v = np.meshgrid(np.linspace(0.5, 19.5, 77), np.linspace(0.5, 19.5, 55))
    values = sample_depth(depth, u, v)
    distance = np.abs(values[..., None] - np.array([0, 10, 30])).min(axis=-1)
    assert distance.max() < 1e-9


def test_beside_a_fold_and_beside_nothing_known_depth_is_that_of_the_nearest_pixel() -> None:
    depth = np.array([[10, 10, 30, 0], [10, 10, 30, 0]], dtype=np.float32)
    u = np.array([1.6, 1.9, 2.1, 2.4, 2.9, 3.1])
    for v in (0.7, 1.0, 1.3):
        assert sample_depth(depth, u, np.full_like(u, v)).tolist() == [10, 10, 30, 30, 30, 0]
    # The same down the rows.
    assert sample_depth(depth.T.copy(), np.full_like(u, 1.3), u).tolist() == [10, 10, 30, 30, 30, 0]


@pytest.mark.parametrize(("p1", "p2"), [(0.0, 0.1), (0.0, -0.1), (0.1, 0.0), (-0.1, 0.0)])
def test_a_fold_on_one_side_is_found(p1: float, p2: float) -> None:
    """Along one axis a tangential term makes x + 3 p x^2 of x, which falls beyond |x| = 1 / (6 p) there."""
    lens = Lens("OPENCV", (60.0, 60.0, 80.0, 64.0, 0.0, 0.0, p1, p2), WIDTH, HEIGHT)
    assert lens.fold_radius(3.0) == pytest.approx(1 / 0.6, abs=0.003)
    assert lens.fold_radius(1.5) == 1.5


def test_a_polynomial_that_folds_back_is_cut_off() -> None:
    folding = Lens("SIMPLE_RADIAL", (60.0, 80.0, 64.0, -0.25), WIDTH, HEIGHT)
    # r (1 - 0.25 r^2) falls from r = sqrt(4 / 3) on.
    assert folding.fold_radius(3.0) == pytest.approx(np.sqrt(4 / 3), abs=0.01)
    plan = Undistortion.planned(folding)
    x = (np.arange(WIDTH) + 0.5 - 80) / 60
    y = (np.arange(HEIGHT) + 0.5 - 64) / 60
    assert not plan.valid[np.hypot(x[None], y[:, None]) > np.sqrt(4 / 3) + 0.01].any()


def test_pinholes_are_told_from_lenses() -> None:
    assert lens_of("PINHOLE").is_pinhole
    assert Lens("OPENCV", (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 4, 4).is_pinhole
    assert not lens_of("OPENCV").is_pinhole
    assert not Lens("OPENCV_FISHEYE", (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 4, 4).is_pinhole


@pytest.mark.parametrize(
    ("model", "parameters", "message"),
    [
        ("EQUIRECTANGULAR", (1.0,), "the camera model EQUIRECTANGULAR is not known"),
        ("PINHOLE", (1.0, 1.0, 2.0), "3 parameters for the model PINHOLE; expected 4: fx, fy, cx, cy"),
        ("PINHOLE", (1.0, float("nan"), 2.0, 2.0), "fy = nan; expected a finite number"),
    ],
)
def test_impossible_lenses(model, parameters, message) -> None:
    with pytest.raises(SourceError, match=message):
        Lens(model, parameters, 4, 4)


@pytest.mark.parametrize("value", [1e-30, 2.0, 1e30])
def test_a_constant_depth_stays_however_large(value) -> None:
    where = np.array([-1e9, 0.0, 1.3, 1e9])
    np.testing.assert_allclose(sample_depth(np.full((3, 4), value), where, where), value, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (4, 1)])
def test_depth_one_pixel_wide_is_read_along_its_length(shape: tuple[int, int]) -> None:
    """Inverse depth is linear between centres, and ends with the outermost ones."""
    inverse = np.linspace(1.0, 1.03, max(shape))
    depth = (1 / inverse).reshape(shape)
    along, across = np.array([0.0, 0.5, 1.0, 1.75, 3.5, 9.0]), np.array([-1.0, 0.0, 0.3, 0.5, 0.9, 9.0])
    u, v = (along, across) if shape[1] > 1 else (across, along)
    expected = 1 / np.interp(along, np.arange(max(shape)) + 0.5, inverse)
    np.testing.assert_allclose(sample_depth(depth, u, v), expected, rtol=1e-12)


@pytest.mark.parametrize("size", [(16, 12), (32, 24), (64, 48), (24, 36)])
def test_a_resized_plane_is_the_plane_at_the_new_centres(size: tuple[int, int]) -> None:
    """Across a picture of any size the inverse depth falls along its width and rises along its height."""

    def plane(width: int, height: int) -> np.ndarray:
        across, down = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
        return 1 / (0.1 - 0.03 * across + 0.02 * down[:, None])

    depth = plane(32, 24).astype(np.float32)
    found = resized_depth(depth, *size)
    assert found.dtype == np.float32
    assert found.shape == size[::-1]
    # Beyond the outermost centres of the source there is no slope.
    inside = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(found[inside], plane(*size)[inside], rtol=1e-5)


def test_what_the_pinhole_leaves_out_is_told_where_the_lens_has_no_pixel_for_some_of_it() -> None:
    """Directions beyond the lens have no place in the source: it was said to leave out nan %."""
    lens = Lens("SIMPLE_DIVISION", (100.0, 80.0, 64.0, 0.6), 160, 128)
    plan = Undistortion.planned(lens)
    assert not np.isfinite(plan.u[~plan.valid]).all()
    share = left_out_share(lens, plan, np.ones((128, 160), dtype=np.float32))
    assert 0 <= share < 1


@pytest.mark.parametrize("times", [1.25, 2.0, 4.0])
def test_a_narrower_pinhole_leaves_out_what_lies_around_it(times: float) -> None:
    """With so many times the focal length it shows that share of width and height, in the middle."""
    lens = Lens("PINHOLE", (100.0, 100.0, 80.0, 64.0), WIDTH, HEIGHT)
    plan = Undistortion.planned(lens, 2 * np.degrees(np.arctan(WIDTH / 2 / (100 * times))))
    assert plan.K[0, 0] == pytest.approx(100 * times)
    picture = np.ones((HEIGHT, WIDTH), dtype=np.float32)
    assert left_out_share(lens, plan, picture) == pytest.approx(1 - 1 / times**2, abs=1e-6)
    # A picture of half the size says the same.
    assert left_out_share(lens, plan, picture[::2, ::2].copy()) == pytest.approx(1 - 1 / times**2, abs=1e-6)
    # Of a picture that ends before the pinhole does, nothing is left out.
    inside = np.zeros_like(picture)
    inside[50:78, 64:96] = 1
    assert left_out_share(lens, plan, inside) == pytest.approx(0, abs=0.01)
    assert left_out_share(lens, plan, np.zeros_like(picture)) == 0


def test_a_wider_pinhole_grows_to_keep_the_resolution_of_the_centre() -> None:
    lens = Lens("OPENCV_FISHEYE", (100.0, 81.0, 80.0, 64.0, 0.0, 0.0, 0.0, 0.0), WIDTH, HEIGHT)
    config = IngestConfig(field_of_view_deg=120.0, size="central")
    size = pinhole_size(lens, config)
    # The focal length of square pixels of the same area is 90 px, and 2 * 90 * tan(60 deg) is 311.8.
    assert size == (312, round(312 * HEIGHT / WIDTH))
    assert Undistortion.planned(lens, 120.0, size=size).K[0, 0] == pytest.approx(90, rel=2e-3)
    assert Undistortion.planned(lens).K[0, 0] == pytest.approx(90)
    assert pinhole_size(lens, IngestConfig(field_of_view_deg=120.0, size="source")) is None


@pytest.mark.parametrize("model", sorted(LENS_PARAMETERS))
def test_the_central_focal_length_is_the_slope_of_the_model_at_its_axis(model: str) -> None:
    values = {"f": 90.0, "fx": 100.0, "fy": 81.0, "cx": 80.0, "cy": 64.0, "omega": 0.9, "alpha": 0.5}
    lens = Lens(model, tuple(values.get(name, 0.02) for name in LENS_PARAMETERS[model]), WIDTH, HEIGHT)
    step = np.array([-1e-4, 1e-4])
    across, down = lens.project(step, np.zeros(2))[0], lens.project(np.zeros(2), step)[1]
    slope = np.sqrt(np.ptp(across) * np.ptp(down)) / np.ptp(step)
    assert lens.central_focal_px == pytest.approx(slope, rel=1e-6)
    assert Undistortion.planned(lens).K[0, 0] == lens.central_focal_px


def test_a_pinhole_of_a_fov_lens_keeps_the_resolution_of_the_centre() -> None:
    lens = Lens("FOV", (100.0, 100.0, 80.0, 64.0, 1.2), WIDTH, HEIGHT)
    size = pinhole_size(lens, IngestConfig(field_of_view_deg=100.0, size="central"))
    assert size is not None
    assert Undistortion.planned(lens, 100.0, size=size).K[0, 0] == pytest.approx(114.02, rel=5e-3)
