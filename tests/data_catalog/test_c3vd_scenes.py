"""Scenes of several videos: the catalogue, the split manifests, the alignment, what was observed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from data_catalog.c3vd.coverage import Surface, align, read_coverage_mesh
from data_catalog.c3vd.pinhole import PinholeResampling
from data_catalog.c3vd.published import published_sets
from data_catalog.c3vd.video import Video
from data_catalog.catalog import (
    describe,
    list_sequences,
    read,
    resolve,
    source_fingerprint,
)
from extrags.cameras import invert_poses
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError, UnknownSequenceError
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.c3vd_fixture import (
    lens_rays,
    reprojection_mm,
    rewrite_pose,
    scaled_lens,
    write_mesh,
    write_video,
)

SMALL = IngestConfig(width=45)
SCENE = "c3vdv2_sim/c9_transverse1_t3"


@pytest.fixture(scope="session")
def data_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated set's two videos, as small ones."""
    root = tmp_path_factory.mktemp("root")
    for name, phase, seed in (("v1", 0.0, None), ("v2", 2.0, 5)):
        write_video(
            root / "c3vdv2_sim" / f"c9_transverse1_t3_{name}", frames=20, width=90, phase=phase, seed=seed
        )
    return root


@pytest.fixture
def only_here(data_root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("data_catalog.named_folders.data_roots", lambda: [data_root])
    return data_root


@pytest.fixture
def own_root(data_root: Path, tmp_path: Path) -> Path:
    """Both videos, to be spoilt."""
    return Path(shutil.copytree(data_root / "c3vdv2_sim", tmp_path / "videos"))


class TestCatalogue:
    def test_every_published_video(self) -> None:
        listed = {item.name: item for item in list_sequences() if item.format == "c3vd"}
        videos = [item for item in listed.values() if "@" not in item.name]
        counts = {
            name: (
                len([item for item in videos if item.name.startswith(f"{name}/")]),
                sum(item.frames for item in videos if item.name.startswith(f"{name}/")),
            )
            for name in published_sets()
        }
        assert counts == {"c3vdv2": (169, 67886), "c3vd": (22, 10015), "c3vdv2_sim": (2, 40)}
        one = listed["c3vdv2/c2_transverse2_t4_v3"]
        assert (one.segment, one.texture, one.videos, one.frames) == ("c2_transverse2", "t4", ("v3",), 940)
        assert "debris" in one.description

    def test_every_scene_with_two_trajectories_has_both_settings(self) -> None:
        dataset = published_sets()["c3vdv2"]
        both = {item.scene for item in dataset.recordings if item.video == "v1"} & {
            item.scene for item in dataset.recordings if item.video != "v1"
        }
        assert len(both) == 55
        for split in dataset.splits.values():
            assert set(split.scenes) == both
        assert list(dataset.splits["sparse"].scenes)[:2] == ["c1_cecum_t1", "c1_ascending_t2"]

    def test_the_paper_s_counts(self) -> None:
        for name, counts in (("c1_cecum_t1@sparse", (43, 218)), ("c1_ascending_t2@distanced", (42, 374))):
            scene, setting = name.split("@")
            pair = published_sets()["c3vdv2"].pair(scene, setting)
            assert (len(pair.train_frames), pair.test.frames) == counts
            assert describe(f"c3vdv2/{name}").frames == sum(counts)

    def test_names(self, only_here) -> None:
        assert resolve(SCENE) == resolve(f"{SCENE}@sparse")
        source = resolve(f"{SCENE}@distanced")
        assert source.path == str(only_here / "c3vdv2_sim" / "c9_transverse1_t3_v1")
        assert source.paths[1] == str(only_here / "c3vdv2_sim" / "c9_transverse1_t3_v2")
        assert resolve(f"{SCENE}_v2").path == source.paths[1]
        assert resolve(only_here / "c3vdv2_sim" / "c9_transverse1_t3_v2").name == f"{SCENE}_v2"
        assert describe(f"{SCENE}@sparse").available
        assert not describe("c3vdv2/c1_cecum_t1@sparse").available

    def test_videos_in_a_folder_of_their_own(self, own_root, monkeypatch) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", list)
        source = resolve(own_root / "c9_transverse1_t3@sparse")
        assert source.name == f"{SCENE}@sparse"
        assert source.path == str(own_root / "c9_transverse1_t3_v2")

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            (f"{SCENE}@spars", "c3vdv2_sim has no setting 'spars'; known: sparse, distanced"),
            ("c3vdv2/c1_cecum_t9@sparse", "c3vdv2 has no scene 'c1_cecum_t9'"),
            (
                "c3vdv2/c1_cecum_t3",
                "no two videos on different trajectories.*c1_cecum_t3_v2 and c1_cecum_t3_v3",
            ),
            ("c3vdv2/c1_cecm_t1_v1", "Did you mean c3vdv2/c1_cecum_t1_v1"),
        ],
    )
    def test_unknown_names(self, name, message) -> None:
        for question in (resolve, describe):
            with pytest.raises(UnknownSequenceError, match=message):
                question(name)

    def test_known_but_not_here(self, tmp_path, monkeypatch) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", lambda: [tmp_path])
        with pytest.raises(
            SourceNotFoundError, match=r"no folder c3vdv2/c1_cecum_t1_v2 in .*FOLDER/c1_cecum_t1@sparse"
        ):
            resolve("c3vdv2/c1_cecum_t1@sparse")

    def test_fingerprint_follows_content_and_manifest(self, only_here, own_root) -> None:
        before = source_fingerprint(f"{SCENE}@sparse")
        assert json.loads(json.dumps(before)) == before
        moved = own_root / "c9_transverse1_t3@sparse"
        assert source_fingerprint(moved) == before
        assert source_fingerprint(f"{SCENE}@distanced") != before
        rewrite_pose(own_root / "c9_transverse1_t3_v1", 3, lambda pose: pose + 0.001 * np.eye(4, k=3))
        assert source_fingerprint(moved) != before


