"""Covariance of shared intrinsics against COLMAP's own, and against the scatter of repeated measurements."""

from __future__ import annotations

from typing import Any

import cv2  # noqa: F401  (before pycolmap, which brings another zlib)
import numpy as np
import PIL.Image  # noqa: F401  (the same)
import pytest

from extrags.cameras import look_at
from extrags.errors import ShapeError
from extrags.lens import Lens
from extrags.poses.features import read_adjusted, read_model
from extrags.poses.intrinsics_covariance import (
    IntrinsicsCovariance,
    _last_rows_of_inverse,
    intrinsics_covariance,
)
from extrags.poses.self_calibration import _mean_square_px

WIDTH, HEIGHT, NOISE_PX = 320, 240, 0.5
LENS = Lens("SIMPLE_RADIAL", (200.0, 160.0, 120.0, -0.1), WIDTH, HEIGHT)
FREE = ("f", "k1")


def arc(n_frames: int) -> np.ndarray:
    """Poses that look at a cloud of points from several sides."""
    t = np.linspace(-1, 1, n_frames)
    centres = np.stack([4 * np.sin(t), 2 * np.cos(3 * t), -1 + t**2], axis=1)
    return np.stack(
        [look_at(c, np.array([0.0, 0, 9]), np.array([0.1 * k, -1, 0])) for k, c in enumerate(centres)]
    )


def forward(n_frames: int) -> np.ndarray:
    """Straight ahead along the optical axis."""
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    poses[:, 2, 3] = np.linspace(0, 2, n_frames)
    return poses


class Bundle:
    """Points, poses and noisy observations; COLMAP's reconstruction of them."""

    def __init__(self, poses: np.ndarray, n_points: int = 60, seed: int = 0) -> None:
        self.poses = poses
        rng = np.random.default_rng(seed)
        self.points = rng.uniform((-4, -3, 6), (4, 3, 13), (n_points, 3))
        local = np.einsum("fji,fpj->fpi", poses[:, :3, :3], self.points[None] - poses[:, None, :3, 3])
        pixels = np.stack(LENS.project(local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]), axis=-1)
        inside = (local[..., 2] > 0.5) & ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(-1)
        inside[:, inside.sum(0) < 2] = False
        self.frame, self.point = np.nonzero(inside)
        self.exact_px = pixels[inside]
        self.observed_px = self.exact_px + rng.normal(0, NOISE_PX, self.exact_px.shape)

    def covariance(self, lens: Lens = LENS, **changes: Any) -> IntrinsicsCovariance:
        given = {"world_from_camera": self.poses, "points": self.points, "observed_px": self.observed_px}
        given |= changes
        return intrinsics_covariance(
            lens, FREE, observed_frame=self.frame, observed_point=self.point, **given
        )

    def reconstruction(self, observed_px: np.ndarray) -> Any:
        import pycolmap

        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera(
            model=LENS.model, width=WIDTH, height=HEIGHT, params=list(LENS.parameters), camera_id=1
        )
        model.add_camera_with_trivial_rig(camera)
        seen_at: dict[tuple[int, int], int] = {}
        for frame, pose in enumerate(self.poses):
            rows = np.flatnonzero(self.frame == frame)
            for place, row in enumerate(rows):
                seen_at[frame, int(self.point[row])] = place
            image = pycolmap.Image(name=f"{frame}.png", camera_id=1, image_id=frame + 1)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(observed_px[row]) for row in rows])
            moved = np.linalg.inv(pose)
            model.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(moved[:3, :3]), moved[:3, 3])
            )
        for point in np.unique(self.point):
            track = pycolmap.Track()
            for frame in self.frame[self.point == point]:
                track.add_element(int(frame) + 1, seen_at[int(frame), int(point)])
            model.add_point3D(self.points[point], track)
        return model


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle(arc(6))


