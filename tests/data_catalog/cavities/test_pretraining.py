"""Recordings of cavities: cameras, pictures, clips."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_catalog.cavities.camera import pinhole, radiance, z_depth
from data_catalog.cavities.free_space import FreeSpace
from data_catalog.cavities.lamps import Lamps
from data_catalog.cavities.noise import stream
from data_catalog.cavities.pretraining import CavityConfig, cavity_config, cavity_recording
from data_catalog.cavities.processing import Processor, random_sensor
from data_catalog.cavities.real_textures import _strewn, photographed_tile, texture_files
from data_catalog.cavities.scene import Cavity
from data_catalog.cavities.shapes import KINDS
from data_catalog.cavities.views import CLIP_VIEWS, recording_poses, target_clips, unseen_share
from extrags.cameras import Cameras, pixel_rays
from extrags.errors import SourceError, SourceNotFoundError


def test_numbers_give_all_kinds_and_many_sizes() -> None:
    configs = [cavity_config(index) for index in range(40)]
    assert {config.kind for config in configs} == set(KINDS)
    assert len({(config.width, config.height) for config in configs}) > 5
    assert all(config.width % 16 == 0 and config.height % 16 == 0 for config in configs)
    assert cavity_config(7) == configs[7]
    twice = cavity_config(7, size_factor=2)
    assert (twice.width, twice.height) == (2 * configs[7].width, 2 * configs[7].height)
    assert not any(config.real_texture for config in configs)
    assert any(cavity_config(index, real_textures=True).real_texture for index in range(12))


@pytest.fixture(scope="module")
def space(colon: Cavity) -> FreeSpace:
    return FreeSpace.of(colon.lattice, colon.rays)


@pytest.fixture(scope="module")
def train(colon: Cavity, space: FreeSpace) -> Cameras:
    shape = colon.shape
    poses = recording_poses(
        space, stream(0, "path"), 8, tube=shape.tube, facing=shape.facing, radius_mm=shape.radius_mm
    )
    return Cameras(np.repeat(pinhole(48, 32, 90.0)[None], 8, 0), poses, 48, 32)


class TestCameras:
    def test_the_recording_keeps_clear_of_the_wall(self, space: FreeSpace, train: Cameras) -> None:
        assert (space.lattice.at(train.centers) > 0).all()
        assert space.rays.clearance_mm(train.centers).min() > 0.6 * space.margin_mm
        rotation = train.world_from_camera[:, :3, :3]
        np.testing.assert_allclose(
            rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (8, 1, 1)), atol=1e-9
        )

    def test_clips_are_inside_and_show_what_was_not_seen(self, space: FreeSpace, train: Cameras) -> None:
        poses, clip = target_clips(space, stream(0, "targets"), train, clips=4)
        assert clip.tolist() == np.repeat(np.arange(4), CLIP_VIEWS).tolist()
        targets = Cameras(np.repeat(train.K[:1], len(poses), 0), poses, 48, 32)
        assert space.clear(targets.centers, 0.9).all()
        unseen = unseen_share(space.rays, train, targets).reshape(-1, CLIP_VIEWS).mean(axis=1)
        assert (unseen > 0.05).sum() >= 3
        assert (unseen < 0.7).all()
        assert unseen_share(space.rays, train, train).max() < 0.01
        # A clip's views follow each other.
        step = np.linalg.norm(np.diff(targets.centers.reshape(4, CLIP_VIEWS, 3), axis=1), axis=2)
        assert step.max() < 4

    def test_depth_is_that_of_the_mesh(self, colon: Cavity, train: Cameras) -> None:
        camera = train[3]
        depth = z_depth(colon.rays, camera)
        points = camera.centers[0] + pixel_rays(camera)[0] * depth[..., None].astype(np.float64)
        assert np.isfinite(depth).all()
        assert colon.rays.clearance_mm(points.reshape(-1, 3)).max() < 1e-2

    def test_light_falls_with_distance_and_comes_from_the_lamps(self, colon: Cavity, train: Cameras) -> None:
        lamps = replace(Lamps.random(stream(0, "lamps")), reflectance=0.0)
        light = radiance(colon.wall, colon.skin, lamps, colon.rays, train[3], 1)
        depth = z_depth(colon.rays, train[3])
        near, far = depth < np.quantile(depth, 0.2), depth > np.quantile(depth, 0.8)
        assert light[near].mean() > 2 * light[far].mean()
        dark = replace(lamps, intensities=tuple(0.0 for _ in lamps.intensities))
        assert not radiance(colon.wall, colon.skin, dark, colon.rays, train[3], 1).any()


class TestProcessing:
    def test_clean_pictures_have_no_noise_and_the_same_look(self) -> None:
        light = np.linspace(0.01, 2, 32 * 48 * 3).reshape(32, 48, 3).astype(np.float32)
        processor = replace(Processor.random(stream(1, "sensor")), quality=30, shake_px=3.0)
        sensor = random_sensor(stream(1, "sensor"), 1.0)
        quiet = replace(sensor, noise=False)
        clean = [processor.picture(light, quiet, 1.0, np.random.default_rng(k), clean=True) for k in range(2)]
        np.testing.assert_array_equal(*clean)
        shown = processor.picture(light, sensor, 1.0, np.random.default_rng(0), clean=False)
        assert not np.array_equal(shown, clean[0])
        assert np.abs(shown.astype(float) - clean[0]).mean() < 20

    def test_interlace_moves_every_other_row(self) -> None:
        light = np.zeros((32, 48, 3), dtype=np.float32)
        light[:, 24:] = 1
        processor = replace(
            Processor.random(stream(2, "sensor")),
            **{"quality": 0, "shake_px": 0.0, "defocus_px": 0.1, "interlace_px": 2, "sharpening": 0.0},
        )
        sensor = replace(random_sensor(stream(2, "sensor"), 1.0), noise=False)
        image = processor.picture(light, sensor, 1.0, np.random.default_rng(0), clean=False)[..., 0].astype(
            float
        )
        edge = np.abs(np.diff(image[:, 4:-4], axis=1)).argmax(axis=1)
        assert len(set(edge[::2].tolist())) == 1
        assert abs(int(edge[1]) - int(edge[0])) == 2
        # What leaves a row on one side does not come in again on the other.
        assert image[1::2, :4].max() < image[1::2, -4:].min()


class TestRecording:
    def test_it_is_the_same_each_time_and_complete(self, small: CavityConfig) -> None:
        first, second = cavity_recording(small), cavity_recording(small)
        np.testing.assert_array_equal(first.sequence.rgb, second.sequence.rgb)
        sequence = first.sequence
        assert sequence.rgb.shape == (4 + 2 * CLIP_VIEWS, 32, 48, 3)
        assert first.kind == small.kind
        assert first.clip.tolist() == [0] * CLIP_VIEWS + [1] * CLIP_VIEWS
        assert sequence.depth_mm is not None
        assert (sequence.depth_mm[sequence.mask] > 0).all()
        assert sequence.mask[sequence.test].all()
        assert 20 < sequence.rgb[sequence.test].mean() < 235

    def test_without_views_to_restore_it_trains_on_the_same(self, small: CavityConfig) -> None:
        recording, alone = cavity_recording(small), cavity_recording(small, to_restore=False)
        whole = recording.sequence
        assert len(alone.sequence.test) == len(alone.clip) == 0
        np.testing.assert_array_equal(alone.sequence.rgb, whole.rgb[whole.train])
        assert whole.depth_mm is not None
        depth_mm = alone.z_depth_mm(whole.cameras[5])
        np.testing.assert_array_equal(np.where(np.isfinite(depth_mm), depth_mm, 0), whole.depth_mm[5])
        np.testing.assert_array_equal(alone.photograph(whole.cameras[5]), whole.rgb[5])

    def test_exposures_have_a_mean_of_one_and_targets_exactly_that(self, small: CavityConfig) -> None:
        exposure = np.array(cavity_recording(small).sequence.truth["exposure"])
        assert np.log(exposure[:4]).mean() == pytest.approx(0, abs=1e-6)
        assert (exposure[4:] == 1).all()


class TestRealTextures:
    def test_the_pieces_of_a_patch_leave_no_place_bare(self) -> None:
        patch = np.full((256, 256, 4), 0.5, dtype=np.float32)
        for seed in range(12):
            np.testing.assert_allclose(_strewn(patch, stream(seed, "paint")), 0.5, rtol=1e-5)

    def test_only_frames_at_even_positions_are_used(self, shared_data: Path) -> None:
        folder = shared_data / "laparoscopy_frames_40"
        if not folder.is_dir():
            pytest.skip("no laparoscopy_frames_40")
        everything = sorted(folder.glob("*.jpg"))
        assert texture_files(folder) == everything[::2]
        tiles = [photographed_tile(texture_files(folder), stream(k, "paint")) for k in range(4)]
        found = [tile for tile in tiles if tile is not None]
        assert found
        for tile in found:
            # It continues over its edges, and is no mirror of itself.
            inner = np.abs(np.diff(tile[..., :3], axis=0)).mean()
            assert np.abs(tile[0, :, :3] - tile[-1, :, :3]).mean() < 2 * inner
            assert np.abs(tile[:, :, :3] - tile[:, ::-1, :3]).mean() > 2 * inner
            # Illumination is divided out: no quarter is much brighter than another.
            quarters = [tile[a : a + 128, b : b + 128, :3].mean() for a in (0, 128) for b in (0, 128)]
            assert max(quarters) < 2 * min(quarters)

    def test_their_absence_is_said(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", lambda: [tmp_path])
        with pytest.raises(SourceNotFoundError, match="laparoscopy_frames_40"):
            texture_files()
        with pytest.raises(SourceError, match="no frames"):
            texture_files(tmp_path)