class TestPairs:
    def test_both_videos_in_the_training_video_s_world(self, only_here) -> None:
        sequence = read(f"{SCENE}@sparse", SMALL)
        assert sequence.name == f"{SCENE}@sparse"
        assert (sequence.split.name, sequence.split.version) == ("sparse", 1)
        assert sequence.train.tolist() == list(range(20))
        assert sequence.test.tolist() == list(range(20, 40))
        assert sequence.recording.tolist() == [1] * 20 + [0] * 20
        assert sequence.frame_name(0) == "c9_transverse1_t3_v2_0000"
        folder = only_here / "c3vdv2_sim"
        own = Video.open(folder / "c9_transverse1_t3_v2").world_from_camera
        np.testing.assert_array_equal(sequence.world_from_camera[:20], own)
        assert sequence.truth["c3vd"]["alignment"]["world"] == "c9_transverse1_t3_v2"
        assert sequence.truth["c3vd"]["alignment"]["residual_mm"] < 1e-3
        # From one video into the other, by depth: the alignment holds.
        for first, second in ((2, 24), (10, 31), (17, 38)):
            median, agree = reprojection_mm(sequence, first, second)
            assert median < 0.05
            assert agree > 0.6

    def test_the_alignment_is_the_motion_that_was_written(self, tmp_path) -> None:
        first = write_video(tmp_path / "first", frames=1, width=45, seed=3)
        second = write_video(tmp_path / "second", frames=1, width=45, seed=4, phase=1.0)
        meshes = [read_coverage_mesh(item.folder / "coverage_mesh.obj") for item in (first, second)]
        found = align(*meshes)
        expected = second.own_from_common @ invert_poses(first.own_from_common[None])[0]
        np.testing.assert_allclose(found.target_from_source, expected, atol=2e-5)
        assert found.residual_mm < found.largest_residual_mm < 2e-4

    def test_every_tenth_frame_of_a_published_scene(self, tmp_path, monkeypatch) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", lambda: [tmp_path])
        for name, frames, phase in (("v1", 156, 0.0), ("v2", 117, 1.0)):
            write_video(
                tmp_path / "C3VDv2" / f"c1_transverse1_t1_{name}",
                frames=frames,
                width=25,
                phase=phase,
                seed=8,
            )
        source = resolve("c3vdv2/c1_transverse1_t1@sparse")
        sequence = read(source, IngestConfig(width=20))
        assert (len(sequence.train), len(sequence.test)) == (12, 156)
        assert sequence.frame_names[:3] == tuple(f"c1_transverse1_t1_v2_{k:04d}" for k in (0, 10, 20))
        names = [name for name, *_ in source_fingerprint(source)["files"]]
        assert "train/rgb/0010.png" in names
        assert "train/rgb/0011.png" not in names
        assert "test/rgb/0011.png" in names
        fewer = read(source, IngestConfig(width=20, max_frames=14))
        assert (len(fewer.train), len(fewer.test)) == (1, 13)

    def test_incomplete_download(self, own_root) -> None:
        (own_root / "c9_transverse1_t3_v1" / "rgb" / "0019.png").unlink()
        with pytest.raises(SourceError, match=r"19 frames \(numbers 0 to 18\); expected 20") as caught:
            read(own_root / "c9_transverse1_t3@sparse", SMALL)
        assert caught.value.field == "rgb"

    def test_no_mesh_no_alignment(self, own_root) -> None:
        (own_root / "c9_transverse1_t3_v1" / "coverage_mesh.obj").unlink()
        with pytest.raises(SourceNotFoundError, match="field coverage: no such file, and only it tells"):
            read(own_root / "c9_transverse1_t3@sparse", SMALL)

    def test_no_depth(self, own_root) -> None:
        shutil.rmtree(own_root / "c9_transverse1_t3_v1" / "depth")
        with pytest.raises(SourceNotFoundError, match="field depth: no depth"):
            read(own_root / "c9_transverse1_t3@sparse", SMALL)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda vertices: vertices[::-1], "rms.*the same vertices in the same order"),
            (lambda vertices: 1.1 * vertices, "rms.*the same vertices in the same order"),
            (lambda vertices: vertices[:-1], "2879 vertices, but 2880 in"),
        ],
    )
    def test_another_mesh(self, own_root, change, message) -> None:
        file = own_root / "c9_transverse1_t3_v1" / "coverage_mesh.obj"
        mesh = read_coverage_mesh(file)
        vertices = change(mesh.vertices)
        triangles = mesh.triangles[(mesh.triangles < len(vertices)).all(axis=1)]
        write_mesh(file, vertices, triangles, np.ones(len(triangles), bool))
        with pytest.raises(SourceError, match=message) as caught:
            read(own_root / "c9_transverse1_t3@sparse", SMALL)
        assert (caught.value.file, caught.value.field) == (str(file), "v")


