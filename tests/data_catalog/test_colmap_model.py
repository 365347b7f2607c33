"""COLMAP in and out: exact round trips, models that open in pycolmap, lenses undone."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.readers.colmap_files import ColmapImage, ColmapModel, read_model, write_model
from data_catalog.readers.colmap_model import model_folder, points_of, read_depth_map, write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.lens import Lens, Undistortion
from extrags.sequence import Split
from tests.data_catalog.layouts import AS_STORED, carried_error_mm, same_frames

# Rounding of a rotation to a quaternion and back, of an inverse and back; lengths up to some 100 mm.
ROUNDING = 1e-12


@pytest.fixture
def varied(clip):
    """Masks, two intrinsics, points and a split of its own: everything a workspace can hold."""
    K = clip.K.copy()
    K[5:] *= np.array([[1.1], [1.1], [1]])
    mask = clip.mask.copy()
    mask[:, :4] = False
    rng = np.random.default_rng(1)
    return replace(
        clip,
        K=K,
        mask=mask,
        split=Split("manifest", np.array([0, 1, 2, 4, 5, 6, 7, 9]), np.array([3, 8])),
        points=rng.normal(0, 20, (50, 3)),
        points_rgb=rng.integers(0, 256, (50, 3)).astype(np.uint8),
    )


@pytest.mark.parametrize("binary", [True, False])
class TestRoundTrip:
    def test_sequence_to_colmap_to_sequence(self, varied, tmp_path, binary) -> None:
        write_colmap(varied, tmp_path / "scene", binary=binary)
        back = read(tmp_path / "scene", AS_STORED)
        same_frames(back, varied, atol=ROUNDING)
        np.testing.assert_array_equal(back.depth_mm, varied.depth_mm)
        np.testing.assert_array_equal(back.points, varied.points)
        np.testing.assert_array_equal(back.points_rgb, varied.points_rgb)
        assert back.observed is not None

    @pytest.mark.parametrize("name", ["a\nb", "a\rb"])
    def test_a_name_of_two_lines_is_refused(self, clip, tmp_path, binary, name) -> None:
        names = tuple(f"{name}{number}" for number in range(len(clip)))
        with pytest.raises(SourceError, match=r"frame 0, field name: 'a\\[nr]b0' has a line break"):
            write_colmap(replace(clip, frame_names=names), tmp_path / "scene", binary=binary)
        assert not (tmp_path / "scene").exists()

    def test_decimals_have_their_place(self, clip, tmp_path, binary) -> None:
        names = tuple(f"t{number * 0.05:g}s" for number in range(len(clip)))
        write_colmap(replace(clip, frame_names=names), tmp_path / "scene", binary=binary)
        back = read(tmp_path / "scene")
        assert back.frame_names == names
        np.testing.assert_array_equal(back.rgb, clip.rgb)

    def test_colmap_to_sequence_to_colmap(self, varied, tmp_path, binary) -> None:
        write_colmap(varied, tmp_path / "first", binary=binary)
        write_colmap(read(tmp_path / "first"), tmp_path / "second", binary=not binary)
        first, second = (read_model(tmp_path / name / "sparse" / "0") for name in ("first", "second"))
        assert first.lenses == second.lenses
        np.testing.assert_array_equal(first.points, second.points)
        for one, other in zip(first.images, second.images, strict=True):
            assert (one.name, one.camera) == (other.name, other.camera)
            np.testing.assert_allclose(one.world_from_camera, other.world_from_camera, rtol=0, atol=ROUNDING)

    def test_depth_carried_from_frame_to_frame(self, clip, tmp_path, binary) -> None:
        write_colmap(clip, tmp_path / "scene", binary=binary)
        back = read(tmp_path / "scene")
        assert carried_error_mm(back) == pytest.approx(carried_error_mm(clip), abs=1e-6)
        assert carried_error_mm(back) < 0.2

    def test_opens_in_pycolmap(self, varied, tmp_path, binary) -> None:
        """In a process of its own: pycolmap says what it read, and writes the model again."""
        write_colmap(varied, tmp_path / "scene", binary=binary)
        code = (
            "import json, sys\n"
            "import PIL.Image, cv2, pycolmap\n"
            "model = pycolmap.Reconstruction(sys.argv[1])\n"
            "found = {i.name: i.cam_from_world().inverse().matrix() for i in model.images.values()}\n"
            "model.write(sys.argv[2])\n"
            "counts = {'points': len(model.points3D), 'cameras': len(model.cameras)}\n"
            "print(json.dumps({'images': {k: v.tolist() for k, v in found.items()}, **counts}))\n"
        )
        again = tmp_path / "again" / "sparse" / "0"
        again.mkdir(parents=True)
        arguments = [sys.executable, "-c", code, str(tmp_path / "scene" / "sparse" / "0"), str(again)]
        said = json.loads(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)
        assert (said["points"], said["cameras"]) == (50, 2)
        for index, name in enumerate(varied.frame_names):
            np.testing.assert_allclose(
                said["images"][f"{name}.png"], varied.world_from_camera[index, :3], atol=ROUNDING
            )
        # What pycolmap writes (with rigs and frames beside it) is read here.
        (tmp_path / "again" / "images").symlink_to(tmp_path / "scene" / "images")
        found = read(tmp_path / "again")
        np.testing.assert_allclose(found.cameras.world_from_camera, varied.world_from_camera, atol=ROUNDING)
        assert found.metric is False


class TestReading:
    def test_a_distorted_camera_is_undone(self, clip, tmp_path) -> None:
        """Frames seen through a lens: after reading, depth and colour are where a pinhole has them."""
        lens = Lens("OPENCV", (60.0, 61.0, 47.0, 39.5, -0.15, 0.02, 0.001, -0.001), 96, 77)
        plain = Undistortion.planned(Lens("PINHOLE", (1.0, 1.0, 0.0, 0.0), 96, 77))
        assert plain.valid.any()
        # Distort: for each pixel of the lens, the pinhole pixel its ray comes from (fixed point iteration).
        u, v = np.meshgrid(np.arange(96) + 0.5, np.arange(77) + 0.5)
        target = np.stack([(u - 47.0) / 60.0, (v - 39.5) / 61.0])
        ray = target.copy()
        for _ in range(50):
            ray += target - np.stack(lens.distorted(*ray))
        K = clip.K[0]
        map_u = (K[0, 0] * ray[0] + K[0, 2] - 0.5).astype(np.float32)
        map_v = (K[1, 1] * ray[1] + K[1, 2] - 0.5).astype(np.float32)
        seen = (map_u >= 0) & (map_u <= 95) & (map_v >= 0) & (map_v <= 76)
        rgb = np.stack([cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR) for image in clip.rgb])
        distorted = replace(clip, rgb=rgb, depth_mm=None, mask=np.broadcast_to(seen, clip.mask.shape).copy())
        write_colmap(distorted, tmp_path / "scene")
        model = read_model(tmp_path / "scene" / "sparse" / "0")
        write_model(replace(model, lenses={1: lens}), tmp_path / "scene" / "sparse" / "0")
        back = read(tmp_path / "scene")
        assert back.K[0, 0, 0] == pytest.approx(np.sqrt(60 * 61))
        assert (back.K[0, 0, 2], back.K[0, 1, 2]) == (48, 38.5)
        # The same view by resampling the pinhole image once.
        x, y = (u - 48) / back.K[0, 0, 0], (v - 38.5) / back.K[0, 0, 0]
        expected = cv2.remap(
            clip.rgb[0],
            (K[0, 0] * x + K[0, 2] - 0.5).astype(np.float32),
            (K[1, 1] * y + K[1, 2] - 0.5).astype(np.float32),
            cv2.INTER_LINEAR,
        )
        inside = back.mask[0]
        assert inside.mean() > 0.6
        difference = np.abs(back.rgb[0].astype(float) - expected)[inside]
        assert difference.mean() < 2.5
        shifted = np.abs(np.roll(back.rgb[0], 1, axis=1).astype(float) - expected)[inside]
        assert difference.mean() < 0.5 * shifted.mean()

    def test_the_largest_model_is_read(self, clip, tmp_path) -> None:
        write_colmap(clip, tmp_path / "scene")
        model = read_model(tmp_path / "scene" / "sparse" / "0")
        write_model(model, tmp_path / "scene" / "sparse" / "1")
        write_model(replace(model, images=model.images[:2]), tmp_path / "scene" / "sparse" / "0")
        found = model_folder(tmp_path / "scene")
        assert found is not None
        assert found.name == "1"
        assert len(read(tmp_path / "scene")) == 10

    def test_a_dense_workspace_has_its_own_images(self, varied, tmp_path) -> None:
        """Those beside it are of the cameras before they were undistorted."""
        write_colmap(varied, tmp_path / "scene" / "dense")
        beside = tmp_path / "scene" / "images"
        for file in (tmp_path / "scene" / "dense" / "images").iterdir():
            image = cv2.imread(str(file))
            beside.mkdir(exist_ok=True)
            cv2.imwrite(str(beside / file.name), 255 - image)
        back = read(tmp_path / "scene", AS_STORED)
        same_frames(back, varied, atol=ROUNDING)
        np.testing.assert_array_equal(back.mask, varied.mask)
        np.testing.assert_array_equal(back.depth_mm, varied.depth_mm)

    def test_images_without_pose_are_left_out_and_said(self, clip, tmp_path, caplog) -> None:
        write_colmap(clip, tmp_path / "scene")
        folder = tmp_path / "scene" / "sparse" / "0"
        model = read_model(folder)
        write_model(replace(model, images=model.images[:7]), folder)
        for name in ("train", "test"):
            (tmp_path / "scene" / f"{name}_list.txt").unlink()
        assert len(read(tmp_path / "scene", IngestConfig(holdout_every=3))) == 7
        assert "3 of 10 images have no pose in the COLMAP model" in caplog.text
        assert "0007.png" in caplog.text

    @pytest.mark.parametrize("place", ["sparse", "sparse/0"])
    def test_the_model_alone_is_told_where_its_images_are(self, clip, tmp_path, place) -> None:
        """It is recognised as a workspace without images, whose frames are all absent."""
        workspace = tmp_path / "scene"
        write_colmap(clip, workspace)
        with pytest.raises(SourceError, match=f"the model alone, .*; give the folder {workspace}, which"):
            read(workspace / place)
        shutil.rmtree(workspace / "images")
        with pytest.raises(SourceError, match=r"of them are absent"):
            read(workspace / place)

    def test_what_is_burnt_in_beside_the_picture_is_not_handed_on(self, clip, tmp_path) -> None:
        """As a patient's name in the dark surround, which the mask leaves out."""
        mask = clip.mask.copy()
        mask[:, :20, :40] = False
        rgb = clip.rgb.copy()
        rgb[:, 4:12, 4:36] = 255
        written = replace(clip, rgb=rgb, mask=mask)
        write_colmap(written, tmp_path / "colmap")
        write_transforms(written, tmp_path / "transforms")
        for folder in ("colmap", "transforms"):
            images = sorted((tmp_path / folder / "images").glob("*.png"))
            assert len(images) == len(clip)
            for index, file in enumerate(images):
                found = np.asarray(Image.open(file))
                assert not found[~mask[index]].any()
                np.testing.assert_array_equal(found[mask[index]], rgb[index][mask[index]])
                seen = np.asarray(Image.open(tmp_path / folder / "masks" / f"{file.name}.png"))
                np.testing.assert_array_equal(seen > 0, mask[index])

    def test_images_of_another_suffix_are_told(self, clip, tmp_path, caplog) -> None:
        """As of frames that were converted after the model was made; a mask may be called so as well."""
        write_colmap(clip, tmp_path / "scene", binary=False)
        files = sorted((tmp_path / "scene" / "images").glob("*.png"))
        for number, file in enumerate(files):
            if number in (2, 3):
                file.unlink()
            if number > 2:
                Image.new("RGB", (8, 8)).save(file.with_suffix(".JPG"))
        assert len(read(tmp_path / "scene")) == len(files) - 2
        told = f"1 of the absent ones are there with another suffix, {files[3].stem}.JPG for {files[3].name}"
        assert told in caplog.text
        for file in files:
            file.unlink(missing_ok=True)
        told = (
            rf"10 of them are absent.*; 7 of the absent .* {files[3].stem}.JPG for {files[3].name} first: if"
        )
        with pytest.raises(SourceError, match=told):
            read(tmp_path / "scene")

    def test_recordings_are_folders(self, clip, tmp_path) -> None:
        two = replace(clip, recording=np.repeat([0, 1], 5))
        write_colmap(two, tmp_path / "scene")
        assert (tmp_path / "scene" / "images" / "recording_1" / "0007.png").is_file()
        back = read(tmp_path / "scene")
        assert back.recording.tolist() == [0] * 5 + [1] * 5
        assert back.frame_names == clip.frame_names

    def test_observations_are_kept(self, tmp_path) -> None:
        """Tracks of the files agree with the observations of the images, both ways."""
        rng = np.random.default_rng(0)
        images = [
            ColmapImage(f"{k}.png", 1, np.eye(4), rng.uniform(0, 50, (6, 2)), np.array([k, -1, 2, 3, -1, 4]))
            for k in range(2)
        ]
        lens = Lens("SIMPLE_PINHOLE", (50.0, 30.0, 20.0), 60, 40)
        model = ColmapModel({1: lens}, images, rng.normal(size=(5, 3)), np.zeros((5, 3), np.uint8))
        for binary in (True, False):
            write_model(model, tmp_path / str(binary), binary=binary)
            back = read_model(tmp_path / str(binary))
            for one, other in zip(model.images, back.images, strict=True):
                np.testing.assert_array_equal(one.observed_px, other.observed_px)
                np.testing.assert_array_equal(one.observed_point, other.observed_point)

    def test_fingerprint_is_the_content(self, clip, tmp_path) -> None:
        for name in ("one", "two"):
            write_colmap(clip, tmp_path / name)
        first, second = source_fingerprint(tmp_path / "one"), source_fingerprint(tmp_path / "two")
        assert first == second
        assert resolve(tmp_path / "one").format == "colmap"
        (tmp_path / "two" / "length_unit.txt").write_text("arbitrary")
        assert source_fingerprint(tmp_path / "two") != first
        assert read(tmp_path / "two").metric is False


