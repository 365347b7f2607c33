"""Depth, masks and poses beside plain frames: not taken for frames, not read, and named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read, resolve
from data_catalog.findings import Finding
from data_catalog.inspection import inspect
from data_catalog.readers.beside_frames import frames_among
from data_catalog.readers.transforms_json import write_transforms
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from tests.data_catalog.footage_fixture import write_video
from tests.data_catalog.layouts import write_endonerf
from tests.data_catalog.test_content import moving_scene
from tests.data_catalog.test_which_frames import write_frames


def not_read(folder: Path) -> list[Finding]:
    return [finding for finding in inspect(folder).findings if finding.topic == "not read"]


def names_of_frames(*names: str) -> list[str]:
    return [file.name for file in frames_among([Path(name) for name in names])[0]]


class TestPicturesOfAnotherKind:
    @pytest.mark.parametrize(
        ("color", "other"),
        [
            ("{:04d}_color.png", "{:04d}_depth.png"),
            ("{:04d}.png", "{:04d}_mask.png"),
            ("frame_{:d}_endo.png", "frame_{:d}_endo_watershed_mask.png"),
            ("FrameBuffer_{:04d}.png", "Depth_{:04d}.png"),
            ("colon_{:04d}.png", "depthMap-{:04d}.tiff"),
            ("left{:04d}.png", "disp{:04d}.png"),
            ("{:d}_color.png", "{:04d}_normals.tiff"),
            ("frame-{:06d}.color.jpg", "frame-{:06d}.SEG.png"),
        ],
    )
    def test_those_of_the_same_numbers(self, color, other) -> None:
        frames = [color.format(k) for k in range(6)]
        assert names_of_frames(*frames, *(other.format(k) for k in range(6))) == frames
        # Of a frame that is missing, the mask is none either.
        assert names_of_frames(*frames[:4], *(other.format(k) for k in range(6))) == frames[:4]

    @pytest.mark.parametrize(
        ("first", "second"),
        [
            ("depth_test_{:04d}.png", "depth_test_b{:04d}.png"),
            ("mask_{:04d}.png", "mask_{:04d}_v2.png"),
            ("polyp_{:04d}.png", "normal_{:04d}.png"),
            ("patient1_{:04d}.png", "patient2_{:04d}.png"),
            ("unmasked_{:04d}.png", "{:04d}.png"),
        ],
    )
    def test_recordings_that_are_called_so_stay(self, first, second) -> None:
        names = [name.format(k) for name in (first, second) for k in range(4)]
        assert names_of_frames(*names) == names

    def test_a_recording_stays_for_one_picture_beside_it(self) -> None:
        names = [*(f"seg_{k:04d}.png" for k in range(10)), "0004.png"]
        assert names_of_frames(*names) == names

    def test_they_are_left_out_and_named(self, tmp_path, caplog) -> None:
        for number, image in enumerate(moving_scene(8, 48, 42)):
            Image.fromarray(image).save(tmp_path / f"{number:04d}_color.png")
            Image.fromarray(image[..., 0]).save(tmp_path / f"{number:04d}_depth.png")
        assert read(tmp_path).frame_names == tuple(f"{k:04d}_color" for k in range(8))
        assert "8 pictures are left out, by their names depth, masks" in caplog.text
        assert "0000_depth.png, 0001_depth.png, 0002_depth.png and 5 more" in caplog.text
        (finding,) = not_read(tmp_path)
        assert "give a poses.json with rgb/, depth/ and mask/" in finding.sentence

    @pytest.mark.parametrize(("name", "told"), [("overview.png", True), ("frame_10.png", False)])
    def test_a_name_without_a_number_among_numbered_ones_is_told(self, tmp_path, name, told) -> None:
        write_frames(tmp_path, 10)
        Image.fromarray(moving_scene(1, 48, 42)[0]).save(tmp_path / name)
        assert len(read(tmp_path).frame_names) == 11, "read nevertheless"
        found = [finding.sentence for finding in inspect(tmp_path).findings if finding.topic == "frames"]
        assert len(found) == told
        assert all(f"beside 10 frames with a number in their names there is also {name}" in x for x in found)

    def test_frames_without_numbers_are_not_told(self, tmp_path) -> None:
        for name, image in zip("abcdefgh", moving_scene(8, 48, 42), strict=True):
            Image.fromarray(image).save(tmp_path / f"{name}.png")
        assert not [finding for finding in inspect(tmp_path).findings if finding.topic == "frames"]

    def test_they_do_not_count_as_images(self, tmp_path) -> None:
        """As many images in rgb/ as frames and masks together in images/ were refused."""
        write_frames(tmp_path / "images", 10)
        write_frames(tmp_path / "rgb", 4)
        for number, image in enumerate(moving_scene(4, 48, 42)):
            Image.fromarray(image).save(tmp_path / "rgb" / f"{number:04d}_mask.png")
        assert len(read(tmp_path)) == 10


class TestTwoFormats:
    def test_a_frame_in_two_formats_is_refused(self, tmp_path) -> None:
        """Held out as a JPEG, it was trained on as its PNG."""
        write_frames(tmp_path, 8)
        for file in list(tmp_path.glob("*.png")):
            Image.open(file).save(file.with_suffix(".jpg"))
        with pytest.raises(
            SourceError, match=r"0000\.png, frame 0000, field rgb: .* as 0000\.jpg by its name"
        ):
            read(tmp_path)

    def test_frames_of_several_formats_are_read(self, tmp_path) -> None:
        write_frames(tmp_path, 8)
        for file in sorted(tmp_path.glob("*.png"))[4:]:
            Image.open(file).save(file.with_suffix(".jpg"))
            file.unlink()
        assert len(read(tmp_path)) == 8


class TestPosesAndDepth:
    @pytest.mark.parametrize(
        ("place", "names"),
        [
            ("rgb", ["depth/", "groundtruth.txt"]),
            ("images", ["depth/"]),
            ("", ["frame_0001.pose.txt"]),
            ("images", ["poses/"]),
            ("rgb", ["camera_poses.npy", "trajectory.csv"]),
            ("rgb", ["CameraTrajectory.txt", "KeyFrameTrajectory.txt"]),
            ("images", ["sparse/"]),
        ],
    )
    def test_what_is_not_read_is_named(self, tmp_path, place, names) -> None:
        write_frames(tmp_path / place, 6)
        for name in names:
            if name.endswith("/"):
                (tmp_path / name).mkdir()
            else:
                (tmp_path / name).write_text("0 0 0 0 0 0 0 1\n")
        assert read(tmp_path).world_from_camera is None
        (finding,) = not_read(tmp_path)
        assert f"read without poses and depth; not read are {', '.join(names)}. To have" in finding.sentence
        assert "a poses_bounds.npy with images/, depth/ and masks/ (docs/sources.md)" in finding.sentence

    @pytest.mark.parametrize("name", ["notes.txt", "purpose.txt", "pose_estimation.md", "exposure.csv"])
    def test_other_files_are_passed_over(self, tmp_path, name) -> None:
        write_frames(tmp_path, 6)
        (tmp_path / name).write_text("1")
        assert not_read(tmp_path) == []

    @pytest.mark.parametrize("absent", ["motion.yaml", "structure.ply"])
    def test_a_sinus_set_that_is_not_whole(self, tmp_path, absent) -> None:
        write_frames(tmp_path / "images", 6)
        for name in ("motion.yaml", "structure.ply", "visible_view_indexes"):
            (tmp_path / name).write_text("1")
        (tmp_path / absent).unlink()
        (finding,) = not_read(tmp_path)
        assert finding.sentence.endswith(f"what there is of the sinus set lacks {absent}")

    @pytest.mark.parametrize("absent", ["SavedPosition", "SavedRotationQuaternion"])
    def test_simcol3d_without_poses_is_refused(self, tmp_path, absent) -> None:
        """Its depth maps were read as frames."""
        for number, image in enumerate(moving_scene(6, 48, 48)):
            Image.fromarray(image).save(tmp_path / f"FrameBuffer_{number:04d}.png")
            Image.fromarray(image[..., 0].astype(np.uint16) * 100).save(tmp_path / f"Depth_{number:04d}.png")
        for name in {"SavedPosition", "SavedRotationQuaternion"} - {absent}:
            (tmp_path / f"{name}_S1.txt").write_text("0 0 0 1\n" * 6)
        assert resolve(tmp_path).format == "simcol3d"
        with pytest.raises(SourceNotFoundError, match=rf"{absent}_\*\.txt.*expected the poses of all"):
            read(tmp_path)

    @pytest.mark.parametrize(
        ("names", "problem"),
        [
            (["SavedPosition_S1", "SavedPosition_S2", "SavedRotationQuaternion_S1"], "nothing tells which"),
            (["SavedPosition_S1", "SavedRotationQuaternion_S2"], "by its name of another sequence"),
        ],
    )
    def test_simcol3d_with_poses_of_another_sequence_is_refused(self, tmp_path, names, problem) -> None:
        """The first in alphabetical order were taken."""
        for number, image in enumerate(moving_scene(3, 48, 48)):
            Image.fromarray(image).save(tmp_path / f"FrameBuffer_{number:04d}.png")
        for name in names:
            count = 3 if "Position" in name else 4
            (tmp_path / f"{name}.txt").write_text((" ".join(["1"] * count) + "\n") * 3)
        with pytest.raises(PoseError, match=problem):
            read(tmp_path)

    def test_beside_a_video_as_well(self, tmp_path, caplog) -> None:
        write_video(tmp_path / "exam.avi", moving_scene(30, 64, 48, speed=2))
        (tmp_path / "poses.csv").write_text("1")
        read(tmp_path)
        assert "not read are poses.csv" in caplog.text
        caplog.clear()
        read(tmp_path / "exam.avi")
        assert "poses.csv" not in caplog.text


class TestOtherLayouts:
    """Depth and masks that a layout does not look for were dropped without a word."""

    @pytest.mark.parametrize(
        ("name", "instead"),
        [("depths", "depth is looked for in depth/"), ("masks", "masks are looked for in")],
    )
    def test_poses_json(self, posed_folder, name, instead) -> None:
        (posed_folder / "depth").rename(posed_folder / name)
        (finding,) = not_read(posed_folder)
        assert f"{name} is not read; {instead}" in finding.sentence

    def test_transforms_json(self, clip, tmp_path, caplog) -> None:
        write_transforms(clip, tmp_path)
        assert not_read(tmp_path) == []
        assert "are not listed" not in caplog.text
        (tmp_path / "masks").mkdir()
        content = json.loads((tmp_path / "transforms.json").read_text())
        for entry in content["frames"]:
            entry.pop("depth_file_path")
        left_out = content["frames"].pop()["file_path"]
        content |= {f"{part}_filenames": [] for part in ("train", "test", "val")}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        found = [finding.sentence.partition("is not read; ")[2] for finding in not_read(tmp_path)]
        assert found == [f"no frame names a file in it ({key})" for key in ("depth_file_path", "mask_path")]
        told = f"1 of {len(clip)} images beside those of its frames are not listed, and left out: "
        assert told + Path(left_out).name in caplog.text

    @pytest.mark.parametrize(
        ("key", "problem"),
        [("file_path", "the image is listed twice, as"), ("depth_file_path", "the depth of .* as well")],
    )
    def test_one_file_of_two_frames_in_transforms_json(self, clip, tmp_path, key, problem) -> None:
        write_transforms(clip, tmp_path)
        content = json.loads((tmp_path / "transforms.json").read_text())
        content["frames"][3][key] = "./" + content["frames"][2][key]
        content |= {f"{part}_filenames": [] for part in ("train", "test", "val")}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        with pytest.raises(SourceError, match=f"field {key}: {problem}"):
            read(tmp_path)

    def test_endonerf(self, clip, tmp_path, caplog) -> None:
        write_endonerf(clip, tmp_path, clip.mask)
        (tmp_path / "gt_masks").mkdir()
        read(tmp_path)
        assert "gt_masks/ is not read, only masks/" in caplog.text
