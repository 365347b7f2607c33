from __future__ import annotations

import json
import logging
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read, source_fingerprint
from data_catalog.content import view_mask
from data_catalog.inspection import inspect
from data_catalog.readers.sinus import read_points, read_view_names
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError


class TestSinus:
    def test_every_observation_lies_inside_the_mask(self, shared_data) -> None:
        """570 points, 6,585 observations: the re-projection check of poses, K and crop together."""
        folder = shared_data / "sinus_hopkins"
        sequence = read(folder)
        names = read_view_names(folder)
        viewmats = sequence.cameras.viewmats
        tracks = (folder / "view_indexes_per_point").read_text().split("-1")[1:]
        points = read_points(folder)
        assert len(tracks) == len(points) == 570
        inside = total = 0
        for point, track in zip(points, tracks, strict=True):
            for view in track.split():
                index = names.index(f"{int(view):08d}")
                local = viewmats[index][:3, :3] @ point + viewmats[index][:3, 3]
                u, v, _ = sequence.K[index] @ local / local[2]
                total += 1
                row, column = int(np.floor(v)), int(np.floor(u))
                within = 0 <= row < sequence.height and 0 <= column < sequence.width
                inside += bool(local[2] > 0 and within and sequence.mask[index, row, column])
        assert total == 6585
        # The small mask leaves out pixels that the full-size border cuts.
        assert inside >= 6580

    def test_shape_and_split(self, shared_data) -> None:
        sequence = read(shared_data / "sinus_hopkins", IngestConfig(size="thumbnail"))
        assert sequence.rgb.shape == (35, 243, 262, 3)
        assert sequence.test.tolist() == [0, 8, 16, 24, 32]
        assert sequence.metric is False
        assert sequence.depth_mm is None
        assert sequence.points is not None
        assert sequence.frame_name(0) == "00004584"
        # Tissue is lit, the surround is black.
        assert sequence.rgb[sequence.mask].mean() > 60
        assert sequence.rgb[~sequence.mask].mean() < 40

    def test_wrong_pose_count(self, shared_data, tmp_path) -> None:
        folder = tmp_path / "sinus"
        folder.mkdir()
        for name in ("motion.yaml", "structure.ply", "undistorted_mask.bmp", "camera_intrinsics_per_view"):
            shutil.copyfile(shared_data / "sinus_hopkins" / name, folder / name)
        views = (shared_data / "sinus_hopkins" / "visible_view_indexes").read_text().split()
        (folder / "visible_view_indexes").write_text("\n".join(views[:-2]))
        with pytest.raises(PoseError, match=r"motion\.yaml, field poses: 35 poses for 33 frames"):
            read(folder)

    @pytest.mark.parametrize(
        ("name", "spoilt", "problem"),
        [
            (
                "visible_view_indexes",
                lambda lines: [lines[0], *lines[:-1]],
                "00004584.*the view is listed twice",
            ),
            (
                "camera_intrinsics_per_view",
                lambda lines: [*lines, *lines[::-1]],
                "8 numbers, which are not fx",
            ),
        ],
    )
    def test_what_one_pairs_with_another(self, shared_data, tmp_path, name, spoilt, problem) -> None:
        folder = tmp_path / "sinus"
        shutil.copytree(shared_data / "sinus_hopkins", folder, copy_function=shutil.copyfile)
        folder.chmod(0o755)
        lines = (folder / name).read_text().split()
        (folder / name).write_text("\n".join(lines * 2))
        if name == "camera_intrinsics_per_view":
            assert len(read(folder, IngestConfig(size="thumbnail"))) == 35
        (folder / name).write_text("\n".join(spoilt(lines)))
        with pytest.raises(SourceError, match=problem):
            read(folder)