def adjusted(model: Any) -> tuple[Any, Any, Any]:
    """The model after bundle adjustment, and what COLMAP's covariance is estimated from."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    return model, adjuster, pycolmap


def test_it_is_colmaps(bundle: Bundle) -> None:
    model, adjuster, pycolmap = adjusted(bundle.reconstruction(bundle.observed_px))
    expected = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    theirs = expected.get_other_params_cov(model.camera(1).params)
    assert theirs is not None
    lens = Lens(LENS.model, tuple(float(p) for p in model.camera(1).params), WIDTH, HEIGHT)
    poses = np.stack(
        [
            np.vstack([model.image(k + 1).cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
            for k in range(len(bundle.poses))
        ]
    )
    kept = np.unique(bundle.point)
    points = bundle.points.copy()
    points[kept] = [model.point3D(number).xyz for number in sorted(model.point3D_ids())]
    found = bundle.covariance(lens, world_from_camera=poses, points=points)
    # COLMAP's is for residuals of one pixel.
    np.testing.assert_allclose(found.model / found.residual_px**2, theirs, rtol=0.01)
    assert found.residual_px == pytest.approx(NOISE_PX, rel=0.1)
    assert found.n_observations == len(bundle.frame)


def test_repeated_measurements_scatter_as_it_says(bundle: Bundle) -> None:
    rng = np.random.default_rng(1)
    focal, distortion = [], []
    for _ in range(40):
        noisy = bundle.exact_px + rng.normal(0, NOISE_PX, bundle.exact_px.shape)
        f, _, _, k1 = adjusted(bundle.reconstruction(noisy))[0].camera(1).params
        focal.append(f)
        distortion.append(k1)
    said = bundle.covariance()
    # The standard deviation of forty is itself known to 11 %.
    assert said.std("f") == pytest.approx(np.std(focal), rel=0.35)
    assert said.std("k1") == pytest.approx(np.std(distortion), rel=0.35)
    assert abs(np.mean(focal) - LENS.value("f")) < 3 * said.std("f") / np.sqrt(40)


def test_errors_that_repeat_along_a_track_count_once(bundle: Bundle) -> None:
    """Each point slides with the frames: independent residuals would promise too much."""
    rng = np.random.default_rng(2)
    slide = np.repeat(rng.normal(0, NOISE_PX, (len(bundle.points), 1, 2)), len(bundle.poses), axis=1)
    slide *= np.linspace(-1, 1, len(bundle.poses))[None, :, None]
    found = bundle.covariance(observed_px=bundle.exact_px + slide[bundle.point, bundle.frame])
    assert found.clustered[0, 0] > 1.2 * found.model[0, 0]
    assert found.std("f") == pytest.approx(np.sqrt(found.clustered[0, 0]))


def test_straight_ahead_determines_no_focal_length(bundle: Bundle) -> None:
    ahead = Bundle(forward(6)).covariance()
    assert not ahead.std("f") < 0.2 * LENS.value("f")
    assert bundle.covariance().std("f") < 0.03 * LENS.value("f")


def test_too_few_observations_bound_nothing(bundle: Bundle) -> None:
    few = np.isin(bundle.point, bundle.point[:3])
    found = intrinsics_covariance(
        LENS,
        FREE,
        bundle.poses,
        bundle.points,
        bundle.frame[few],
        bundle.point[few],
        bundle.observed_px[few],
    )
    assert found.std("f") == np.inf
    with pytest.raises(ShapeError, match="no intrinsics are free"):
        intrinsics_covariance(
            LENS, (), bundle.poses, bundle.points, bundle.frame, bundle.point, bundle.observed_px
        )


def test_the_last_rows_are_those_of_the_inverse() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(40, 60))
    matrix = root @ root.T
    scale = np.sqrt(np.diag(matrix))
    matrix /= scale[:, None] * scale
    expected = np.linalg.inv(matrix)[-2:]
    found = _last_rows_of_inverse(matrix.copy(), 2)
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    # The same bits each time, although the smallest eigenvalue is found by iteration.
    np.testing.assert_array_equal(_last_rows_of_inverse(matrix.copy(), 2), found)


@pytest.mark.parametrize("smallest", [0.0, 1e-15])
def test_a_singular_matrix_has_no_inverse(smallest: float) -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(6, 6)))
    matrix = (turn * np.array([smallest, 1, 1, 1, 1, 1])) @ turn.T
    assert _last_rows_of_inverse((matrix + matrix.T) / 2, 2) is None


def test_a_model_is_read_again_after_bundle_adjustment(bundle: Bundle) -> None:
    """Only what has moved is read; the mean square of its residuals is COLMAP's."""
    poses = np.full((len(bundle.poses), 4, 4), np.nan)
    model = bundle.reconstruction(bundle.observed_px)
    before = read_model(model, poses.copy(), {})
    np.testing.assert_array_equal(before.world_from_camera.round(9), bundle.poses.round(9))
    model, _, _ = adjusted(model)
    expected, found = read_model(model, poses.copy(), {}), read_adjusted(model, before)
    for name in ("world_from_camera", "points", "observed_frame", "observed_point", "observed_px"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert np.abs(found.points - before.points).max() > 1e-3
    squares = [
        float(((image.project_point(point.xyz) - image.point2D(element.point2D_idx).xy) ** 2).sum())
        for point in model.points3D.values()
        for element in point.track.elements
        for image in [model.image(element.image_id)]
    ]
    parameters = tuple(float(value) for value in model.camera(1).params)
    lens = Lens(LENS.model, parameters, WIDTH, HEIGHT)
    assert _mean_square_px(lens, found) == pytest.approx(np.mean(squares), rel=1e-9)