@pytest.fixture
def workspace(varied, tmp_path) -> Path:
    """Two recordings in folders of their own, with masks and depth, and a picture beside them."""
    place = tmp_path / "workspace"
    write_colmap(replace(varied, recording=np.repeat([0, 1], 5)), place)
    return place


def rename_images(workspace: Path, change: Callable[[str], str]) -> None:
    """Other names in the model, and without lists of what trains."""
    place = workspace / "sparse" / "0"
    model = read_model(place)
    write_model(replace(model, images=[replace(one, name=change(one.name)) for one in model.images]), place)
    for name in ("train", "test"):
        (workspace / f"{name}_list.txt").unlink(missing_ok=True)


PARTS = {
    "images": "images/recording_1/0007.png",
    "masks": "masks/recording_1/0007.png.png",
    "depth": "stereo/depth_maps/recording_1/0007.png.geometric.bin",
}


class TestFingerprint:
    @pytest.mark.parametrize("linked", [False, True])
    @pytest.mark.parametrize("part", PARTS)
    def test_every_file_that_is_read_counts(self, workspace, tmp_path, part, linked) -> None:
        file = workspace / PARTS[part]
        if linked:
            file.parent.rename(tmp_path / "elsewhere")
            file.parent.symlink_to(tmp_path / "elsewhere")
        before = source_fingerprint(workspace)
        assert PARTS[part] in [name for name, *_ in before["files"]]
        other = file.with_name(file.name.replace("0007", "0008"))
        file.write_bytes(other.read_bytes()[:-1] + b"7")
        assert source_fingerprint(workspace) != before

    def test_images_below_the_folder_itself_count(self, workspace) -> None:
        for folder in ("recording_0", "recording_1"):
            (workspace / "images" / folder).rename(workspace / folder)
        (workspace / "images").rmdir()
        assert len(read(workspace, AS_STORED)) == 10
        before = source_fingerprint(workspace)
        file = workspace / "recording_1" / "0007.png"
        file.write_bytes((workspace / "recording_1" / "0008.png").read_bytes())
        assert source_fingerprint(workspace) != before

    def test_what_is_not_read_does_not_count(self, workspace) -> None:
        before = source_fingerprint(workspace)
        shutil.copyfile(workspace / PARTS["images"], workspace / "images" / "without_pose.png")
        shutil.copyfile(workspace / PARTS["images"], workspace / "contact_sheet.png")
        (workspace / "masks" / "notes.txt").write_text("painted by hand")
        assert source_fingerprint(workspace) == before


