from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from data_catalog.phantom.appearance import paint
from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.geometry import build_wall
from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.recording import Phantom, record
from data_catalog.phantom.thorough import PASSES, examination, sees_pocket
from data_catalog.phantom.trajectories import MIN_CLEARANCE_MM, camera_path, path_style, styled_path
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, invert_poses, pixel_rays
from extrags.config import IngestConfig
from extrags.errors import ConfigError
from extrags.observed_surface import observed_from_depth
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.conftest import SMALL


def carried(
    cameras: Cameras, depth_mm: np.ndarray, first: int, second: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of one frame in another: positions [N, 2], their depth there, and the source pixels' index."""
    rays = pixel_rays(cameras[first])[0]
    points = cameras.centers[first] + rays * depth_mm[first][..., None]
    local = points.reshape(-1, 3) @ cameras.viewmats[second][:3, :3].T + cameras.viewmats[second][:3, 3]
    K = cameras.K[second]
    z = np.maximum(local[:, 2], 1e-9)
    uv = np.stack([K[0, 0] * local[:, 0] / z + K[0, 2], K[1, 1] * local[:, 1] / z + K[1, 2]], axis=1)
    inside = (local[:, 2] > 0) & (uv >= 1).all(1) & (uv[:, 0] < cameras.width - 1)
    inside &= uv[:, 1] < cameras.height - 1
    return uv[inside], local[inside, 2], np.flatnonzero(inside)


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    x, y = uv[:, 0] - 0.5, uv[:, 1] - 0.5
    return cv2.remap(image, x.astype(np.float32)[None], y.astype(np.float32)[None], cv2.INTER_LINEAR)[0]


class TestGroundTruth:
    def test_depth_carries_from_frame_to_frame(self) -> None:
        """Exact up to the look-up between pixels: 0.2 mm at the median, occluded pixels left out."""
        phantom = Phantom(PhantomConfig(scene=3))
        cameras = phantom.cameras("b", np.linspace(0.2, 0.5, 7))
        depth_mm = np.stack([phantom.z_depth(cameras[k]) for k in range(7)])
        errors = []
        for first, second in ((0, 1), (1, 2), (3, 2), (6, 5)):
            uv, depth, _ = carried(cameras, depth_mm, first, second)
            error = np.abs(1 / bilinear(1 / depth_mm[second], uv) - depth)
            errors.append(error[error < np.maximum(1.0, 0.05 * depth)])
        assert len(np.concatenate(errors)) > 10_000
        assert np.median(np.concatenate(errors)) < 0.2

    def test_depth_lies_on_the_wall(self, sparse: EndoscopicSequence) -> None:
        wall = build_wall(PhantomConfig(scene=0))
        assert sparse.depth_mm is not None
        rays = pixel_rays(sparse.cameras[25])[0]
        points = sparse.cameras.centers[25] + rays * sparse.depth_mm[25][..., None]
        assert RayCaster(wall.vertices, wall.triangles).clearance_mm(points.reshape(-1, 3)).max() < 0.01

    def test_observed_agrees_with_a_depth_test(
        self, sparse: EndoscopicSequence, distanced: EndoscopicSequence
    ) -> None:
        """Occlusion rays and training depth maps are two ways to the same answer, but for pixel borders."""
        for sequence in (sparse, distanced):
            assert sequence.depth_mm is not None
            assert sequence.observed is not None
            by_depth = observed_from_depth(
                sequence.cameras,
                sequence.mask,
                sequence.depth_mm,
                sequence.train,
                sequence.test,
                tolerance_share=0.02,
            )
            agreement = (by_depth == sequence.observed)[sequence.test].mean()
            assert agreement > 0.97
            assert not sequence.observed[sequence.train].any()

    def test_every_pixel_has_depth(self, sparse: EndoscopicSequence, distanced: EndoscopicSequence) -> None:
        for sequence in (sparse, distanced):
            assert sequence.depth_mm is not None
            assert (sequence.depth_mm > 3).all()
            assert (sequence.depth_mm < 200).all()

    def test_colour_belongs_to_the_surface(self) -> None:
        """The mucosa of one frame is found again in another: texture is fixed to the wall."""
        config = PhantomConfig(scene=0, noise=False, speculars=False)
        phantom = Phantom(config)
        cameras = phantom.cameras("b", np.array([0.3, 0.34]))
        depth_mm = np.stack([phantom.z_depth(cameras[k]) for k in range(2)])
        sensor = recording_sensor(config, 1, phantom.scene_gain())
        redness = []
        for k in range(2):
            image, _ = phantom.photograph(cameras[k], sensor, 1, k)
            linear = np.maximum(image.astype(np.float32), 4)
            ratio = np.log(linear[..., 0] / linear[..., 1])
            redness.append(ratio - cv2.GaussianBlur(ratio, (0, 0), 5))
        uv, depth, pixel = carried(cameras, depth_mm, 0, 1)
        same = np.abs(bilinear(depth_mm[1], uv) - depth) < 0.03 * depth
        here = redness[0].reshape(-1)[pixel][same]
        matched = np.corrcoef(here, bilinear(redness[1], uv[same]))[0, 1]
        shifted = np.corrcoef(here, bilinear(np.roll(redness[1], 9, axis=1), uv[same]))[0, 1]
        assert matched > 0.6
        assert abs(shifted) < 0.25

    def test_truth_is_json_and_survives_the_disk(self, sparse: EndoscopicSequence, tmp_path) -> None:
        sparse.save(tmp_path / "sequence")
        again = EndoscopicSequence.load(tmp_path / "sequence")
        assert again.truth["separation"] == sparse.truth["separation"]
        assert len(again.truth["exposure"]) == len(sparse)
        np.testing.assert_array_equal(again.rgb, sparse.rgb)


class TestRecordings:
    def test_default_split(self, sparse: EndoscopicSequence) -> None:
        assert len(sparse.train) == 20
        assert len(sparse.test) == 28
        assert sparse.recording is not None
        assert set(sparse.recording[sparse.train]) == {1}
        assert set(sparse.recording[sparse.test]) == {0}
        # Every tenth frame of a video of 200.
        assert [sparse.frame_name(int(k)) for k in sparse.train[:3]] == ["b_0000", "b_0010", "b_0020"]

    def test_settings_share_the_training_frames(
        self, sparse: EndoscopicSequence, distanced: EndoscopicSequence
    ) -> None:
        np.testing.assert_array_equal(sparse.rgb[sparse.train], distanced.rgb[distanced.train])
        assert not np.array_equal(sparse.rgb[sparse.test], distanced.rgb[distanced.test])

    @pytest.mark.parametrize(
        ("setting", "unseen", "distance_mm", "angle_deg"),
        [("sparse", (0.04, 0.14), (6, 9), (22, 36)), ("distanced", (0.15, 0.30), (8, 11), (38, 62))],
    )
    def test_separation(self, setting, unseen, distance_mm, angle_deg, request) -> None:
        """The figures that the trajectories' docstring states, for scene 0."""
        separation = request.getfixturevalue(setting).truth["separation"]
        assert unseen[0] < separation["unseen_share_mean"] < unseen[1]
        assert distance_mm[0] < separation["distance_mm_median"] < distance_mm[1]
        assert angle_deg[0] < separation["axis_angle_deg_median"] < angle_deg[1]

    @pytest.mark.parametrize("scene", [0, 4, 11])
    def test_lens_keeps_clear_of_the_wall(self, scene) -> None:
        wall = build_wall(PhantomConfig(scene=scene))
        rays = RayCaster(wall.vertices, wall.triangles)
        for setting in ("sparse", "distanced"):
            config = PhantomConfig(scene=scene, setting=setting)
            for recording in ("a", "b"):
                poses = camera_path(config, wall, rays, recording, np.linspace(0, 1, 100))
                assert rays.clearance_mm(poses[:, :3, 3]).min() > MIN_CLEARANCE_MM
                steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
                assert steps.max() < 2.5  # a path, not jumps: about 0.8 mm a step

    def test_poses_are_rigid(self, distanced: EndoscopicSequence) -> None:
        poses = distanced.cameras.world_from_camera
        product = invert_poses(poses) @ poses
        np.testing.assert_allclose(product, np.broadcast_to(np.eye(4), poses.shape), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-12)


def thorough(setting: str, **settings: int) -> EndoscopicSequence:
    small = {"width": 40, "height": 32, "supersample": 1}
    config = {"scene": 11, "setting": setting, **small, **settings}
    return record(PhantomConfig.model_validate(config), "x")


@pytest.fixture(scope="module")
def covered() -> EndoscopicSequence:
    return thorough("covered")


@pytest.fixture(scope="module")
def pocket() -> EndoscopicSequence:
    return thorough("pocket")


class TestThoroughExamination:
    def test_held_out_frames_lie_between_those_that_train(self, covered: EndoscopicSequence) -> None:
        assert (len(covered.train), len(covered.test)) == (120, 28)
        assert set(covered.recording) == {1}
        # Exposures of held-out frames are those of their neighbours in time: the order matters.
        assert sorted(covered.frame_names) == list(covered.frame_names)
        for index in covered.test.tolist():
            before, after = covered.frame_names[index - 1], covered.frame_names[index + 1]
            assert {index - 1, index + 1} <= set(covered.train.tolist())
            assert before[0] == covered.frame_names[index][0] == after[0]
        assert {name[0] for name in covered.frame_names} == set("bcdefg")

    def test_covered_leaves_hardly_anything_unseen(self, covered: EndoscopicSequence) -> None:
        assert covered.truth["separation"]["unseen_share_mean"] < 0.002

    def test_the_pocket_is_all_that_is_left_out(
        self, covered: EndoscopicSequence, pocket: EndoscopicSequence
    ) -> None:
        assert 60 < len(pocket.train) < 110
        names = np.array(covered.frame_names)
        kept = np.isin(names, pocket.frame_names)
        np.testing.assert_array_equal(covered.rgb[kept], pocket.rgb)
        assert set(names[covered.test]) == {pocket.frame_names[index] for index in pocket.test}
        wall = build_wall(PhantomConfig(scene=11))
        assert covered.depth_mm is not None
        sees = sees_pocket(wall, covered.cameras, covered.depth_mm)
        # Those that were left out, and no other that trains.
        np.testing.assert_array_equal(sees[covered.train], ~kept[covered.train])
        assert pocket.truth["separation"]["unseen_share_mean"] > 0.02

    def test_fewer_frames_of_all_passes(self) -> None:
        few = thorough("covered", max_frames=12)
        assert len(few) == 12
        assert len(few.test) == 2
        assert len({name[0] for name in few.frame_names}) >= 5

    @pytest.mark.parametrize("scene", [0, 11])
    def test_lens_keeps_clear_of_the_wall(self, scene) -> None:
        config = PhantomConfig(scene=scene, setting="covered")
        wall = build_wall(config)
        rays = RayCaster(wall.vertices, wall.triangles)
        for _, style, stream in PASSES:
            path = styled_path(config, wall, rays, style, stream, np.linspace(0, 1, 100))
            assert rays.clearance_mm(path[:, :3, 3]).min() > MIN_CLEARANCE_MM

    @pytest.mark.parametrize(("video_frames", "train_every"), [(4, 1), (10, 10)])
    def test_without_a_frame_between_two_that_train_nothing_is_held_out(
        self, video_frames: int, train_every: int
    ) -> None:
        config = PhantomConfig(setting="covered", video_frames=video_frames, train_every=train_every)
        with pytest.raises(ConfigError, match=f"none with train_every={train_every} "):
            examination(config)
        plan = examination(config.model_copy(update={"video_frames": 11, "train_every": 10}))
        assert plan.number[~plan.trains].tolist() == [5] * len(PASSES)

    def test_one_recording_has_no_other(self) -> None:
        with pytest.raises(ConfigError, match="the setting covered has no recording a"):
            path_style("a", "covered")


class TestImages:
    def test_looks_like_mucosa(self, sparse: EndoscopicSequence, distanced: EndoscopicSequence) -> None:
        for sequence in (sparse, distanced):
            mean = sequence.rgb.mean(axis=(0, 1, 2))
            assert mean[0] > 1.3 * mean[1] > 1.3 * mean[2]
            assert 60 < mean.mean() < 130
            assert (sequence.rgb >= 250).any(axis=-1).mean() < 0.03
            assert (sequence.rgb.max(axis=-1) < 8).mean() < 0.05

    def test_light_falls_with_distance(self, sparse: EndoscopicSequence) -> None:
        assert sparse.depth_mm is not None
        grey = np.log(np.maximum(sparse.rgb[5].mean(axis=-1), 1))
        assert np.corrcoef(grey.ravel(), np.log(sparse.depth_mm[5]).ravel())[0, 1] < -0.7

    def test_recordings_differ_in_exposure(self, sparse: EndoscopicSequence) -> None:
        gains = [sparse.truth["sensor"][letter]["gain"] for letter in "ab"]
        assert 0.005 < abs(gains[0] / gains[1] - 1) < 0.2

    @pytest.mark.parametrize("effect", ["noise", "speculars", "shadows"])
    def test_effects_can_be_switched_off_and_matter(self, effect) -> None:
        config = PhantomConfig(scene=2, width=48, height=40)
        phantom = Phantom(config)
        camera = phantom.cameras("a", np.array([0.5]))
        images = []
        for chosen in (config, config.model_copy(update={effect: False})):
            phantom.config = chosen
            image, _ = phantom.photograph(camera, recording_sensor(chosen, 0, 1000.0), 0, 7)
            images.append(image.astype(int))
        changed = np.abs(images[0] - images[1])
        assert changed.max() > 4
        assert changed.mean() < 12  # an effect, not another picture


class TestDeterminism:
    def test_same_bits_again(self) -> None:
        config = PhantomConfig(scene=5, max_frames=3, **{"width": 48, "height": 40})
        first, second = record(config, "x"), record(config, "x")
        np.testing.assert_array_equal(first.rgb, second.rgb)
        np.testing.assert_array_equal(first.depth_mm, second.depth_mm)
        assert first.truth == second.truth

    def test_a_frame_does_not_depend_on_its_company(self, sparse: EndoscopicSequence) -> None:
        """Rendering fewer frames renders the same frames."""
        few = record(PhantomConfig(scene=0, max_frames=5, **SMALL), "x")
        for k in range(len(few)):
            whole = sparse.frame_names.index(few.frame_name(k))
            np.testing.assert_array_equal(few.rgb[k], sparse.rgb[whole])

    def test_scenes_differ(self) -> None:
        small = {"width": 48, "height": 40, "max_frames": 2}
        images = [record(PhantomConfig(scene=k, **small), "x").rgb.astype(int) for k in (0, 1)]
        assert np.abs(images[0] - images[1]).mean() > 5

    def test_anatomy_and_texture_depend_on_the_scene_alone(self) -> None:
        """Neither on what is recorded of it nor how; tests share them."""
        one = PhantomConfig(scene=4)
        others = {
            "setting": "pocket",
            "width": 40,
            "height": 32,
            "field_of_view_deg": 70.0,
            "supersample": 1,
            "video_frames": 60,
            "train_every": 3,
            "test_frames": 5,
            "max_frames": 4,
            "exposure_spread": 0.2,
            "exposure_drift": 0.1,
            "white_balance_spread": 0.1,
            "noise": False,
            "speculars": False,
            "shadows": False,
        }
        assert set(others) | {"scene", "polyps", "variation"} == set(PhantomConfig.model_fields)
        other = PhantomConfig.model_validate({"scene": 4, **others})
        walls = [build_wall(config) for config in (one, other)]
        for name in ("points", "normals", "along", "crest", "bump"):
            np.testing.assert_array_equal(getattr(walls[1], name), getattr(walls[0], name))
        assert walls[0].polyps == walls[1].polyps
        painted = [paint(config, wall) for config, wall in zip((one, other), walls, strict=True)]
        for first, second in zip(*(texture.levels for texture in painted), strict=True):
            np.testing.assert_array_equal(first, second)

    def test_anatomy_does_not_depend_on_resolution(self) -> None:
        """Twice the resolution shows the same surface: depth at shared rays is equal."""
        small, large = (Phantom(PhantomConfig(scene=2, width=n * 48, height=n * 40)) for n in (1, 3))
        share = np.array([0.4])
        coarse = small.z_depth(small.cameras("b", share))
        fine = large.z_depth(large.cameras("b", share))
        # With three times the pixels, every middle pixel has its centre on a coarse pixel's.
        np.testing.assert_allclose(fine[1::3, 1::3], coarse, rtol=1e-4)


def test_depth_may_be_withheld() -> None:
    """Training frames without depth; evaluation as before, from the same images."""
    from data_catalog import read
    from data_catalog.true_surface import true_surface

    config = IngestConfig(width=40, height=32, max_frames=12)
    given = read("phantom/0@sparse", config)
    hidden = read("phantom/0@sparse", config.model_copy(update={"withhold_depth": True}))
    np.testing.assert_array_equal(hidden.rgb, given.rgb)
    np.testing.assert_array_equal(hidden.observed, given.observed)
    np.testing.assert_array_equal(hidden.true_depth_mm, given.depth_mm)
    assert hidden.depth_mm is not None
    assert not hidden.depth_mm[hidden.train].any()
    assert hidden.depth_mm[hidden.test].all()
    assert hidden.metric
    assert hidden.training_part().depth_mm is None
    surface = true_surface(hidden)
    assert surface is not None
    assert surface.kind == "mesh"
    # The wall is in the world of the given poses, not in that of estimated ones.
    elsewhere = true_surface(replace(hidden, truth={**hidden.truth, "world": "estimated"}))
    assert elsewhere is not None
    assert elsewhere.kind == "depth"
