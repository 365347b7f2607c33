"""`transforms.json` in and out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.sequence import Split
from tests.data_catalog.layouts import carried_error_mm, same_frames

ROUNDING = 1e-12


@pytest.fixture
def folder(clip, tmp_path):
    write_transforms(clip, tmp_path / "scene")
    return tmp_path / "scene"


@pytest.fixture
def edit(folder):
    def change(how) -> None:
        file = folder / "transforms.json"
        content = json.loads(file.read_text())
        how(content)
        file.write_text(json.dumps(content))

    return change


class TestRoundTrip:
    def test_sequence_to_file_to_sequence(self, clip, tmp_path) -> None:
        mask = clip.mask.copy()
        mask[:, :, :6] = False
        rng = np.random.default_rng(0)
        given = replace(
            clip,
            mask=mask,
            points=rng.normal(0, 10, (30, 3)),
            points_rgb=rng.integers(0, 255, (30, 3)).astype(np.uint8),
            split=Split("manifest", np.arange(2, 10), np.array([0, 1])),
        )
        write_transforms(given, tmp_path / "scene")
        back = read(tmp_path / "scene")
        same_frames(back, given, atol=ROUNDING)
        np.testing.assert_allclose(back.depth_mm, given.depth_mm, rtol=1e-6)
        np.testing.assert_array_equal(back.points, given.points)
        np.testing.assert_array_equal(back.points_rgb, given.points_rgb)

    def test_file_to_sequence_to_file(self, folder, tmp_path) -> None:
        write_transforms(read(folder), tmp_path / "again")
        first, second = (
            json.loads((place / "transforms.json").read_text()) for place in (folder, tmp_path / "again")
        )
        assert [entry["file_path"] for entry in first["frames"]] == [
            entry["file_path"] for entry in second["frames"]
        ]
        for one, other in zip(first["frames"], second["frames"], strict=True):
            np.testing.assert_allclose(
                one["transform_matrix"], other["transform_matrix"], rtol=0, atol=ROUNDING
            )
            for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
                assert one[key] == other[key]
        assert first["test_filenames"] == second["test_filenames"]

    def test_no_list_is_empty(self, clip, folder, tmp_path) -> None:
        """nerfstudio cannot be given a list without frames."""
        content = json.loads((folder / "transforms.json").read_text())
        assert content["val_filenames"] == content["test_filenames"] == ["images/0000.png"]
        assert len(content["train_filenames"]) == len(clip) - 1
        every = replace(clip, split=Split("all", np.arange(len(clip)), np.arange(0)))
        write_transforms(every, tmp_path / "every")
        content = json.loads((tmp_path / "every" / "transforms.json").read_text())
        assert not [key for key in content if key.endswith("_filenames")]

    def test_depth_carried_from_frame_to_frame(self, clip, folder) -> None:
        back = read(folder)
        assert carried_error_mm(back) == pytest.approx(carried_error_mm(clip), abs=1e-4)
        assert carried_error_mm(back) < 0.2

    def test_arbitrary_scale_stays_arbitrary(self, clip, tmp_path) -> None:
        write_transforms(replace(clip, metric=False, depth_mm=None), tmp_path / "scene")
        assert read(tmp_path / "scene").metric is False


class TestReading:
    def test_decimals_have_their_place(self, clip, folder, edit) -> None:
        def renamed(content) -> None:
            for number, entry in enumerate(content["frames"]):
                place = folder / entry["file_path"]
                entry["file_path"] = f"images/{number * 0.05:g}.png"
                place.rename(folder / entry["file_path"])
            content["frames"].reverse()
            for key in [key for key in content if key.endswith("_filenames")]:
                del content[key]

        edit(renamed)
        found = read(folder)
        assert found.frame_names == tuple(f"{number * 0.05:g}" for number in range(len(clip)))
        same = np.abs(found.cameras.centers - clip.cameras.centers)
        assert same.max() < 1e-9
        assert source_fingerprint(folder)["order"] == "decimals"

    def test_recognised(self, folder) -> None:
        assert resolve(folder).format == "transforms"

    def test_axes_are_opengl(self, folder) -> None:
        """A camera that looks along -z of its matrix looks along +z here."""
        content = json.loads((folder / "transforms.json").read_text())
        matrix = np.array(content["frames"][2]["transform_matrix"])
        pose = read(folder).cameras.world_from_camera[2]
        np.testing.assert_allclose(pose[:3, 2], -matrix[:3, 2], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 1], -matrix[:3, 1], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 0], matrix[:3, 0], atol=1e-12)

    def test_metres_and_millimetre_depth_as_nerfstudio_has_them(self, clip, folder, edit) -> None:
        def metres(content) -> None:
            content["length_unit"] = "m"
            for index, entry in enumerate(content["frames"]):
                matrix = np.array(entry["transform_matrix"])
                matrix[:3, 3] /= 1000
                entry["transform_matrix"] = matrix.tolist()
                entry["depth_file_path"] = f"depth/{index:04d}.png"
                millimetres = np.round(clip.depth_mm[index]).astype(np.uint16)
                Image.fromarray(millimetres).save(folder / entry["depth_file_path"])

        edit(metres)
        back = read(folder)
        assert back.metric
        np.testing.assert_allclose(back.cameras.world_from_camera, clip.cameras.world_from_camera, atol=1e-9)
        assert np.abs(back.depth_mm - clip.depth_mm).max() <= 0.5 + 1e-3

    def test_integer_depth_scale_of_instant_ngp(self, clip, folder, edit) -> None:
        def coded(content) -> None:
            content["integer_depth_scale"] = 100 / 65535
            for index, entry in enumerate(content["frames"]):
                entry["depth_file_path"] = f"depth/{index:04d}.png"
                codes = np.clip(np.round(clip.depth_mm[index] / 100 * 65535), 0, 65535).astype(np.uint16)
                Image.fromarray(codes).save(folder / entry["depth_file_path"])

        edit(coded)
        assert np.abs(read(folder).depth_mm - np.minimum(clip.depth_mm, 100)).max() < 2e-3

    def test_intrinsics_for_all_frames_and_from_an_angle(self, folder, edit) -> None:
        def shared(content) -> None:
            for entry in content["frames"]:
                for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "depth_file_path"):
                    entry.pop(key)
            content["camera_angle_x"] = np.pi / 2
            content.pop("camera_model")

        edit(shared)
        np.testing.assert_allclose(read(folder).K[4], [[48, 0, 48], [0, 48, 38.5], [0, 0, 1]], atol=1e-9)

    @pytest.mark.parametrize("keys", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
    def test_fisheye(self, folder, edit, keys) -> None:
        def fisheye(content) -> None:
            content.pop("camera_model")
            content.update(k1=0.15, k2=0.001, **keys)
            for entry in content["frames"]:
                entry.pop("depth_file_path")

        edit(fisheye)
        back = read(folder)
        # At the lens's central resolution a pinhole sees less than a fisheye: nothing is missing.
        assert back.mask.all()
        assert (back.K[0, 0, 2], back.K[0, 1, 2]) == (48, 38.5)
        wide = read(folder, IngestConfig(field_of_view_deg=140.0))
        assert wide.K[0, 0, 0] == pytest.approx(48 / np.tan(np.radians(70)))
        assert wide.mask[0, 38, 48]
        assert not wide.mask[0, 0, 0]

    @pytest.mark.parametrize(
        ("model", "terms", "refused"),
        [
            ("PINHOLE", {"k1": -0.3}, "k1"),
            ("SIMPLE_PINHOLE", {"p2": 0.01}, "p2"),
            ("OPENCV", {"k1": 0.1, "k5": 0.2}, "k5"),
            ("OPENCV", {"k6": 0.2}, "k6"),
            ("OPENCV", {"k3": 0.1, "k6": 0.2}, "k6"),
            ("SIMPLE_RADIAL", {"k1": 0.1, "k3": 0.1}, "k3"),
            ("OPENCV_FISHEYE", {"k1": 0.1, "p1": 0.01}, "p1"),
        ],
    )
    def test_a_term_that_the_model_has_not_is_refused(self, folder, edit, model, terms, refused) -> None:
        edit(lambda content: content.update(camera_model=model, **terms))
        said = rf"frame images/0000\.png, field {refused}: {refused} .*camera_model {model}"
        with pytest.raises(SourceError, match=said):
            read(folder)
        edit(lambda content: content.update(dict.fromkeys(terms, 0.0)))
        assert len(read(folder)) == 10

    def test_null_is_no_value(self, clip, folder, edit) -> None:
        def nothing(content) -> None:
            content.update(dict.fromkeys(("camera_model", "k1", "ply_file_path", "depth_unit_scale_factor")))
            content["val_filenames"] = None
            for entry in content["frames"]:
                entry.update(mask_path=None, depth_file_path=None, p1=None)

        before = read(folder)
        edit(nothing)
        found = read(folder)
        same_frames(found, replace(before, depth_mm=None), atol=ROUNDING)
        assert found.depth_mm is None
        assert found.points is None

    def test_a_matrix_that_is_not_finite_is_named_as_it_stands_in_the_file(self, folder, edit) -> None:
        def spoilt(content) -> None:
            content["frames"][2]["transform_matrix"][1][3] = float("nan")

        edit(spoilt)
        with pytest.raises(PoseError, match="1 of 16 entries are NaN or infinite") as caught:
            read(folder)
        name = json.loads((folder / "transforms.json").read_text())["frames"][2]["file_path"]
        assert (caught.value.field, caught.value.frame) == ("transform_matrix", name)

    @pytest.mark.parametrize("colored", [True, False])
    def test_points_that_are_not_finite_are_left_out(self, folder, edit, caplog, colored) -> None:
        kinds = [*((axis, "f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))]
        rows = np.zeros(20, dtype=kinds if colored else kinds[:3])
        rows["x"] = np.arange(20)
        if colored:
            rows["red"] = np.arange(20)
        rows["y"][::10], rows["z"][5] = np.nan, np.inf
        PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "points.ply"))
        edit(lambda content: content.update(ply_file_path="points.ply"))
        back = read(folder)
        kept = [index for index in range(20) if index not in (0, 5, 10)]
        assert back.points[:, 0].tolist() == kept
        assert (back.points_rgb is not None) == colored
        if colored:
            assert back.points_rgb[:, 0].tolist() == kept
        assert "points.ply: 3 of 20 points are not finite and left out" in caplog.text
        rows["x"] = np.nan
        PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "points.ply"))
        assert read(folder).points is None

    def test_pixels_are_taken_as_they_are_stored_and_said(self, folder, edit, caplog) -> None:
        exif = Image.Exif()
        exif[274] = 6
        before = read(folder)
        assert "EXIF" not in caplog.text
        for file in sorted((folder / "images").iterdir())[3:5]:
            Image.open(file).save(file, exif=exif)
        np.testing.assert_array_equal(read(folder).rgb, before.rgb)
        assert "0003.png: 2 of 10 images, this one first, have an EXIF orientation, which t" in caplog.text

    def test_paths_without_suffix(self, folder, edit) -> None:
        def strip(content) -> None:
            for key in ("train_filenames", "test_filenames", "val_filenames"):
                content[key] = [name.removesuffix(".png") for name in content[key]]
            for entry in content["frames"]:
                entry["file_path"] = entry["file_path"].removesuffix(".png")

        edit(strip)
        assert read(folder).test.tolist() == [0]

    def test_validation_frames_are_held_out_too(self, folder, edit) -> None:
        edit(lambda content: content.update(val_filenames=["images/0005.png"], train_filenames=[]))
        assert read(folder).test.tolist() == [0, 5]


LISTS = [
    # train, test, held out, left out
    ([1, 5], [0, 9], [0, 9], [2, 3, 4, 6, 7, 8]),
    ([0, 1, 2, 3, 4, 5, 6, 7], None, [8, 9], []),
    (None, [0, 9], [0, 9], []),
]


class TestLists:
    """What is named to train on, nothing else trains."""

    @pytest.mark.parametrize(("train", "test", "held_out", "left_out"), LISTS)
    def test_of_transforms(self, folder, edit, caplog, train, test, held_out, left_out) -> None:
        def lists(content) -> None:
            names = [entry["file_path"] for entry in content["frames"]]
            content["val_filenames"] = []
            for key, chosen in (("train_filenames", train), ("test_filenames", test)):
                content[key] = [] if chosen is None else [names[k] for k in chosen]

        names = read(folder).frame_names
        edit(lists)
        self.check(read(folder), names, held_out, left_out, caplog.text)

    @pytest.mark.parametrize(("train", "test", "held_out", "left_out"), LISTS)
    def test_of_colmap(self, clip, tmp_path, caplog, train, test, held_out, left_out) -> None:
        write_colmap(clip, tmp_path / "scene")
        names = read(tmp_path / "scene").frame_names
        for part, chosen in (("train", train), ("test", test)):
            file = tmp_path / "scene" / f"{part}_list.txt"
            if chosen is None:
                file.unlink()
            else:
                # As an editor on Windows leaves it.
                file.write_bytes("".join(f"{names[k]}.png\r\n" for k in chosen).encode())
        self.check(read(tmp_path / "scene"), names, held_out, left_out, caplog.text)

    def check(self, found, names, held_out, left_out, said) -> None:
        assert found.frame_names == tuple(name for k, name in enumerate(names) if k not in left_out)
        assert [found.frame_names[k] for k in found.test] == [names[k] for k in held_out]
        assert len(found.train) == len(names) - len(held_out) - len(left_out)
        told = f"{len(left_out)} of {len(names)} frames are neither to train on nor to evaluate on"
        assert (told in said) == bool(left_out)

    @pytest.mark.parametrize("write", [write_transforms, write_colmap])
    def test_written_and_read_they_are_the_same(self, write, clip, tmp_path) -> None:
        sequence = replace(clip, split=Split("manifest", np.array([1, 5]), np.array([0])))
        write(sequence, tmp_path / "scene")
        back = read(tmp_path / "scene")
        assert len(back) == 3
        assert (back.train.tolist(), back.test.tolist()) == ([1, 2], [0])


class TestAbsentFrames:
    """Published scenes list frames that they do not ship."""

    @pytest.mark.parametrize("write", [write_transforms, write_colmap])
    def test_are_left_out_and_named(self, write, clip, tmp_path, caplog) -> None:
        folder = tmp_path / "scene"
        write(clip, folder)
        whole = read(folder)
        absent = [2, 5]
        images = sorted((folder / "images").iterdir())
        for index in absent:
            images[index].unlink()
        with caplog.at_level("WARNING"):
            found = read(folder)
        kept = np.setdiff1d(np.arange(len(whole)), absent)
        np.testing.assert_array_equal(found.rgb, whole.rgb[kept])
        np.testing.assert_array_equal(found.cameras.world_from_camera, whole.cameras.world_from_camera[kept])
        np.testing.assert_array_equal(found.depth_mm, whole.depth_mm[kept])
        (said,) = [record.getMessage() for record in caplog.records if "absent" in record.getMessage()]
        assert f"lists {len(whole)} frames; 2 of them are absent and left out:" in said
        assert all(images[index].name in said for index in absent)

    @pytest.mark.parametrize(("share", "refused"), [(0.1, True), (0.2, False)])
    def test_share_that_may_be_absent(self, clip, folder, share, refused) -> None:
        for entry in json.loads((folder / "transforms.json").read_text())["frames"][:2]:
            (folder / entry["file_path"]).unlink()
        config = IngestConfig(max_absent_share=share)
        if not refused:
            assert len(read(folder, config)) == len(clip) - 2
            return
        with pytest.raises(SourceNotFoundError, match="2 of them are absent, this one first") as caught:
            read(folder, config)
        assert caught.value.field == "file"

    def test_none_there(self, folder) -> None:
        for file in (folder / "images").iterdir():
            file.unlink()
        with pytest.raises(SourceNotFoundError, match="absent"):
            read(folder, IngestConfig(max_absent_share=0.99))