class TestMasks:
    @pytest.mark.parametrize("renamed", ["0000.png.PNG", "0000.png", "0000.PNG", "0000.bmp", "0000.Tif"])
    def test_names_that_are_found(self, varied, tmp_path, renamed) -> None:
        write_colmap(varied, tmp_path)
        expected = read(tmp_path, AS_STORED).mask
        assert not expected.all()
        for file in sorted((tmp_path / "masks").iterdir()):
            picture = Image.open(file)
            picture.load()
            file.unlink()
            kind = "png" if renamed.lower().endswith("png") else Path(renamed).suffix[1:]
            picture.save(
                file.with_name(renamed.replace("0000", file.name[:4])), format=kind.replace("Tif", "tiff")
            )
        np.testing.assert_array_equal(read(tmp_path, AS_STORED).mask, expected)

    def test_frames_without_one_are_named(self, workspace, caplog) -> None:
        (workspace / "masks" / "recording_1" / "0007.png.png").unlink()
        assert read(workspace, AS_STORED).mask[7].all()
        assert caplog.text.count("have no mask") == 1
        assert "1 of 10 frames have no mask and are tissue throughout: recording_1/0007.png" in caplog.text

    def test_another_folder_of_masks_is_told_of(self, workspace, caplog) -> None:
        (workspace / "masks").rename(workspace / "mask")
        assert read(workspace, AS_STORED).mask.all()
        assert "mask is not read; masks are looked for in masks/" in caplog.text


