"""Every kind of bad input is refused by an error that names file, frame and field."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read
from data_catalog.checks import check_axes, check_sequence
from data_catalog.diagnostics import diagnose
from data_catalog.inspection import inspect
from extrags.cameras import invert_poses
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.sequence import EndoscopicSequence, Split


def set_pose(change):
    """An edit of `poses.json` that changes the pose of frame 3."""

    def edit(content) -> None:
        pose = np.array(content["frames"][3]["world_from_camera"])
        content["frames"][3]["world_from_camera"] = change(pose).tolist()

    return edit


class TestFolder:
    def test_the_good_folder_is_good(self, posed_folder) -> None:
        assert len(read(posed_folder)) == 10

    def test_missing_frame(self, posed_folder) -> None:
        (posed_folder / "rgb" / "0004.png").unlink()
        with pytest.raises(SourceNotFoundError, match=r"0004\.png.*no such file") as caught:
            read(posed_folder)
        assert caught.value.frame == "rgb/0004.png"
        assert caught.value.field == "file"
        assert isinstance(caught.value, FileNotFoundError)

    def test_depth_of_a_format_that_is_not_read(self, posed_folder) -> None:
        """It was said to be missing."""
        for file in (posed_folder / "depth").iterdir():
            file.rename(file.with_suffix(".exr"))
        with pytest.raises(
            SourceError,
            match=r"0000\.exr, frame rgb/0000\.png, field depth: depth of this format is not read",
        ):
            read(posed_folder)

    def test_wrong_pose_count(self, posed_folder, edit_poses) -> None:
        edit_poses(lambda content: content["frames"].pop(6))
        with pytest.raises(PoseError, match="9 poses for 10 images") as caught:
            read(posed_folder)
        assert caught.value.frame == "rgb/0006.png"
        assert str(caught.value.file).endswith("poses.json")

    def test_mirrored_rotation(self, posed_folder, edit_poses) -> None:
        edit_poses(set_pose(lambda pose: pose @ np.diag([-1.0, 1, 1, 1])))
        with pytest.raises(PoseError, match=r"mirrored \(det = -1") as caught:
            read(posed_folder)
        assert caught.value.frame == "rgb/0003.png"
        assert caught.value.field == "world_from_camera"

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda pose: pose * np.array([[1.2], [1.2], [1.2], [1]]), "not a rotation: singular values"),
            (lambda pose: pose.T, "looks transposed"),
            (
                lambda pose: pose + np.array([[0, 0, 0, np.inf]] + 3 * [[0] * 4]),
                "1 of 16 entries are NaN or inf",
            ),
            (lambda pose: pose[:3], r"found shape \(3, 4\)"),
        ],
    )
    def test_other_broken_poses(self, posed_folder, edit_poses, change, message) -> None:
        edit_poses(set_pose(change))
        with pytest.raises(PoseError, match=message) as caught:
            read(posed_folder)
        assert caught.value.frame == "rgb/0003.png"

    def test_pose_without_matrix(self, posed_folder, edit_poses) -> None:
        edit_poses(lambda content: content["frames"][2].pop("world_from_camera"))
        with pytest.raises(PoseError, match=r"frame rgb/0002\.png.*no world_from_camera"):
            read(posed_folder)

    def test_negative_depth(self, posed_folder) -> None:
        file = posed_folder / "depth" / "0005.npy"
        depth = np.load(file)
        depth[7, 3:6] = -2.0
        np.save(file, depth)
        with pytest.raises(
            SourceError, match="3 of 1920 depth values are negative, the first at row 7, column 3"
        ) as caught:
            read(posed_folder)
        assert caught.value.frame == "rgb/0005.png"
        assert str(caught.value.file).endswith("0005.npy")

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_depth_that_is_not_finite_is_unknown(self, posed_folder, caplog, value) -> None:
        whole = read(posed_folder)
        for name in ("0005.npy", "0007.npy"):
            file = posed_folder / "depth" / name
            depth = np.load(file)
            depth[7, 3:6] = value
            np.save(file, depth)
        found = read(posed_folder).depth_mm
        expected = whole.depth_mm.copy()
        expected[[5, 7], 7, 3:6] = 0
        np.testing.assert_array_equal(found, expected)
        told = f"0005.npy: 6 depth values in 2 of {len(whole)} frames, this one first, are NaN or infinite"
        assert told in caplog.text

    @pytest.mark.parametrize("value", [1e10, float(np.finfo(np.float32).max)])
    def test_a_background_is_unknown(self, posed_folder, caplog, value) -> None:
        whole = read(posed_folder)
        file = posed_folder / "depth" / "0005.npy"
        depth = np.load(file)
        depth[7, 3:6] = value
        np.save(file, depth)
        found = read(posed_folder).depth_mm
        expected = whole.depth_mm.copy()
        expected[5, 7, 3:6] = 0
        np.testing.assert_array_equal(found, expected)
        told = f"0005.npy: 3 depth values in 1 of {len(whole)} frames, this one first, are over 1000 times"
        assert told in caplog.text

    def test_a_frame_without_any_depth(self, posed_folder) -> None:
        file = posed_folder / "depth" / "0005.npy"
        np.save(file, np.zeros_like(np.load(file)))
        depth = read(posed_folder).depth_mm
        assert not depth[5].any()
        assert all(image.any() for index, image in enumerate(depth) if index != 5)

    def test_axes_are_told_beside_a_frame_without_depth(self, posed_folder, edit_poses) -> None:
        """Pairs with such a frame tell nothing, and must not count as contradictions to all readings."""
        file = posed_folder / "depth" / "0005.npy"
        np.save(file, np.zeros_like(np.load(file)))

        def inverted(content) -> None:
            for entry in content["frames"]:
                entry["world_from_camera"] = np.linalg.inv(entry["world_from_camera"]).tolist()

        edit_poses(inverted)
        with pytest.raises(PoseError, match="world-to-camera"):
            read(posed_folder)

    def test_depth_that_is_nowhere_known(self, posed_folder) -> None:
        for file in (posed_folder / "depth").iterdir():
            np.save(file, np.zeros_like(np.load(file)))
        with pytest.raises(SourceError, match="field depth_mm: no pixel of any frame has a depth"):
            read(posed_folder)

    def test_pictures_of_12_bits_in_16(self, posed_folder) -> None:
        for file in sorted((posed_folder / "rgb").iterdir()):
            grey = np.asarray(Image.open(file).convert("L")).astype(np.uint16)
            Image.fromarray(grey * 16).save(file)
        with pytest.raises(SourceError, match=r"field rgb: .* brighter than 1\d of 255: .* of 12 bits"):
            read(posed_folder)

    @pytest.mark.parametrize(
        ("factor", "told"),
        [
            (16, r"1\d of 255: .* of 12 bits in files of 16 .* by 16, so that 4095 becomes 65520"),
            (4, r"[23] of 255: .* of 10 bits in files of 16 .* by 64, so that 1023 becomes 65472"),
        ],
    )
    def test_colours_of_fewer_bits_in_16(self, posed_folder, factor, told) -> None:
        """Pillow calls them colours of 8 bits."""
        for file in sorted((posed_folder / "rgb").iterdir()):
            assert cv2.imwrite(str(file), cv2.imread(str(file)).astype(np.uint16) * factor)
        with pytest.raises(SourceError, match=f"brighter than {told}"):
            read(posed_folder)

    def test_black_pictures_of_8_bits(self, posed_folder) -> None:
        """Nothing is said of 12 bits, which these files cannot hold."""
        for file in sorted((posed_folder / "rgb").iterdir()):
            Image.fromarray(np.array(Image.open(file).convert("RGB")) // 20).save(file)
        with pytest.raises(SourceError, match=r"brighter than 1\d of 255: all frames are black$"):
            read(posed_folder)

    def test_opengl_axes(self, posed_folder, edit_poses) -> None:
        def to_opengl(content) -> None:
            for entry in content["frames"]:
                pose = np.array(entry["world_from_camera"]) @ np.diag([1.0, -1, -1, 1])
                entry["world_from_camera"] = pose.tolist()

        edit_poses(to_opengl)
        with pytest.raises(PoseError, match=r"read as OpenGL axes \(y up, z backward") as caught:
            read(posed_folder)
        assert caught.value.field == "world_from_camera"

    def test_inverted_poses(self, posed_folder, edit_poses) -> None:
        def invert(content) -> None:
            for entry in content["frames"]:
                pose = np.array(entry["world_from_camera"])
                entry["world_from_camera"] = invert_poses(pose).tolist()

        edit_poses(invert)
        with pytest.raises(PoseError, match="world-to-camera"):
            read(posed_folder)

    def test_zero_focal_length(self, posed_folder, edit_poses) -> None:
        edit_poses(lambda content: content["K"][0].__setitem__(0, 0.0))
        with pytest.raises(SourceError, match="focal length fx = 0 px; expected a positive number") as caught:
            read(posed_folder)
        assert caught.value.field == "K"

    @pytest.mark.parametrize("share", [0.5, 0.02])
    def test_truncated_png(self, posed_folder, share) -> None:
        file = posed_folder / "rgb" / "0002.png"
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])
        with pytest.raises(
            SourceError, match=r"0002\.png, frame rgb/0002\.png, field rgb: .*(truncated|not an image)"
        ):
            read(posed_folder)

    def test_truncated_depth(self, posed_folder) -> None:
        file = posed_folder / "depth" / "0002.npy"
        file.write_bytes(file.read_bytes()[:500])
        with pytest.raises(SourceError, match=r"0002\.npy, frame rgb/0002\.png, field depth: cannot be read"):
            read(posed_folder)

    def test_depth_of_another_size(self, posed_folder) -> None:
        np.save(posed_folder / "depth" / "0002.npy", np.ones((20, 24), np.float32))
        with pytest.raises(SourceError, match="24 x 20 pixels; expected 48 x 40"):
            read(posed_folder)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("{", "not readable as JSON"),
            ("[]", "list `frames`"),
            ('{"frames": []}', "the list of frames is empty"),
            ('{"frames": [{"name": "x"}]}', "an object with `file`"),
            ('{"frames": [{"file": "x"}], "length_unit": "inch"}', "'inch' is no length unit"),
        ],
    )
    def test_broken_list_of_frames(self, posed_folder, text, message) -> None:
        (posed_folder / "poses.json").write_text(text)
        with pytest.raises(SourceError, match=message):
            read(posed_folder)

    def test_frame_listed_twice(self, posed_folder, edit_poses) -> None:
        edit_poses(lambda content: content["frames"].append(content["frames"][1]))
        with pytest.raises(SourceError, match=r"frame rgb/0001\.png.*listed twice"):
            read(posed_folder)

    def test_half_named_split(self, posed_folder, edit_poses) -> None:
        edit_poses(lambda content: content["frames"][1].update(split="train"))
        with pytest.raises(SourceError, match="expected 'train' or 'test', in all frames or in none"):
            read(posed_folder)

    def test_nothing_left_to_train(self, posed_folder) -> None:
        content = json.loads((posed_folder / "poses.json").read_text())
        for entry in content["frames"]:
            entry["split"] = "test"
        (posed_folder / "poses.json").write_text(json.dumps(content))
        with pytest.raises(SourceError, match="no training frame"):
            read(posed_folder)


class TestCoarseDepth:
    """Rounded depth makes stairs of surfaces; the range alone does not show it."""

    @staticmethod
    def said(folder) -> list[str]:
        found = inspect(folder).findings
        return [str(finding) for finding in found if finding.topic == "depth resolution"]

    @staticmethod
    def rewritten(folder, suffix: str, levels) -> None:
        for file in sorted((folder / "depth").iterdir()):
            depth = levels(np.load(file))
            file.unlink()
            if suffix == ".npy":
                np.save(file, depth)
            else:
                Image.fromarray(depth).save(file.with_suffix(suffix))

    @pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy"])
    def test_whole_units(self, posed_folder, suffix) -> None:
        self.rewritten(posed_folder, suffix, lambda depth: depth.astype(np.uint16))
        (found,) = self.said(posed_folder)
        assert f"0000{suffix}: depth in steps of 1, " in found
        assert "expected finer values" in found

    def test_a_warning_in_a_run_as_well(self, posed_folder, caplog) -> None:
        self.rewritten(posed_folder, ".png", lambda depth: depth.astype(np.uint16))
        read(posed_folder)
        assert "stairs of surfaces" in caplog.text

    def test_is_told_as_well_where_reading_fails(self, posed_folder, edit_poses) -> None:
        """It may be why the poses seem to contradict the depth."""
        self.rewritten(posed_folder, ".png", lambda depth: depth.astype(np.uint16))

        def to_opengl(content) -> None:
            for entry in content["frames"]:
                pose = np.array(entry["world_from_camera"]) @ np.diag([1.0, -1, -1, 1])
                entry["world_from_camera"] = pose.tolist()

        edit_poses(to_opengl)
        refused, told = inspect(posed_folder).findings
        assert (refused.topic, refused.kind) == ("cannot be read", "error")
        assert (told.topic, told.kind, told.file) == ("depth resolution", "warning", str(posed_folder))

    @pytest.mark.parametrize("suffix", [".npy", ".tiff"])
    def test_floats_are_fine(self, posed_folder, suffix) -> None:
        self.rewritten(posed_folder, suffix, lambda depth: depth)
        assert self.said(posed_folder) == []

    def test_fine_steps_are_fine(self, posed_folder) -> None:
        self.rewritten(posed_folder, ".npy", lambda depth: np.round(depth * 20) / 20)
        assert self.said(posed_folder) == []


class TestMasksBeforePoses:
    """Poses and units that the mask alone speaks against are not blamed."""

    @staticmethod
    def masked(folder, white) -> None:
        (folder / "mask").mkdir()
        for file in (folder / "rgb").iterdir():
            Image.fromarray(np.where(white, 255, 0).astype(np.uint8)).save(folder / "mask" / file.name)

    @staticmethod
    def along_a_wall(mask: np.ndarray) -> EndoscopicSequence:
        """Cameras that move to the right before a slanted wall: what is on their left soon leaves them."""
        count, (height, width), focal = 8, mask.shape, 60.0
        poses = np.repeat(np.eye(4)[None], count, axis=0)
        poses[:, 0, 3] = 4.0 * np.arange(count)
        slope = (np.arange(width) + 0.5 - width / 2) / focal
        depth = (20 + 0.3 * poses[:, 0, 3])[:, None] / (1 - 0.3 * slope)[None]
        rng = np.random.default_rng(0)
        return EndoscopicSequence(
            name="wall",
            rgb=rng.integers(60, 255, (count, height, width, 3), dtype=np.uint8),
            K=np.repeat([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], count, axis=0),
            mask=np.repeat(mask[None], count, axis=0),
            split=Split("first", np.arange(1, count), np.arange(1)),
            world_from_camera=poses,
            depth_mm=np.repeat(depth[:, None, :], height, axis=1).astype(np.float32),
        )

    def test_a_narrow_one_tells_nothing_of_poses(self) -> None:
        """The cameras seemed to stand still, since what the mask keeps is outside the next frame."""
        white = np.zeros((64, 80), dtype=bool)
        white[:, :10] = True
        sequence = self.along_a_wall(white)
        check_sequence(sequence)
        (found,) = diagnose(sequence, "wall")
        assert (found.topic, found.field) == ("mask polarity", "mask")
        assert "keeps 12% of the pixels" in found.sentence
        whole = self.along_a_wall(np.ones_like(white))
        check_sequence(whole)
        assert diagnose(whole, "wall") == []

    def test_an_inverted_one_is_told_from_another_unit(self, posed_folder) -> None:
        """Outside the picture there is other depth, and the mask keeps that alone."""
        white = np.zeros((40, 48), dtype=bool)
        white[:, :14] = True
        self.masked(posed_folder, white)
        for file in (posed_folder / "depth").iterdir():
            np.save(file, np.load(file) * np.where(white, 5, 1).astype(np.float32))
        with pytest.raises(SourceError, match="where the mask leaves it out: the mask is inverted") as caught:
            read(posed_folder)
        assert caught.value.field == "mask"

    def test_reading_tells_of_one_that_looks_inverted(self, posed_folder, caplog) -> None:
        """Whoever does not ask for a check trains on the instruments, and measures them."""
        white = np.zeros((40, 48), dtype=bool)
        white[20:, 24:] = True
        self.masked(posed_folder, ~white)
        read(posed_folder)
        assert "mask" not in caplog.text
        shutil.rmtree(posed_folder / "mask")
        self.masked(posed_folder, white)
        read(posed_folder)
        assert "the mask keeps 25% of the pixels, and" in caplog.text
        (found,) = (item for item in inspect(posed_folder).findings if item.topic == "mask polarity")
        assert (found.kind, found.field) == ("warning", "mask")

    def test_wrong_poses_are_found_with_a_mask(self, posed_folder, edit_poses) -> None:
        white = np.ones((40, 48), dtype=bool)
        white[:, :14] = False
        self.masked(posed_folder, white)

        def to_opengl(content) -> None:
            for entry in content["frames"]:
                pose = np.array(entry["world_from_camera"]) @ np.diag([1.0, -1, -1, 1])
                entry["world_from_camera"] = pose.tolist()

        edit_poses(to_opengl)
        with pytest.raises(PoseError, match="read as OpenGL axes"):
            read(posed_folder)

    @pytest.mark.parametrize("share", [0.19, 0.08, 0.04])
    @pytest.mark.parametrize("depth_outside", [True, False])
    def test_what_is_wrong_behind_a_small_round_one_is_named(self, clip, share, depth_outside) -> None:
        """The picture of a thin endoscope fills little of its image; that switched these checks off."""
        rows, columns = np.mgrid[: clip.height, : clip.width] + 0.5
        away = np.hypot(columns - clip.width / 2, rows - clip.height / 2)
        white = away < np.sqrt(share * clip.height * clip.width / np.pi)
        assert white.mean() == pytest.approx(share, abs=0.005)
        depth = clip.depth_mm if depth_outside else clip.depth_mm * white
        small = replace(clip, mask=clip.mask & white, depth_mm=depth)
        check_sequence(small)
        poses = clip.world_from_camera @ np.diag([1.0, -1, -1, 1])
        with pytest.raises(PoseError, match="the poses contradict the depth"):
            check_sequence(replace(small, world_from_camera=poses))
        metres = (depth / 1000).astype(np.float32)
        with pytest.raises((SourceError, PoseError), match=r"different units|positions of the cameras"):
            check_sequence(replace(small, depth_mm=metres))

    @pytest.mark.parametrize("columns", [10, 14])
    def test_a_narrow_inverted_one_is_named(self, columns) -> None:
        """It keeps 12 %, of which other depth stays in sight."""
        white = np.zeros((64, 80), dtype=bool)
        white[:, -columns:] = True
        wall = self.along_a_wall(white)
        other = replace(wall, depth_mm=wall.depth_mm * np.where(white, 0.5, 1).astype(np.float32))
        with pytest.raises(SourceError, match="where the mask leaves it out: the mask is inverted"):
            check_sequence(other)

    def test_a_narrow_one_without_depth_outside_tells_nothing(self) -> None:
        white = np.zeros((64, 80), dtype=bool)
        white[:, :10] = True
        wall = self.along_a_wall(white)
        check_sequence(replace(wall, depth_mm=wall.depth_mm * white))


class TestChecks:
    def test_leaking_split(self, sparse) -> None:
        leaking = replace(sparse, split=Split("bad", np.arange(21), np.arange(20, 48)))
        with pytest.raises(SourceError, match="1 of 48 frames both train and evaluate"):
            check_sequence(leaking)

    def test_empty_mask(self, sparse) -> None:
        mask = sparse.mask.copy()
        mask[2] = False
        with pytest.raises(SourceError, match="frame b_0020, field mask"):
            check_sequence(replace(sparse, mask=mask))

    def test_distant_frames_are_not_accused(self, distanced) -> None:
        """Views far apart say little; that must never look like wrong axes."""
        for kept in ([0, 10, 25, 47], [20, 30, 40], [5]):
            few = replace(
                distanced,
                rgb=distanced.rgb[kept],
                K=distanced.K[kept],
                mask=distanced.mask[kept],
                depth_mm=distanced.depth_mm[kept],
                world_from_camera=distanced.world_from_camera[kept],
                observed=None,
                recording=None,
                frame_names=(),
                split=Split("few", np.arange(len(kept)), np.arange(0)),
            )
            check_axes(few)

    @pytest.mark.parametrize("axes", [[0, 2, 1], [1, 0, 2], [2, 0, 1]])
    def test_swapped_axes_are_found(self, sparse, axes) -> None:
        swap = np.eye(4)
        swap[:3, :3] = np.eye(3)[axes]
        swap[:3, 0] *= np.linalg.det(swap)
        with pytest.raises(PoseError, match="contradict the depth"):
            check_axes(replace(sparse, world_from_camera=sparse.world_from_camera @ swap))
