"""`ingest.lens=native`: frames that keep their pixels, and the lens that is fitted to them."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from data_catalog.c3vd.scaramuzza import CALIBRATIONS
from data_catalog.catalog import read
from data_catalog.matches import FrameMatches, pose_support
from data_catalog.readers.colmap_files import read_model, write_model
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.cameras import (
    invert_poses,
    pixel_rays,
    project_points,
    rotation_about,
    rotation_angle_deg,
    unproject_pixels,
)
from extrags.config import IngestConfig, PipelineConfig
from extrags.errors import ConfigError, SourceError
from extrags.lens import Lens
from extrags.radial_lens import RadialLens
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.c3vd_fixture import reprojection_mm, write_video

NATIVE = IngestConfig(lens="native")
LENS = RadialLens((0.05, -0.02, 0.01, -0.003), float(np.radians(40)))


@pytest.fixture(scope="module")
def fisheye(tmp_path_factory: pytest.TempPathFactory) -> dict[str, EndoscopicSequence]:
    """A video of C3VDv2's layout, in its own pixels and as a pinhole."""
    written = write_video(tmp_path_factory.mktemp("c3vd") / "colon_v1", frames=12, first=0)
    return {
        lens: read(written.folder, IngestConfig.model_validate({"width": 45, "lens": lens}))
        for lens in ("native", "pinhole")
    }


def test_a_fisheye_keeps_its_pixels(fisheye: dict[str, EndoscopicSequence]) -> None:
    native, pinhole = fisheye["native"], fisheye["pinhole"]
    assert pinhole.lens is None
    assert native.lens is not None
    assert native.rgb.shape == pinhole.rgb.shape
    assert 0.97 < native.mask.mean() < 1  # the corners lie beyond 85 degrees
    assert native.K[0, 0, 0] > 1.2 * pinhole.K[0, 0, 0]
    # The depth of one frame, carried into the next through the lens, lies on the surface seen there.
    np.testing.assert_allclose(native.world_from_camera, pinhole.world_from_camera, atol=5e-4)
    points = native.cameras[3].centers[0] + (
        native.depth_mm[3][..., None] * pixel_rays(native.cameras[3])[0]  # type: ignore[index]
    ).reshape(-1, 3)
    (pixels,), (z,) = native.cameras[4].project(points)
    inside = native.cameras.contains(pixels)
    column, row = pixels[inside].astype(int).T
    found = native.depth_mm[4][row, column]  # type: ignore[index]
    assert inside.mean() > 0.8
    assert np.median(np.abs(found / z[inside] - 1)) < 0.02


def test_poses_are_judged_through_the_lens(clip: EndoscopicSequence) -> None:
    """Right poses would be said to be wrong: far from the axis a pinhole's rays are others."""
    lens = RadialLens((-0.2, 0.04, 0.008, -0.003), float(np.radians(85)))
    fisheye = replace(clip, lens=lens, depth_mm=None, observed=None)
    generator = np.random.default_rng(0)
    matches = []
    for first in range(4):
        # Points before both cameras, seen through the lens.
        seen = generator.uniform((0, 0), (clip.width, clip.height), (400, 2))
        rays = unproject_pixels(seen, clip.K[first], lens)
        points = fisheye.cameras[first].centers[0] + (rays * generator.uniform(20, 60, (400, 1))) @ (
            fisheye.cameras.world_from_camera[first, :3, :3].T
        )
        (there,), (z,) = fisheye.cameras[first + 1].project(points)
        kept = (z > 1) & fisheye.cameras.contains(there)
        matches.append(FrameMatches(first, first + 1, seen[kept], there[kept]))
    support = pose_support(fisheye, matches)
    assert support.as_given > 0.99
    assert pose_support(replace(fisheye, lens=None), matches).as_given < 0.9


def test_as_a_pinhole_it_is_what_ingest_makes(fisheye: dict[str, EndoscopicSequence]) -> None:
    flat, pinhole = fisheye["native"].as_pinhole(), fisheye["pinhole"]
    np.testing.assert_allclose(flat.K, pinhole.K)
    both = flat.mask & pinhole.mask
    assert both.mean() > 0.95
    assert np.abs(flat.rgb.astype(float) - pinhole.rgb)[both].mean() < 6
    ratio = flat.depth_mm[both] / pinhole.depth_mm[both]  # type: ignore[index]
    assert np.median(np.abs(ratio - 1)) < 0.02
    median, agree = reprojection_mm(flat, 3, 4)
    assert median < 0.1
    assert agree > 0.8
    assert pinhole.as_pinhole() is pinhole


def test_the_lens_is_stored(fisheye: dict[str, EndoscopicSequence], tmp_path) -> None:
    native = fisheye["native"]
    native.save(tmp_path / "sequence")
    back = EndoscopicSequence.load(tmp_path / "sequence")
    assert back.lens == native.lens
    assert back.training_part().lens == native.lens
    assert back.at_most_width(20).lens == native.lens