class TestSimcol:
    def test_reprojection_of_matched_features(self, shared_data) -> None:
        """Features matched between images, carried by depth and poses: 0.65 px at the median."""
        sequence = read(shared_data / "simcol3d_s1", IngestConfig(downscale=1))
        assert sequence.depth_mm is not None
        detector = cv2.SIFT_create(1200, contrastThreshold=0.01)
        errors = []
        for first, second in ((1, 2), (4, 5), (6, 9)):
            found = [
                detector.detectAndCompute(cv2.cvtColor(sequence.rgb[k], cv2.COLOR_RGB2GRAY), None)
                for k in (first, second)
            ]
            matches = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
            good = [best for best, other in matches if best.distance < 0.7 * other.distance]
            here = np.array([found[0][0][match.queryIdx].pt for match in good]) + 0.5
            there = np.array([found[1][0][match.trainIdx].pt for match in good]) + 0.5
            z = sequence.depth_mm[first][here[:, 1].astype(int), here[:, 0].astype(int)]
            K = sequence.K[first]
            local = np.column_stack([(here - K[:2, 2]) / K[0, 0], np.ones(len(here))]) * z[:, None]
            relative = sequence.cameras.viewmats[second] @ sequence.cameras.world_from_camera[first]
            carried = local @ relative[:3, :3].T + relative[:3, 3]
            uv = carried[:, :2] / carried[:, 2:] * K[0, 0] + K[:2, 2]
            errors.append(np.linalg.norm(uv - there, axis=1))
        assert len(np.concatenate(errors)) > 300
        assert np.median(np.concatenate(errors)) < 0.8

    def test_shape_split_and_visibility(self, shared_data) -> None:
        sequence = read(shared_data / "simcol3d_s1", IngestConfig(holdout_every=3))
        assert sequence.name == "simcol3d/s1"
        assert sequence.rgb.shape == (10, 237, 237, 3)
        assert sequence.test.tolist() == [0, 3, 6, 9]
        assert sequence.depth_mm is not None
        assert sequence.observed is not None
        assert 10 < np.median(sequence.depth_mm) < 30
        # Frames between training frames see nothing new; the last one moves on to new surface.
        assert sequence.observed[3].mean() > 0.97
        assert 0.6 < sequence.observed[[0, 9]].mean(axis=(1, 2)).min() < 0.99

    def test_missing_frame_in_the_middle(self, shared_data, tmp_path) -> None:
        folder = tmp_path / "simcol"
        shutil.copytree(shared_data / "simcol3d_s1", folder, copy_function=shutil.copyfile)
        folder.chmod(0o755)
        (folder / "FrameBuffer_0004.png").unlink()
        with pytest.raises(SourceNotFoundError, match=r"FrameBuffer_0004\.png, frame 0004, field rgb"):
            read(folder)

    def test_too_few_poses(self, shared_data, tmp_path) -> None:
        folder = tmp_path / "simcol"
        shutil.copytree(shared_data / "simcol3d_s1", folder, copy_function=shutil.copyfile)
        folder.chmod(0o755)
        for file in folder.glob("Saved*.txt"):
            file.write_text("\n".join(file.read_text().splitlines()[:8]))
        with pytest.raises(PoseError, match="8 poses, but there is a frame 0008"):
            read(folder)