class TestTextFiles:
    @pytest.mark.parametrize(("mark", "blank"), [("\ufeff", ""), ("", " "), ("\ufeff", "\t\r")])
    def test_marks_and_blanks_of_editors(self, clip, tmp_path, mark, blank) -> None:
        write_colmap(clip, tmp_path / "scene")
        expected = read(tmp_path / "scene")
        assert expected.metric
        for name in ("train_list.txt", "test_list.txt", "length_unit.txt"):
            file = tmp_path / "scene" / name
            file.write_text(mark + file.read_text().replace("\n", f"{blank}\n"), encoding="utf-8")
        found = read(tmp_path / "scene")
        assert found.metric
        np.testing.assert_array_equal(found.train, expected.train)
        np.testing.assert_array_equal(found.test, expected.test)

    def test_a_mark_in_the_model_itself(self, clip, tmp_path) -> None:
        write_colmap(clip, tmp_path / "scene", binary=False)
        expected = read(tmp_path / "scene")
        for file in (tmp_path / "scene" / "sparse" / "0").glob("*.txt"):
            file.write_text("\ufeff" + file.read_text(), encoding="utf-8")
        found = read(tmp_path / "scene")
        np.testing.assert_array_equal(found.world_from_camera, expected.world_from_camera)
        np.testing.assert_array_equal(found.K, expected.K)
        np.testing.assert_array_equal(found.points, expected.points)

    def test_a_blank_may_belong_to_a_name(self, clip, tmp_path) -> None:
        write_colmap(clip, tmp_path / "scene")
        rename_images(tmp_path / "scene", lambda name: f"{name} ")
        images = tmp_path / "scene" / "images"
        for file in list(images.iterdir()):
            file.rename(file.with_name(f"{file.name} "))
        (tmp_path / "scene" / "test_list.txt").write_text("0003.png \n")
        assert read(tmp_path / "scene").test.tolist() == [3]


