"""Keys that no reader asks for are not passed over in silence."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from data_catalog.catalog import glance, read
from data_catalog.inspection import inspect
from data_catalog.readers.transforms_json import write_transforms
from extrags.errors import SourceError


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture):
    """What is said of unknown keys when a folder is read."""

    def reading(folder: Path) -> list[str]:
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            read(folder)
        return [message for message in caplog.messages if "unknown keys" in message]

    return reading


class TestPosesJson:
    def test_known_ones_are_no_news(self, posed_folder, edit_poses, told) -> None:
        def all_of_them(content) -> None:
            for number, entry in enumerate(content["frames"]):
                entry |= {"split": "test" if number == 3 else "train", "recording": 0, "K": content["K"]}

        edit_poses(all_of_them)
        assert told(posed_folder) == []

    def test_remarks_are_no_news(self, posed_folder, edit_poses, told) -> None:
        edit_poses(lambda content: content.update({"_comment": "seen on Monday", "//": "and on Tuesday"}))
        assert told(posed_folder) == []

    @pytest.mark.parametrize(
        ("key", "near"),
        [("Kay", "'Kay' (did you mean K?)"), ("lengthunit", "'lengthunit' (did you mean length_unit?)")],
    )
    def test_beside_the_frames(self, posed_folder, edit_poses, told, key, near) -> None:
        edit_poses(lambda content: content.update({key: 3}))
        (said,) = told(posed_folder)
        assert said == f"{posed_folder / 'poses.json'}: unknown keys are ignored: {near}"

    def test_in_frames_is_said_once(self, posed_folder, edit_poses, told) -> None:
        def misspelt(content) -> None:
            for entry in content["frames"][2:6]:
                entry["spilt"] = "train"

        edit_poses(misspelt)
        (said,) = told(posed_folder)
        assert said.endswith("'spilt' in 4 of 10 frames, rgb/0002.png first (did you mean split?)")
        (found,) = inspect(posed_folder).findings
        assert (found.topic, found.field, found.kind) == ("unknown key", "spilt", "warning")

    def test_at_another_place(self, posed_folder, edit_poses, told) -> None:
        def misplaced(content) -> None:
            content["split"] = "train"
            content["frames"][0]["length_unit"] = "mm"

        edit_poses(misplaced)
        (said,) = told(posed_folder)
        assert "'split' (it is looked for in each frame)" in said
        assert "'length_unit' in 1 of 10 frames, rgb/0000.png first (it is looked for beside the" in said

    def test_without_a_likely_meaning_it_is_a_note(self, posed_folder, edit_poses, told) -> None:
        edit_poses(lambda content: content.update({f"remark {number}": number for number in range(7)}))
        (said,) = told(posed_folder)
        assert said.endswith("'remark 4'; and 2 more")
        inspection = inspect(posed_folder)
        assert inspection.ok
        assert any("'remark 0'" in note for note in inspection.notes)

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("distortion", [0.1, 0, 0, 0]),
            ("k1", -0.2),
            ("dist_coeffs", {"rows": 1, "cols": 2, "data": [0.1, 0.2]}),
            ("camera_model", "OPENCV_FISHEYE"),
            ("fisheye", True),
        ],
    )
    @pytest.mark.parametrize("in_frame", [False, True])
    def test_distortion_is_refused(self, posed_folder, edit_poses, key, value, in_frame) -> None:
        def distorted(content) -> None:
            (content["frames"][4] if in_frame else content)[key] = value

        edit_poses(distorted)
        for function in (read, glance):
            with pytest.raises(
                SourceError, match=r"expected a pinhole here\. Undistort the images"
            ) as caught:
                function(posed_folder)
            assert caught.value.field == key
            assert caught.value.frame == ("rgb/0004.png" if in_frame else None)

    @pytest.mark.parametrize(
        ("key", "value"), [("distortion", [0, 0, 0.0]), ("k1", 0), ("camera_model", "PINHOLE")]
    )
    def test_no_distortion_is_a_pinhole(self, posed_folder, edit_poses, told, key, value) -> None:
        edit_poses(lambda content: content.update({key: value}))
        assert told(posed_folder) == []


class TestTransformsJson:
    @pytest.fixture
    def transforms(self, clip, tmp_path):
        write_transforms(clip, tmp_path)

        def edited(change) -> Path:
            file = tmp_path / "transforms.json"
            content = json.loads(file.read_text())
            change(content)
            file.write_text(json.dumps(content))
            return tmp_path

        return edited

    @pytest.mark.parametrize(
        "keys",
        [
            {"aabb_scale": 16, "applied_transform": [[1, 0, 0, 0]], "scale": 1, "offset": [0, 0, 0]},
            {"sharpness": 30.2, "colmap_im_id": 4, "near": 0.1, "author": "A"},
            {"camera_id": 1, "n_frames": 10, "split_filenames": ["a"], "lidar_file_path": "a.bin"},
            {"event_file_path": "a", "thermal_file_path": "a", "radar_file_path": "a"},
            {"sonar_file_path": "a", "mono_depth_file_path": "a", "spare_filenames": []},
        ],
    )
    def test_what_programs_write_is_no_news(self, transforms, told, keys) -> None:
        def further(content) -> None:
            content.update(keys)
            content["frames"][1].update(keys)

        assert told(transforms(further)) == []

    @pytest.mark.parametrize(
        ("key", "near"),
        [
            ("integer_depth_scal", "integer_depth_scale"),
            ("test_filename", "test_filenames"),
            ("depth_unit_scale", "depth_unit_scale_factor"),
            ("depht_file_path", "depth_file_path"),
            ("validation_filenames", "val_filenames"),
            ("trian_filenames", "train_filenames"),
        ],
    )
    def test_misspelt(self, transforms, told, key, near) -> None:
        (said,) = told(transforms(lambda content: content.update({key: [1.0]})))
        assert said.endswith(f"'{key}' (did you mean {near}?)")

    @pytest.mark.parametrize("key", ["distortion_params", "dist_coeffs"])
    def test_distortion_that_is_not_read(self, transforms, told, key) -> None:
        def distorted(content) -> None:
            content["frames"][1][key] = [0.1, 0, 0, 0, 0, 0]

        (said,) = told(transforms(distorted))
        assert f"'{key}' in 1 of 10 frames" in said

        def straight(content) -> None:
            content["frames"][1][key] = [0.0] * 6

        assert told(transforms(straight)) == []