class TestFrames:
    @pytest.fixture
    def frames(self, tmp_path):
        rng = np.random.default_rng(0)
        for k in (2, 10, 1):
            picture = np.zeros((60, 80, 3), np.uint8)
            picture[10:50, 15:65] = rng.integers(60, 200, (40, 50, 3))
            picture[25:35, 35:45] = 3  # a dark lumen
            picture[10, 15] = 10 * k
            Image.fromarray(picture).save(tmp_path / f"frame_{k}.png")
        return tmp_path

    def test_natural_order_no_poses_and_a_mask(self, frames, caplog) -> None:
        with caplog.at_level(logging.WARNING):
            sequence = read(frames)
        assert sequence.frame_names == ("frame_1", "frame_2", "frame_10")
        assert sequence.world_from_camera is None
        assert sequence.metric is False
        assert "90 degrees" in caplog.text
        assert not sequence.mask[0, :10].any()
        assert sequence.mask[0, 28:32, 38:42].all()  # dark, but not joined to the border

    def test_masks_of_single_frames_are_not_read_and_it_is_said(self, frames, caplog) -> None:
        (frames / "masks").mkdir()
        read(frames)
        assert "masks is not read; of plain frames, one mask.png holds for all" in caplog.text

    @pytest.mark.parametrize("name", ["mask.jpg", "Mask.PNG", "mask.bmp"])
    def test_a_mask_of_another_name_is_no_frame_and_it_is_said(self, frames, name, caplog) -> None:
        Image.fromarray(np.full((60, 80), 255, np.uint8)).save(frames / name)
        assert read(frames).frame_names == ("frame_1", "frame_2", "frame_10")
        assert f"{name} is not read; the mask of all frames is" in caplog.text
        (told,) = (item for item in inspect(frames).findings if item.topic == "not read")
        assert (told.field, name in told.sentence) == ("files", True)

    def test_a_mask_among_the_images_of_a_folder_below_is_said_to_be_unread(self, frames, caplog) -> None:
        (frames / "images").mkdir()
        for file in frames.glob("*.png"):
            file.rename(frames / "images" / file.name)
        Image.fromarray(np.full((60, 80), 255, np.uint8)).save(frames / "images" / "mask.png")
        assert len(read(frames)) == 3
        assert "images/mask.png is not read; the mask of all frames is" in caplog.text

    def test_a_mask_does_not_hide_hexadecimal_counts(self, frames) -> None:
        for file, name in zip(sorted(frames.glob("*.png")), ("09", "10", "0a"), strict=True):
            file.rename(frames / f"{name}.png")
        Image.fromarray(np.full((60, 80), 255, np.uint8)).save(frames / "mask.png")
        assert read(frames).frame_names == ("09", "0a", "10")

    def test_what_macos_leaves_beside_files_is_no_frame(self, frames) -> None:
        (frames / "._frame_1.png").write_bytes(b"\x00\x05\x16\x07")
        assert read(frames).frame_names == ("frame_1", "frame_2", "frame_10")

    def test_intrinsics_file(self, frames) -> None:
        (frames / "intrinsics.json").write_text(json.dumps({"fx": 70, "fy": 71, "cx": 41, "cy": 29}))
        sequence = read(frames, IngestConfig(downscale=2))
        np.testing.assert_allclose(sequence.K[0], [[35, 0, 20.5], [0, 35.5, 14.5], [0, 0, 1]])

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ({"fx": 0, "fy": 71, "cx": 41, "cy": 29}, "focal length fx = 0 px"),
            ({"fx": 70}, "field K: no fy, cx, cy; expected K, or fx, fy, cx, cy, or field_of_view_deg$"),
            ({"focal": 72}, "field K: no K, no field_of_view_deg and no fx, fy, cx, cy; expected K, or fx"),
            ({"fx": "wide", "fy": 71, "cx": 41, "cy": 29}, 'field fx: "wide"; expected a number$'),
            ({"field_of_view_deg": None}, "field field_of_view_deg: null; expected a number$"),
            ({"field_of_view_deg": 200}, "200 degrees"),
            ({"K": [[1, 2], [3, 4]]}, "3 x 3"),
            ([70, 71, 41, 29], r"intrinsics\.json.*expected K, or fx.*found list"),
            ({"fx": 70, "fy": 71, "cx": 41, "cy": 29, "k1": -0.3}, r"k1: -0\.3; expected a pinhole"),
            ({"field_of_view_deg": 80, "dist_coeffs": [0, 0.1]}, r"dist_coeffs: .*ingest\.calibration"),
            ({"field_of_view_deg": 80, "camera_model": "OPENCV"}, 'camera_model: "OPENCV"; expected a pinh'),
            ({"field_of_view_deg": 80, "distortion_model": "equidistant"}, "distortion_model: .*a pinhole"),
            ({"field_of_view_deg": 80, "model": "fisheye 8"}, 'model: "fisheye 8"; expected a pinhole'),
            ({"field_of_view_deg": 80, "fisheye": True}, "fisheye: true; expected a pinhole"),
            ({"field_of_view_deg": 80, "D": [0.1, 0, 0, 0]}, "field D: .*expected a pinhole"),
            ({"field_of_view_deg": 80, "w": 160, "h": 120}, "for images of 160 x 120 pixels; found 80 x 60"),
        ],
    )
    def test_bad_intrinsics(self, frames, content, message) -> None:
        (frames / "intrinsics.json").write_text(json.dumps(content))
        with pytest.raises(SourceError, match=message):
            read(frames)

    def test_intrinsics_with_the_mark_of_an_editor(self, frames) -> None:
        told = {"fx": 70, "fy": 71, "cx": 41, "cy": 29}
        (frames / "intrinsics.json").write_text(f"\ufeff{json.dumps(told)}", encoding="utf-8")
        np.testing.assert_allclose(read(frames).K[0], [[70, 0, 41], [0, 71, 29], [0, 0, 1]])

    def test_a_pinhole_may_be_told_at_length(self, frames) -> None:
        told = {"fx": 70, "fy": 71, "cx": 41, "cy": 29, "k1": 0, "p2": 0.0, "model": "PINHOLE"}
        (frames / "intrinsics.json").write_text(json.dumps({**told, "width": 80, "height": 60}))
        np.testing.assert_allclose(read(frames).K[0], [[70, 0, 41], [0, 71, 29], [0, 0, 1]])

    @pytest.mark.parametrize(
        "told",
        [
            {"working_distance_mm": 20, "distance_to_board": 5.5},
            {"distortion_model": "none"},
            {"distortion_model": "plumb_bob", "D": [0, 0, 0, 0, 0]},
            {"dist_coeffs": None, "distortion": "none", "lens_distortion": {"k1": 0, "k2": 0.0}},
            {"model": "Olympus GIF-H190", "undistorted": True},
        ],
    )
    def test_what_tells_of_no_distortion_is_let_pass(self, frames, told) -> None:
        content = {"fx": 70, "fy": 71, "cx": 41, "cy": 29, **told}
        (frames / "intrinsics.json").write_text(json.dumps(content))
        np.testing.assert_allclose(read(frames).K[0], [[70, 0, 41], [0, 71, 29], [0, 0, 1]])

    def test_frame_of_another_size(self, frames) -> None:
        Image.fromarray(np.full((50, 80, 3), 99, np.uint8)).save(frames / "frame_3.png")
        with pytest.raises(SourceError, match=r"frame_3\.png.*80 x 50 pixels; expected 80 x 60"):
            read(frames)

    def test_mask_of_a_full_picture(self) -> None:
        assert view_mask(np.full((2, 20, 30, 3), 90, np.uint8)).all()