@pytest.fixture(scope="module")
def recordings(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same two videos under a name that the catalogue does not know."""
    folder = tmp_path_factory.mktemp("ours")
    for name in ("v1", "v2"):
        shutil.copytree(data_root / f"{SCENE}_{name}", folder / f"phantom7_{name}")
    return folder


class TestUnregistered:
    """A scene in this layout that the catalogue does not know."""

    @pytest.fixture(autouse=True)
    def nothing_else(self, monkeypatch) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", list)

    def test_it_pairs_as_registered_ones_do(self, recordings, data_root) -> None:
        source = resolve(recordings / "phantom7@sparse")
        assert source.name == "phantom7@sparse"
        assert [Path(path).name for path in source.paths] == ["phantom7_v2", "phantom7_v1"]
        sequence = read(source, SMALL)
        registered = read(data_root / "c3vdv2_sim" / "c9_transverse1_t3@sparse", SMALL)
        assert (sequence.split.name, sequence.split.version) == ("sparse", 1)
        np.testing.assert_array_equal(sequence.train, registered.train)
        np.testing.assert_array_equal(sequence.rgb, registered.rgb)
        np.testing.assert_array_equal(sequence.world_from_camera, registered.world_from_camera)
        np.testing.assert_array_equal(sequence.observed, registered.observed)
        assert sequence.frame_name(0) == "phantom7_v2_0000"

    def test_the_other_way_round(self, recordings) -> None:
        source = resolve(recordings / "phantom7@distanced")
        assert [Path(path).name for path in source.paths] == ["phantom7_v1", "phantom7_v2"]

    def test_fingerprint_holds_no_place(self, recordings, tmp_path) -> None:
        before = source_fingerprint(recordings / "phantom7@sparse")
        assert json.loads(json.dumps(before)) == before
        copy = Path(shutil.copytree(recordings, tmp_path / "elsewhere"))
        assert source_fingerprint(copy / "phantom7@sparse") == before
        assert source_fingerprint(copy / "phantom7@distanced") != before

    def test_every_tenth_frame_of_a_recording_that_is_not_thinned(self, tmp_path) -> None:
        for name, frames, phase in (("v1", 4, 0.0), ("v3", 61, 1.0)):
            write_video(tmp_path / f"ours_{name}", frames=frames, width=25, phase=phase, seed=8)
        sequence = read(tmp_path / "ours@sparse", IngestConfig(width=20))
        assert sequence.frame_names[:3] == ("ours_v3_0000", "ours_v3_0010", "ours_v3_0020")
        assert (len(sequence.train), len(sequence.test)) == (7, 4)

    def test_an_assumed_camera_is_said(self, recordings, caplog, tmp_path) -> None:
        copy = Path(shutil.copytree(recordings, tmp_path / "elsewhere"))
        for file in copy.glob("*/calibration.json"):
            file.unlink()
        with caplog.at_level("WARNING"):
            read(copy / "phantom7@sparse", SMALL)
        assert (
            "phantom7_v2: no calibration.json, taken for the camera as published with c3vdv2" in caplog.text
        )

    def test_without_depth(self, recordings, tmp_path, caplog) -> None:
        copy = Path(shutil.copytree(recordings, tmp_path / "elsewhere"))
        shutil.rmtree(copy / "phantom7_v1" / "depth")
        found = read(copy / "phantom7@sparse", SMALL)
        assert "20 of 40 frames, " in caplog.text
        assert [index for index, depth in enumerate(found.depth_mm) if depth.any()] == found.train.tolist()
        shutil.rmtree(copy / "phantom7_v2" / "depth")
        assert read(copy / "phantom7@sparse", SMALL).depth_mm is None

    @pytest.mark.parametrize(
        ("gone", "name", "message"),
        [
            ("v1", "phantom7@sparse", r"phantom7_v1: no such folder: .* there is phantom7_v2, which"),
            ("v2", "phantom7@distanced", r"phantom7_v2: no such folder: .* there is phantom7_v1, which"),
            (None, "phantom8@sparse", r"phantom8_v1: no recording .*recordings of phantom7; did you mean"),
        ],
    )
    def test_absent(self, recordings, tmp_path, gone, name, message) -> None:
        copy = Path(shutil.copytree(recordings, tmp_path / "elsewhere"))
        if gone is not None:
            shutil.rmtree(copy / f"phantom7_{gone}")
        with pytest.raises(SourceNotFoundError, match=message):
            resolve(copy / name)

    def test_no_such_setting(self, recordings) -> None:
        with pytest.raises(UnknownSequenceError, match=r"no setting 'spars'.*did you mean sparse"):
            resolve(recordings / "phantom7@spars")


class TestCoverage:
    def test_observed_agrees_with_brute_force(self, only_here) -> None:
        """Each held-out pixel's point, carried into every training frame and held against its depth."""
        sequence = read(f"{SCENE}@distanced", IngestConfig(width=60))
        depth, K = sequence.depth_mm, sequence.K[0]
        rng = np.random.default_rng(0)
        wrong = total = 0
        for index in sequence.test[::4]:
            row, column = rng.integers(2, sequence.height - 2, 150), rng.integers(2, sequence.width - 2, 150)
            z = depth[index][row, column].astype(float)
            rays = np.stack(
                [(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], np.ones(150)], 1
            )
            pose = sequence.world_from_camera[index]
            points = (rays * z[:, None]) @ pose[:3, :3].T + pose[:3, 3]
            seen = np.zeros(150, bool)
            clear = z > 0
            for other in sequence.train:
                inverse = invert_poses(sequence.world_from_camera[other][None])[0]
                local = points @ inverse[:3, :3].T + inverse[:3, 3]
                safe = np.maximum(local[:, 2], 1e-6)
                x, y = K[0, 0] * local[:, 0] / safe + K[0, 2], K[1, 1] * local[:, 1] / safe + K[1, 2]
                inside = (local[:, 2] > 0) & (x > 0) & (y > 0) & (x < sequence.width) & (y < sequence.height)
                j = np.clip(x.astype(int), 0, sequence.width - 1)
                i = np.clip(y.astype(int), 0, sequence.height - 1)
                there = depth[other][i, j]
                margin = 0.06 * safe
                seen |= inside & (there > 0) & (safe < there + margin)
                # Neither clearly before nor clearly behind what the frame shows: a slanted wall or an edge.
                clear &= ~inside | (np.abs(safe - there) < 0.03 * safe) | (safe > there * 1.3)
            found = sequence.observed[index][row, column]
            wrong += int((found != seen)[clear].sum())
            total += int(clear.sum())
        assert total > 300
        assert wrong <= 0.02 * total
        assert not sequence.observed[sequence.train].any()
        assert 0.3 < sequence.observed[sequence.test].mean() < 0.999

    def test_masked_training_pixels_see_nothing(self, only_here) -> None:
        sequence = read(f"{SCENE}@sparse", SMALL)
        folder = only_here / "c3vdv2_sim" / "c9_transverse1_t3_v2"
        surface = Surface(read_coverage_mesh(folder / "coverage_mesh.obj"))
        mask = sequence.mask.copy()
        mask[sequence.train] = False
        assert not surface.observed(sequence.cameras, mask, sequence.train, sequence.test).any()
        mask[sequence.train, :, :20] = True
        half = surface.observed(sequence.cameras, mask, sequence.train, sequence.test)
        assert half.any()
        assert not (half & ~sequence.observed).any()


@pytest.fixture(scope="session")
def simulated(shared_data: Path) -> Path:
    if not (shared_data / "c3vdv2_sim").is_dir():
        pytest.skip("no ../shared/data/c3vdv2_sim beside the checkout")
    return shared_data / "c3vdv2_sim"


@pytest.fixture(scope="session")
def simulated_sparse(simulated: Path) -> EndoscopicSequence:
    return read(f"{SCENE}@sparse", IngestConfig(size="thumbnail"))


class TestSimulatedSet:
    """The path-traced stand-in, read as it is."""

    def test_it_is_found_and_read(self, simulated_sparse) -> None:
        assert simulated_sparse.rgb.shape == (40, 180, 225, 3)
        assert (len(simulated_sparse.train), len(simulated_sparse.test)) == (20, 20)
        assert simulated_sparse.mask.all()
        assert (simulated_sparse.depth_mm > 0).mean() > 0.995
        assert 15 < np.median(simulated_sparse.depth_mm) < 25
        recordings = simulated_sparse.truth["c3vd"]["recordings"]
        assert {entry["camera"] for entry in recordings.values()} == {"calibration.json"}

    def test_reprojection_within_and_across(self, simulated_sparse) -> None:
        within = [reprojection_mm(simulated_sparse, k, k + 1) for k in [*range(0, 19, 3), *range(20, 39, 3)]]
        centers = simulated_sparse.cameras.centers
        across = []
        for k in range(0, 20, 3):
            nearest = 20 + int(np.linalg.norm(centers[20:] - centers[k], axis=1).argmin())
            across.append(reprojection_mm(simulated_sparse, k, nearest))
        for pairs in (within, across):
            assert max(median for median, _ in pairs) < 0.02
            assert min(agree for _, agree in pairs) > 0.8

    def test_alignment_is_the_one_shipped(self, simulated, simulated_sparse) -> None:
        meshes = [
            read_coverage_mesh(simulated / f"c9_transverse1_t3_{v}" / "coverage_mesh.obj")
            for v in ("v2", "v1")
        ]
        shipped = json.loads((simulated / "c9_transverse1_t3_v2" / "calibration.json").read_text())
        found = align(*meshes)
        np.testing.assert_allclose(found.target_from_source, shipped["T_v1world_from_thisworld"], atol=1e-4)
        assert simulated_sparse.truth["c3vd"]["alignment"]["residual_mm"] < 0.0015

    def test_observed_shares(self, simulated) -> None:
        """Of the surface 0.45 and 0.53; of the fisheye pixels of v2 0.94 lie on surface that v1 saw."""
        videos = [Video.open(simulated / f"c9_transverse1_t3_{v}") for v in ("v1", "v2")]
        meshes = [read_coverage_mesh(video.mesh_file) for video in videos]
        assert meshes[0].observed_share == pytest.approx(0.45, abs=0.005)
        assert meshes[1].observed_share == pytest.approx(0.53, abs=0.005)
        to_first = align(meshes[1], meshes[0]).target_from_source
        surface = Surface(meshes[0])
        x, y = np.meshgrid(np.arange(0, 675, 6.0), np.arange(0, 540, 6.0))
        rays = videos[1].camera.rays(np.stack([x, y], -1))
        shares = []
        for pose in to_first @ videos[1].world_from_camera:
            hit, face = surface.cast(pose[:3, 3], rays @ pose[:3, :3].T)
            shares.append(meshes[0].observed[face[np.isfinite(hit)]].mean())
        assert np.mean(shares) == pytest.approx(0.945, abs=0.01)
        assert np.min(shares) == pytest.approx(0.76, abs=0.02)

    def test_pinhole_depth_against_ray_casting(self, simulated, simulated_sparse) -> None:
        surface = Surface(read_coverage_mesh(simulated / "c9_transverse1_t3_v2" / "coverage_mesh.obj"))
        for index in (0, 9, 25, 38):
            cast, _ = surface.z_depth(simulated_sparse.cameras[index])
            known = np.isfinite(cast) & (simulated_sparse.depth_mm[index] > 0)
            assert np.median(np.abs(cast - simulated_sparse.depth_mm[index])[known]) < 0.02

    def test_pinhole_picture_against_ray_casting(self, simulated) -> None:
        """The mesh, painted, seen by fisheye and resampled against seen by the pinhole: the offset in pixels.

        Fitted in each ninth of the image, where no fold cuts through a pixel.
        """
        video = Video.open(simulated / "c9_transverse1_t3_v2")
        surface = Surface(read_coverage_mesh(video.mesh_file))
        plan = PinholeResampling.planned(video.camera, IngestConfig())
        pose = video.world_from_camera[14]
        waves = np.array([[0.9, 0.2, 0.1], [-0.3, 0.8, 0.2], [0.1, -0.4, 0.9]])

        def seen(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            turned = rays @ pose[:3, :3].T
            distance, _ = surface.cast(pose[:3, 3], turned)
            points = pose[:3, 3] + turned * np.where(np.isfinite(distance), distance, 0)[..., None]
            return 128 + 100 * np.sin(points @ waves.T), distance

        fisheye, _ = seen(lens_rays(scaled_lens("c3vdv2", 675), 675, 540))
        found = plan.color(np.rint(fisheye).astype(np.uint8)).astype(float)
        u, v = ((np.arange(size * 4) + 0.5) / 4 for size in (plan.width, plan.height))
        x, y = np.meshgrid((u - plan.K[0, 2]) / plan.K[0, 0], (v - plan.K[1, 2]) / plan.K[1, 1])
        fine, depth = seen(np.stack([x, y, np.ones_like(x)], -1))
        expected = fine.reshape(plan.height, 4, plan.width, 4, 3).mean(axis=(1, 3))
        depth = depth.reshape(plan.height, 4, plan.width, 4)
        smooth = np.isfinite(depth).all(axis=(1, 3)) & (depth.max(axis=(1, 3)) < 1.1 * depth.min(axis=(1, 3)))
        assert smooth.mean() > 0.7
        down, right = np.gradient(expected, axis=(0, 1))
        for rows in np.array_split(np.arange(plan.height), 3):
            for columns in np.array_split(np.arange(plan.width), 3):
                here = np.ix_(rows, columns)
                kept = smooth[here]
                slopes = np.stack([right[here][kept].ravel(), down[here][kept].ravel()], 1)
                offset = np.linalg.lstsq(slopes, (found - expected)[here][kept].ravel(), rcond=None)[0]
                assert np.abs(offset).max() < 0.03