class TestNames:
    @pytest.mark.parametrize("place", ["images", "rgb"])
    def test_absolute_names_are_those_below_the_folder(self, workspace, place) -> None:
        """Joined to masks/, an absolute name would be the image's own: it would be its mask."""
        for file in sorted((workspace / "masks").rglob("*.png.png")):
            file.rename(file.with_name(file.name.removesuffix(".png")))
        rename_images(workspace, str)
        expected = read(workspace, AS_STORED)
        if place != "images":
            (workspace / "images").rename(workspace / place)
            (workspace / "images").mkdir()
        rename_images(workspace, lambda name: f"{workspace.resolve()}/{place}/{name}")
        found = read(workspace, AS_STORED)
        same_frames(found, expected, atol=ROUNDING)
        np.testing.assert_array_equal(found.depth_mm, expected.depth_mm)
        np.testing.assert_array_equal(found.recording, expected.recording)

    def test_two_spellings_of_one_image_are_refused(self, workspace) -> None:
        rename_images(workspace, lambda name: name.replace("0007", "./0008"))
        with pytest.raises(SourceError, match=r"images\.bin, frame .*0008\.png, field name: .*listed twice"):
            read(workspace, AS_STORED)


class TestPoints:
    def test_depth_gives_points_where_there_are_none(self, clip) -> None:
        points, colors = points_of(clip, at_most=500)
        assert 200 < len(points) <= 700
        assert colors.shape == points.shape
        viewmat = clip.cameras.viewmats[1]
        assert ((points @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2] > 0).mean() > 0.5

    def test_neither_points_nor_depth(self, clip) -> None:
        assert points_of(replace(clip, depth_mm=None)) is None

    def test_depth_map_file(self, tmp_path) -> None:
        file = tmp_path / "a.geometric.bin"
        file.write_bytes(b"3&2&1&" + np.arange(6, dtype="<f4").tobytes())
        np.testing.assert_array_equal(read_depth_map(file), np.arange(6, dtype=np.float32).reshape(2, 3))