def test_colmap_out_and_in(clip, tmp_path, caplog) -> None:
    seen = replace(clip, lens=LENS)
    seen = replace(seen, mask=seen.mask & seen.cameras.field)
    write_colmap(seen, tmp_path / "scene")
    model = read_model(tmp_path / "scene" / "sparse" / "0")
    assert {lens.model for lens in model.lenses.values()} == {"OPENCV_FISHEYE"}
    with caplog.at_level(logging.INFO):
        back = read(tmp_path / "scene", NATIVE)
    assert "at most 0.00 px" in caplog.text
    assert "of the source's pixels are used" in caplog.text
    np.testing.assert_array_equal(back.rgb[back.mask], seen.rgb[seen.mask])
    np.testing.assert_array_equal(back.depth_mm, seen.depth_mm)
    np.testing.assert_allclose(back.K, seen.K, atol=1e-6)
    assert back.lens is not None
    np.testing.assert_allclose(back.lens.coefficients, LENS.coefficients, atol=1e-6)
    write_transforms(seen, tmp_path / "nerf")
    other = read(tmp_path / "nerf", NATIVE)
    assert other.lens is not None
    np.testing.assert_allclose(other.lens.coefficients, LENS.coefficients, atol=1e-6)


@pytest.mark.parametrize(
    ("parameters", "settings", "error", "said"),
    [
        ((60.0, 61.0, 47.0, 39.5, -0.15, 0.02, 0.09, 0.05), {}, SourceError, "px from this lens"),
        (
            (60.0, 61.0, 47.0, 39.5, -0.1, 0.0, 0.0, 0.0),
            {"field_of_view_deg": 80.0},
            ConfigError,
            "lens's own",
        ),
    ],
)
def test_refused(clip, tmp_path, parameters, settings, error, said) -> None:
    write_colmap(clip, tmp_path / "scene")
    model = read_model(tmp_path / "scene" / "sparse" / "0")
    lens = Lens("OPENCV", parameters, 96, 77)
    write_model(replace(model, lenses={1: lens}), tmp_path / "scene" / "sparse" / "0")
    with pytest.raises(error, match=said):
        read(tmp_path / "scene", IngestConfig(lens="native", **settings))


@pytest.mark.parametrize(("name", "largest_px", "roll_deg"), [("c3vd", 0.8, 0.167), ("c3vdv2", 1.2, 0.008)])
def test_published_lenses(name, largest_px, roll_deg) -> None:
    """At their full size; the shear of the first is a turn about the axis, which goes into the pose."""
    camera = CALIBRATIONS[name]
    fit = camera.radial()
    assert np.degrees(fit.roll_rad) == pytest.approx(roll_deg, abs=0.002)
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-3, 3, (2, 4000)), rng.uniform(0.3, 2, 4000)], axis=-1)
    true = camera.project(points) + 0.5
    turned = points @ rotation_about(np.array([0.0, 0, 1]), fit.roll_rad).T
    off = np.linalg.norm(project_points(turned, fit.K, fit.lens) - true, axis=-1)
    inside = (true >= 0).all(axis=-1) & (true <= [camera.width, camera.height]).all(axis=-1)
    off = off[inside & np.isfinite(off)]
    assert len(off) > 1000
    assert off.max() < largest_px
    assert np.sqrt(np.mean(off**2)) < 0.25


def test_a_turned_lens_turns_its_poses(tmp_path) -> None:
    written = write_video(tmp_path / "colon_v1", frames=2, first=0, layout="c3vd")
    native, pinhole = (
        read(written.folder, IngestConfig.model_validate({"width": 45, "lens": lens}))
        for lens in ("native", "pinhole")
    )
    turned = rotation_angle_deg(native.world_from_camera[:, :3, :3], pinhole.world_from_camera[:, :3, :3])
    np.testing.assert_allclose(turned, 0.167, atol=0.002)
    np.testing.assert_array_equal(native.world_from_camera[:, :3, 3], pinhole.world_from_camera[:, :3, 3])
    # What a camera has at a direction, its turned image has at the turned one (`test_published_lenses`).
    roll = rotation_about(np.array([0.0, 0, 1]), CALIBRATIONS["c3vd"].radial().roll_rad)
    point = np.array([3.0, -20, 40])
    for frame in range(2):
        seen = invert_poses(pinhole.world_from_camera[frame]) @ [*point, 1]
        seen_turned = invert_poses(native.world_from_camera[frame]) @ [*point, 1]
        np.testing.assert_allclose(seen_turned[:3], roll @ seen[:3], rtol=0, atol=1e-9)


def test_a_pinhole_has_no_lens_to_keep(clip, tmp_path) -> None:
    write_colmap(clip, tmp_path / "scene")
    assert read(tmp_path / "scene", NATIVE).lens is None


def test_radiance_fields_are_pinholes() -> None:
    config = PipelineConfig().with_overrides({"ingest.lens": "native", "uc_nerf.enabled": True})
    with pytest.raises(ConfigError, match="uc_nerf"):
        config.check_imported()