class TestPosedFolder:
    def test_round_trip(self, posed_folder) -> None:
        content = json.loads((posed_folder / "poses.json").read_text())
        sequence = read(posed_folder, IngestConfig(holdout_every=4))
        assert len(sequence) == 10
        assert sequence.test.tolist() == [0, 4, 8]
        np.testing.assert_allclose(sequence.K[0], content["K"])
        for k, entry in enumerate(content["frames"]):
            np.testing.assert_allclose(
                sequence.cameras.world_from_camera[k], entry["world_from_camera"], atol=1e-12
            )
            np.testing.assert_array_equal(sequence.depth_mm[k], np.load(posed_folder / f"depth/{k:04d}.npy"))
        assert sequence.observed is not None
        assert sequence.observed[sequence.test].mean() > 0.8

    def test_split_from_the_file(self, posed_folder, edit_poses) -> None:
        def name_splits(content) -> None:
            for k, entry in enumerate(content["frames"]):
                entry["split"] = "test" if k > 6 else "train"

        edit_poses(name_splits)
        sequence = read(posed_folder)
        assert sequence.split.name == "manifest"
        assert sequence.test.tolist() == [7, 8, 9]

    def test_depth_as_tiff(self, posed_folder) -> None:
        before = read(posed_folder).depth_mm
        for file in (posed_folder / "depth").glob("*.npy"):
            Image.fromarray(np.load(file)).save(file.with_suffix(".tiff"))
            file.unlink()
        np.testing.assert_array_equal(read(posed_folder).depth_mm, before)

    def test_masks_below_the_folders_of_their_frames(self, posed_folder, edit_poses) -> None:
        """Two recordings whose frames have the same names."""
        for kind in ("rgb", "depth"):
            for k in range(10):
                (file,) = (posed_folder / kind).glob(f"{k:04d}.*")
                place = posed_folder / kind / "ab"[k // 5] / f"{k % 5}{file.suffix}"
                place.parent.mkdir(exist_ok=True)
                file.rename(place)

        def moved(content) -> None:
            for k, entry in enumerate(content["frames"]):
                entry |= {"file": f"rgb/{'ab'[k // 5]}/{k % 5}.png", "recording": k // 5}

        edit_poses(moved)
        whole = read(posed_folder)
        assert whole.mask.mean() > 0.9
        size = whole.mask.shape[1:]
        for k in range(10):
            place = posed_folder / "mask" / "ab"[k // 5] / f"{k % 5}.bmp"
            place.parent.mkdir(parents=True, exist_ok=True)
            black = np.zeros(size, np.uint8)
            black[:, k + 1 :] = 255
            Image.fromarray(black).save(place)
        found = read(posed_folder)
        for k in range(10):
            assert not found.mask[k, :, : k + 1].any()
            np.testing.assert_array_equal(found.mask[k, :, k + 1 :], whole.mask[k, :, k + 1 :])
        np.testing.assert_array_equal(found.depth_mm, whole.depth_mm)

    @pytest.mark.parametrize("kind", ["depth", "mask"])
    def test_no_two_frames_share_a_file(self, posed_folder, edit_poses, kind) -> None:
        (posed_folder / "rgb" / "a").mkdir()
        (posed_folder / "rgb" / "0001.png").rename(posed_folder / "rgb" / "a" / "0000.png")
        shutil.rmtree(posed_folder / "mask", ignore_errors=True)
        if kind == "mask":
            shutil.rmtree(posed_folder / "depth")
            (posed_folder / "mask").mkdir()
            size = (48, 40)
            Image.new("L", size, 255).save(posed_folder / "mask" / "0000.png")
        edit_poses(lambda content: content["frames"][1].update(file="rgb/a/0000.png"))
        with pytest.raises(SourceError, match=rf"belong to rgb/0000\.png as well; .* as {kind}/a/0000\."):
            read(posed_folder)

    def test_poses_with_the_mark_of_an_editor(self, posed_folder) -> None:
        before, file = read(posed_folder), posed_folder / "poses.json"
        file.write_text(f"\ufeff{file.read_text()}", encoding="utf-8")
        np.testing.assert_array_equal(read(posed_folder).world_from_camera, before.world_from_camera)

    @pytest.mark.parametrize("number", ["a", None, 1.5, [0], 1e300])
    def test_a_recording_that_is_no_number(self, posed_folder, edit_poses, number) -> None:
        edit_poses(lambda content: content["frames"][3].update(recording=number))
        with pytest.raises(SourceError, match=r"poses\.json, frame rgb/0003\.png, field recording: found"):
            read(posed_folder)

    def test_masks_that_are_missing_or_elsewhere_are_said(self, posed_folder, caplog) -> None:
        shutil.rmtree(posed_folder / "mask", ignore_errors=True)
        size = (48, 40)
        (posed_folder / "masks").mkdir()
        Image.new("L", size, 255).save(posed_folder / "masks" / "0000.png")
        read(posed_folder)
        assert "masks is not read; masks are looked for in mask/" in caplog.text
        (posed_folder / "masks").rename(posed_folder / "mask")
        read(posed_folder)
        assert (
            "9 of 10 frames have no mask and are tissue throughout: rgb/0001.png, rgb/0002.png, "
            "rgb/0003.png, rgb/0004.png, rgb/0005.png and 4 more" in caplog.text
        )

    @pytest.mark.parametrize("spelling", ["{folder}/{name}", "./{name}", "depth/../{name}"])
    @pytest.mark.parametrize("images", ["rgb", "frames"])
    def test_spellings_of_a_path_are_one_file(self, posed_folder, edit_poses, images, spelling) -> None:
        """Joined to depth/ and mask/, an absolute path would be the image's own."""
        self.write_masks(posed_folder)
        expected = read(posed_folder)
        assert not expected.mask.all()
        (posed_folder / "rgb").rename(posed_folder / images)

        def spelt(content) -> None:
            for entry in content["frames"]:
                name = f"{images}/{entry['file'].removeprefix('rgb/')}"
                entry["file"] = spelling.format(folder=posed_folder.resolve(), name=name)

        edit_poses(spelt)
        found = read(posed_folder)
        np.testing.assert_array_equal(found.rgb, expected.rgb)
        np.testing.assert_array_equal(found.mask, expected.mask)
        np.testing.assert_array_equal(found.depth_mm, expected.depth_mm)
        assert found.frame_names == expected.frame_names

    def test_two_spellings_of_one_frame_are_refused(self, posed_folder, edit_poses) -> None:
        edit_poses(lambda content: content["frames"][1].update(file="./rgb/0000.png"))
        with pytest.raises(SourceError, match=r"frame rgb/0000\.png, field file: the frame is listed twice"):
            read(posed_folder)

    def test_suffixes_in_upper_case_are_found(self, posed_folder, caplog) -> None:
        self.write_masks(posed_folder)
        expected = read(posed_folder)
        for kind in ("depth", "mask"):
            for file in sorted((posed_folder / kind).iterdir()):
                file.rename(file.with_suffix(file.suffix.upper()))
        found = read(posed_folder)
        np.testing.assert_array_equal(found.mask, expected.mask)
        np.testing.assert_array_equal(found.depth_mm, expected.depth_mm)
        assert "no mask" not in caplog.text

    @pytest.mark.parametrize("part", ["rgb", "depth", "mask"])
    def test_what_links_lead_to_counts_in_the_fingerprint(
        self, posed_folder, edit_poses, tmp_path, part
    ) -> None:
        self.write_masks(posed_folder)
        for kind in ("rgb", "depth", "mask"):
            (posed_folder / kind).rename(posed_folder / "left")
            (posed_folder / kind).mkdir()
            (posed_folder / "left").rename(posed_folder / kind / "left")
        (posed_folder / part / "left").rename(tmp_path / "elsewhere")
        (posed_folder / part / "left").symlink_to(tmp_path / "elsewhere")

        def moved(content) -> None:
            for entry in content["frames"]:
                entry["file"] = entry["file"].replace("rgb/", "rgb/left/")

        edit_poses(moved)
        assert not read(posed_folder).mask.all()
        before = source_fingerprint(posed_folder)
        first, second, *_ = sorted((tmp_path / "elsewhere").iterdir())
        first.write_bytes(second.read_bytes())
        assert source_fingerprint(posed_folder) != before

    def test_what_is_not_read_does_not_count(self, posed_folder) -> None:
        before = source_fingerprint(posed_folder)
        (posed_folder / "depth" / "notes.txt").write_text("measured on Monday")
        (posed_folder / "rgb" / "thumbnails").mkdir()
        shutil.copyfile(posed_folder / "rgb" / "0000.png", posed_folder / "rgb" / "thumbnails" / "0000.png")
        assert source_fingerprint(posed_folder) == before

    @staticmethod
    def write_masks(folder) -> None:
        """One of each frame, each another."""
        (folder / "mask").mkdir(exist_ok=True)
        for k, file in enumerate(sorted((folder / "rgb").iterdir())):
            white = np.full((40, 48), 255, np.uint8)
            white[: k + 2] = 0
            Image.fromarray(white).save(folder / "mask" / file.name)

    def test_without_depth(self, posed_folder) -> None:
        shutil.rmtree(posed_folder / "depth")
        sequence = read(posed_folder)
        assert sequence.depth_mm is None
        assert sequence.observed is None