class TestModelsOfOtherPrograms:
    def test_separators_of_windows(self, workspace) -> None:
        expected = read(workspace, AS_STORED)
        rename_images(workspace, lambda name: name.replace("/", "\\"))
        found = read(workspace, AS_STORED)
        assert found.frame_names == expected.frame_names
        np.testing.assert_array_equal(found.mask, expected.mask)
        np.testing.assert_array_equal(found.depth_mm, expected.depth_mm)
        np.testing.assert_array_equal(found.recording, expected.recording)

    @pytest.mark.parametrize("of_model", ["/", "\\"])
    @pytest.mark.parametrize("of_lists", ["/", "\\"])
    def test_lists_with_separators_of_windows(self, workspace, of_model, of_lists) -> None:
        names = sorted(image.name for image in read_model(workspace / "sparse" / "0").images)
        rename_images(workspace, lambda name: name.replace("/", of_model))
        for which, listed in (("train", names[:3]), ("test", names[3:5])):
            lines = [name.replace("/", of_lists) for name in listed]
            (workspace / f"{which}_list.txt").write_text("\r\n".join(lines))
        found = read(workspace, AS_STORED)
        assert len(found) == 5
        assert found.test.tolist() == [3, 4]

    @pytest.mark.parametrize("binary", [True, False])
    def test_points_that_are_not_finite(self, clip, tmp_path, caplog, binary) -> None:
        points = np.arange(60.0).reshape(20, 3)
        points[3, 1], points[7, 0] = np.nan, np.inf
        colors = np.repeat(np.arange(20, dtype=np.uint8)[:, None], 3, axis=1)
        write_colmap(clip, tmp_path, binary=binary, points=points, points_rgb=colors)
        found = read(tmp_path, AS_STORED)
        kept = [index for index in range(20) if index not in (3, 7)]
        assert found.points_rgb[:, 0].tolist() == kept
        np.testing.assert_array_equal(found.points, points[kept])
        name = "points3D.bin" if binary else "points3D.txt"
        assert f"{name}: 2 of 20 points are not finite and left out" in caplog.text
        write_colmap(clip, tmp_path, binary=binary, points=np.full((2, 3), np.nan))
        assert read(tmp_path, AS_STORED).points is None

    def test_the_size_of_a_camera_stands_in_another_file(self, workspace) -> None:
        for file in (workspace / "images").rglob("*.png"):
            Image.open(file).resize((48, 38)).save(file)
        with pytest.raises(SourceError, match=r"but cameras\.bin describes a camera of 96 x 77"):
            read(workspace, AS_STORED)
