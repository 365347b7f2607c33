from __future__ import annotations

import json

import numpy as np
import pytest

from data_catalog.c3vd.pinhole import PinholeResampling
from data_catalog.c3vd.scaramuzza import CALIBRATIONS, ScaramuzzaCamera, camera_from_json
from extrags.config import PROFILES, IngestConfig
from extrags.errors import ConfigError, SourceError
from tests.data_catalog.c3vd_fixture import PUBLISHED, lens_rays, scaled_lens


def solved_pixel(lens: dict[str, float], ray: np.ndarray) -> np.ndarray:
    """The published projection by another way: all roots of the quartic, the smallest positive real one."""
    r, z = np.hypot(ray[0], ray[1]), ray[2]
    roots = np.roots([r * lens["a4"], r * lens["a3"], r * lens["a2"], -z, r * lens["a0"]])
    rho = min(root.real for root in roots if abs(root.imag) < 1e-9 * abs(root) and root.real > 0)
    u, v = rho * ray[:2] / r
    return np.array([lens["c"] * u + lens["e"] * v + lens["cx"], lens["d"] * u + v + lens["cy"]])


def pinhole_rays(K: np.ndarray, width: int, height: int, samples: int = 1) -> np.ndarray:
    u, v = ((np.arange(size * samples) + 0.5) / samples for size in (width, height))
    x, y = np.meshgrid((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    return np.stack([x, y, np.ones_like(x)], -1)


def pattern(rays: np.ndarray) -> np.ndarray:
    """A smooth picture on the sphere of directions, 0 to 255."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    waves = [np.sin(unit @ np.array(w)) for w in ([31.0, 7, 0], [-9.0, 26, 4], [13.0, 17, 15])]
    return 128 + 100 * np.stack(waves, -1)


class TestCamera:
    @pytest.mark.parametrize("name", ["c3vd", "c3vdv2"])
    def test_projection_inverts_the_rays(self, name) -> None:
        camera = CALIBRATIONS[name]
        rng = np.random.default_rng(0)
        pixels = rng.uniform((0, 0), (1349, 1079), (4000, 2))
        pixels = pixels[np.linalg.norm(pixels - (camera.cx, camera.cy), axis=1) < 820]
        assert np.abs(camera.project(camera.rays(pixels)) - pixels).max() < 1e-9

    @pytest.mark.parametrize("name", ["c3vd", "c3vdv2"])
    def test_the_axis_is_the_distortion_centre(self, name) -> None:
        camera = CALIBRATIONS[name]
        np.testing.assert_allclose(camera.project(np.array([[0.0, 0, 3]])), [[camera.cx, camera.cy]])

    def test_rays_are_the_published_ones(self) -> None:
        for name, lens in PUBLISHED.items():
            expected = lens_rays(lens, 1350, 1080)[::37, ::41]
            expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
            x, y = np.meshgrid(np.arange(0, 1350, 41.0), np.arange(0, 1080, 37.0))
            np.testing.assert_allclose(
                CALIBRATIONS[name].rays(np.stack([x, y], -1)), expected, rtol=0, atol=1e-12
            )

    def test_angles_of_the_second_lens(self) -> None:
        """Angles from the axis that were worked out from the published numbers elsewhere."""
        camera = CALIBRATIONS["c3vdv2"]
        for radius, angle_deg in ((100, 7.5), (300, 23.0), (500, 41.1), (672, 60.9), (862, 87.7)):
            found = np.degrees(np.arctan2(radius, camera.axial(np.array(float(radius)))))
            assert found == pytest.approx(angle_deg, abs=0.06)

    def test_scaling_moves_no_ray(self) -> None:
        full = CALIBRATIONS["c3vdv2"]
        half = full.scaled(675, 540)
        pixels = np.random.default_rng(1).uniform(0, 500, (100, 2))
        np.testing.assert_allclose(half.rays(pixels), full.rays((pixels + 0.5) * 2 - 0.5), atol=1e-12)

    def test_scaled_is_what_the_simulated_set_ships(self, shared_data) -> None:
        content = json.loads((shared_data / "c3vdv2_sim/c9_transverse1_t3_v1/calibration.json").read_text())
        shipped, scaled = camera_from_json(content), CALIBRATIONS["c3vdv2"].scaled(675, 540)
        for field in ScaramuzzaCamera.__dataclass_fields__:
            assert getattr(shipped, field) == pytest.approx(getattr(scaled, field), rel=1e-12)

    def test_another_proportion_is_refused(self) -> None:
        with pytest.raises(SourceError, match="field calibration: the calibration is for 1350 x 1080"):
            CALIBRATIONS["c3vdv2"].scaled(640, 480)

    def test_rays_behind_the_lens_have_no_pixel(self) -> None:
        camera = CALIBRATIONS["c3vdv2"]
        assert np.isnan(camera.project(np.array([[0.1, 0, -1.0]]))).all()


GOOD = {"width": 675, "height": 540, "a1": 0.0, **scaled_lens("c3vdv2", 675)}


class TestCalibrationFile:
    def test_good(self) -> None:
        assert camera_from_json(GOOD).a0 == pytest.approx(383.8668)

    @pytest.mark.parametrize(
        ("change", "field", "message"),
        [
            ({"cx": None}, "cx", "found None, expected a finite number"),
            ({"a0": "long"}, "a0", "found 'long'"),
            ({"a4": float("nan")}, "a4", "finite number"),
            ({"a0": -383.0}, "a0", "z grows forward"),
            ({"a1": 0.3}, "a1", "no linear term"),
            ({"cy": 900.0}, "cy", "lies outside an image of 675 x 540"),
            ({"width": 0}, "width", "0 pixels"),
            ({"d": 2.0}, "c", "nearly the identity"),
        ],
    )
    def test_damage_is_named(self, change, field, message) -> None:
        with pytest.raises(SourceError, match=message) as caught:
            camera_from_json({**GOOD, **change}, file="calibration.json")
        assert (caught.value.field, caught.value.file) == (field, "calibration.json")

    def test_no_object(self) -> None:
        with pytest.raises(SourceError, match="expected an object"):
            camera_from_json([1, 2])


class TestPinhole:
    @pytest.mark.parametrize("name", ["c3vd", "c3vdv2"])
    @pytest.mark.parametrize("width", [225, 675])
    def test_grid_against_an_independent_solver(self, name, width) -> None:
        plan = PinholeResampling.planned(CALIBRATIONS[name].scaled(675, 540), IngestConfig(width=width))
        lens = scaled_lens(name, 675)
        rays = pinhole_rays(plan.K, plan.width, plan.height)
        rng = np.random.default_rng(0)
        for row, column in zip(
            rng.integers(0, plan.height, 300), rng.integers(0, plan.width, 300), strict=True
        ):
            found, expected = plan.centres[row, column], solved_pixel(lens, rays[row, column])
            np.testing.assert_allclose(found, expected, atol=1e-8)

    @pytest.mark.parametrize("name", ["c3vd", "c3vdv2"])
    @pytest.mark.parametrize("width", [160, 225, 400, pytest.param(675, marks=pytest.mark.slow)])
    def test_pictures_stay_in_register(self, name, width) -> None:
        """A picture of directions, seen by the fisheye and resampled, against the same seen by the pinhole.

        The offset is fitted in the whole image and in each ninth of it.
        """
        plan = PinholeResampling.planned(CALIBRATIONS[name].scaled(675, 540), IngestConfig(width=width))
        fisheye = np.rint(pattern(lens_rays(scaled_lens(name, 675), 675, 540))).astype(np.uint8)
        found = plan.color(fisheye).astype(np.float64)
        fine = pattern(pinhole_rays(plan.K, plan.width, plan.height, 4))
        expected = fine.reshape(plan.height, 4, plan.width, 4, 3).mean(axis=(1, 3))
        assert np.abs(found - expected).max() < 4
        assert np.abs(found - expected).mean() < 0.6
        down, right = np.gradient(expected, axis=(0, 1))
        for rows in np.array_split(np.arange(plan.height), 3):
            for columns in np.array_split(np.arange(plan.width), 3):
                here = np.ix_(rows, columns)
                slopes = np.stack([right[here].ravel(), down[here].ravel()], 1)
                offset = np.linalg.lstsq(slopes, (found - expected)[here].ravel(), rcond=None)[0]
                assert np.abs(offset).max() < 0.02

    def test_the_profile_balanced_keeps_the_size_of_the_frames(self) -> None:
        camera = CALIBRATIONS["c3vdv2"].scaled(675, 540)
        plan = PinholeResampling.planned(camera, PROFILES["balanced"].ingest)
        assert (plan.width, plan.height) == (675, 540)
        assert plan.K[0, 0] == pytest.approx(337.5 / np.tan(np.radians(50)))

    def test_the_profile_paper_keeps_the_central_resolution(self) -> None:
        camera = CALIBRATIONS["c3vdv2"].scaled(675, 540)
        plan = PinholeResampling.planned(camera, PROFILES["paper"].ingest)
        assert 2 * np.degrees(np.arctan(plan.width / 2 / plan.K[0, 0])) == pytest.approx(100)
        assert plan.width / plan.height == pytest.approx(675 / 540, abs=0.002)
        steps = np.hypot(*np.moveaxis(np.diff(plan.centres, axis=1), -1, 0))
        # No new pixel spans more than one of the source, and at the centre hardly less.
        assert 0.99 < steps.max() < 1.001

    def test_a_width_or_a_divisor_count_before_the_size(self) -> None:
        camera = CALIBRATIONS["c3vdv2"].scaled(675, 540)
        for size in ("thumbnail", "source", "central"):
            for given, wanted in (({"width": 300}, (300, 240)), ({"downscale": 2}, (337, 270))):
                plan = PinholeResampling.planned(camera, IngestConfig(size=size, **given))
                assert (plan.width, plan.height) == wanted

    def test_usual_size_and_field_of_view(self) -> None:
        for width, height in ((1350, 1080), (675, 540)):
            plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(width, height), IngestConfig())
            assert (plan.width, plan.height) == (225, 180)
            assert plan.K[0, 0] == plan.K[1, 1] == pytest.approx(112.5 / np.tan(np.radians(50)))
            np.testing.assert_array_equal(plan.K[:2, 2], [112.5, 90])
            # Nearly as wide as the lens allows: no pixel lies outside, a little wider some do.
            assert plan.inside.all()
        wide = PinholeResampling.planned(CALIBRATIONS["c3vdv2"], IngestConfig(field_of_view_deg=110.0))
        assert 0.9 < wide.inside.mean() < 1
        assert not wide.inside[0, 112]
        assert wide.inside[90, 112]

    def test_fine_detail_is_averaged_not_aliased(self) -> None:
        checks = (np.indices((540, 675)).sum(axis=0) % 2 * 200 + 20).astype(np.uint8)
        plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(675, 540), IngestConfig(width=160))
        small = plan.color(np.repeat(checks[..., None], 3, axis=2)).astype(float)
        assert abs(small.mean() - 120) < 2
        assert small.std() < 12

    def test_depth_is_not_mixed_across_a_fold(self) -> None:
        plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(675, 540), IngestConfig(width=225))
        depth = np.full((540, 675), 10, np.float32)
        depth[:, 300:] = 30
        depth[200:230, 100:120] = 0
        assert set(np.unique(plan.depth(depth))) == {0.0, 10.0, 30.0}

    def test_depth_of_a_plane(self) -> None:
        """z-depth of a slanted plane as the fisheye sees it, against the pinhole's own."""
        plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(675, 540), IngestConfig(width=225))

        def plane(rays: np.ndarray) -> np.ndarray:
            return 20 / (1 + 0.2 * rays[..., 0] / rays[..., 2] + 0.1 * rays[..., 1] / rays[..., 2])

        fisheye = plane(lens_rays(scaled_lens("c3vdv2", 675), 675, 540))
        found = plan.depth(np.where(fisheye > 0, fisheye, 0).astype(np.float32))
        np.testing.assert_allclose(found, plane(pinhole_rays(plan.K, 225, 180)), rtol=1e-5)

    def test_mask_needs_the_whole_footprint(self) -> None:
        plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(675, 540), IngestConfig(width=225))
        mask = np.ones((540, 675), bool)
        column, row = np.rint(plan.centres[60, 40]).astype(int)
        mask[row, column] = False
        small = plan.mask(mask)
        assert not small[60, 40]
        # And those whose interpolation reaches it.
        assert (~small).sum() <= 20

    @pytest.mark.parametrize("width", [225, 675])
    def test_no_colour_comes_from_beyond_the_mask(self, width) -> None:
        """Bicubic interpolation reaches over the edge of a mask, and overshoots inside."""
        plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(675, 540), IngestConfig(width=width))
        x, y = np.meshgrid(np.arange(675), np.arange(540))
        mask = np.hypot(x - 330, y - 260) < 190
        image = np.where(mask[..., None], 200, 0).astype(np.uint8).repeat(3, axis=2)
        kept = plan.mask(mask)
        assert kept.mean() > 0.2
        assert (plan.color(image)[kept] == 200).all()

    @pytest.mark.parametrize(
        ("settings", "message"),
        [({"width": 300, "height": 100}, "would squeeze"), ({"width": 2000}, "larger than the source")],
    )
    def test_impossible_sizes(self, settings, message) -> None:
        with pytest.raises(ConfigError, match=message):
            PinholeResampling.planned(CALIBRATIONS["c3vdv2"], IngestConfig(**settings))

    def test_image_of_another_size(self) -> None:
        plan = PinholeResampling.planned(CALIBRATIONS["c3vdv2"].scaled(675, 540), IngestConfig(width=64))
        with pytest.raises(SourceError, match=r"frame 7, field rgb: 64 x 64 pixels; expected 675 x 540"):
            plan.color(np.zeros((64, 64, 3), np.uint8), frame=7)
