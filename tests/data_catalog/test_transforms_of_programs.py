"""What instant-ngp and its like write into a `transforms.json` beside what nerfstudio does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from data_catalog.catalog import glance, read, source_fingerprint
from data_catalog.readers.transforms_json import write_transforms
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError

WIDTH, HEIGHT, COUNT = 32, 24, 4
FOCAL = {"fl_x": 30.0, "fl_y": 30.0}
COLORS = ("red", "green", "blue")


@pytest.fixture
def write(tmp_path):
    """Writes a scene of small frames, with other keys for all of them and for each."""
    texture = np.random.default_rng(0).integers(40, 255, (HEIGHT, WIDTH + COUNT, 3)).astype(np.uint8)

    def written(of_all: dict | None = None, of_each=None, *, file: str = "transforms.json") -> Path:
        frames = []
        for number in range(COUNT):
            place = tmp_path / "images" / f"{number:03d}.png"
            place.parent.mkdir(exist_ok=True)
            Image.fromarray(texture[:, number : number + WIDTH]).save(place)
            pose = np.diag([1.0, -1, -1, 1])
            pose[0, 3] = number
            entry = {"file_path": f"images/{number:03d}.png", "transform_matrix": pose.tolist()}
            frames.append(entry | (of_each(number) if of_each is not None else {}))
        content = FOCAL if of_all is None else of_all
        (tmp_path / file).write_text(json.dumps({**content, "w": WIDTH, "h": HEIGHT, "frames": frames}))
        return tmp_path

    return written


class TestDepthOfInstantNgp:
    @pytest.fixture
    def named(self, tmp_path):
        """Names a depth file of each frame; each has levels of its own."""

        def of_frame(number: int) -> dict[str, str]:
            place = tmp_path / "d" / f"{number}.png"
            place.parent.mkdir(exist_ok=True)
            Image.fromarray(np.full((HEIGHT, WIDTH), 20000 + number, np.uint16)).save(place)
            return {"depth_path": f"d/{number}.png"}

        return of_frame

    def test_is_read(self, write, named) -> None:
        folder = write({**FOCAL, "integer_depth_scale": 1e-3, "enable_depth_loading": True}, named)
        found = read(folder)
        np.testing.assert_allclose(found.depth_mm[:, 5, 5], [20.0, 20.001, 20.002, 20.003], rtol=1e-6)
        assert glance(folder).has_depth
        assert any("d/2.png" in file for file in source_fingerprint(folder)["files"])

    @pytest.mark.parametrize(
        ("told", "problem"),
        [
            ({"integer_depth_scale": -1.0}, "integer_depth_scale is -1, and only above 0"),
            ({}, "there is no integer_depth_scale"),
            ({"integer_depth_scale": 1.0, "enable_depth_loading": False}, "enable_depth_loading is off"),
        ],
        ids=str,
    )
    def test_where_instant_ngp_does_not_read_it(self, write, named, told, problem, caplog) -> None:
        found = read(write({**FOCAL, **told}, named))
        assert found.depth_mm is None
        assert any("depth of 4 of 4 frames (depth_path) is not read" in line for line in caplog.messages)
        assert any(problem in line for line in caplog.messages)

    def test_absent_files(self, write) -> None:
        folder = write({**FOCAL, "integer_depth_scale": 1e-3}, lambda number: {"depth_path": "d/0.png"})
        with pytest.raises(SourceNotFoundError, match="field depth_path: no such file"):
            read(folder)

    def test_nerfstudios_key_counts_first(self, write, named) -> None:
        def both(number: int) -> dict[str, str]:
            return {"depth_file_path": named(number)["depth_path"], "depth_path": "elsewhere.png"}

        found = read(write({**FOCAL, "integer_depth_scale": 2e-3}, both))
        assert found.depth_mm[0, 5, 5] == pytest.approx(40.0)


class TestCamerasOfInstantNgp:
    @pytest.mark.parametrize(
        ("told", "field"),
        [
            (
                {"ftheta_p0": 0, "ftheta_p1": 0.01, "ftheta_p2": 0, "ftheta_p3": 0, "ftheta_p4": 0},
                "ftheta_p0",
            ),
            ({"latlong": True}, "latlong"),
            ({"equirectangular": True}, "equirectangular"),
            ({"orthographic": True}, "orthographic"),
            ({"xi": 1.2}, "xi"),
        ],
        ids=lambda value: value if isinstance(value, str) else "",
    )
    @pytest.mark.parametrize("of_one", [False, True])
    def test_others_than_pinholes_are_refused(self, write, told, field, of_one) -> None:
        if of_one:
            folder = write(FOCAL, lambda number: told if number == 2 else {})
        else:
            folder = write({**FOCAL, **told})
        with pytest.raises(SourceError, match="not known here") as caught:
            read(folder)
        assert caught.value.field == field

    def test_switches_that_are_off(self, write) -> None:
        told = {"latlong": False, "equirectangular": False, "orthographic": False, "ftheta_p0": None}
        assert read(write({**FOCAL, **told})).K[0, 0, 0] == pytest.approx(30)

    def test_a_fisheye_is_told_to_both_programs(self, write, tmp_path) -> None:
        """instant-ngp goes by `is_fisheye`, and nerfstudio by `camera_model`."""
        terms = {"k1": -0.03, "k2": 0.01, "k3": 0.004, "k4": 0.0}
        native = IngestConfig(lens="native")
        given = read(write({**FOCAL, "is_fisheye": True, **terms}), native)
        written = tmp_path / "again"
        write_transforms(given, written)
        content = json.loads((written / "transforms.json").read_text())
        assert content["camera_model"] == "OPENCV_FISHEYE"
        assert content["is_fisheye"] is True
        back = read(written, native)
        np.testing.assert_allclose(back.lens.coefficients, given.lens.coefficients, atol=1e-9)
        np.testing.assert_allclose(back.K, given.K, atol=1e-12)
        for key in ("camera_model", "is_fisheye"):
            less = {name: value for name, value in content.items() if name != key}
            (written / "transforms.json").write_text(json.dumps(less))
            assert read(written, native).lens == back.lens

    def test_a_pinhole_is_no_fisheye(self, write, tmp_path) -> None:
        write_transforms(read(write()), tmp_path / "again")
        assert "is_fisheye" not in json.loads((tmp_path / "again" / "transforms.json").read_text())

    @pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
    def test_programs_that_would_differ(self, write, model) -> None:
        folder = write({**FOCAL, "is_fisheye": True, "camera_model": model, "k1": 0.1})
        with pytest.raises(SourceError, match=f"'{model}' beside is_fisheye") as caught:
            read(folder)
        assert caught.value.field == "camera_model"

    @pytest.mark.parametrize("terms", [{}, {"k1": 0.0, "k2": 0, "k3": 0.0, "k4": None}])
    def test_a_fisheye_without_terms(self, write, terms) -> None:
        """A pinhole for instant-ngp, an equidistant fisheye for nerfstudio: `camera_model` decides."""
        with pytest.raises(SourceError, match="a pinhole for instant-ngp") as caught:
            read(write({**FOCAL, "is_fisheye": True, **terms}))
        assert caught.value.field == "is_fisheye"
        stated = {**FOCAL, "is_fisheye": True, "camera_model": "OPENCV_FISHEYE", **terms}
        given = read(write(stated), IngestConfig(lens="native"))
        assert given.lens.coefficients == pytest.approx((0, 0, 0, 0), abs=1e-9)
        assert read(write({**FOCAL, "is_fisheye": False, **terms})).K[0, 0, 0] == pytest.approx(30)


class TestFocalLengths:
    @pytest.mark.parametrize(
        ("told", "expected"),
        [
            ({"x_fov": 60.0}, [27.712813, 27.712813]),
            ({"x_fov": 60.0, "y_fov": 60.0}, [27.712813, 20.784610]),
            ({"y_fov": 60.0}, [20.784610, 20.784610]),
            ({"camera_angle_y": np.pi / 3}, [20.784610, 20.784610]),
            ({"camera_angle_x": np.pi / 3}, [27.712813, 27.712813]),
            ({"fl_x": 30.0, "x_fov": 60.0}, [30.0, 30.0]),
            ({"fl_x": 30.0, "camera_angle_y": np.pi / 3}, [30.0, 20.784610]),
            ({"fl_y": 25.0}, [25.0, 25.0]),
        ],
        ids=str,
    )
    def test_by_all_keys(self, write, told, expected) -> None:
        K = read(write(told)).K[0]
        np.testing.assert_allclose([K[0, 0], K[1, 1]], expected, rtol=1e-6)

    def test_a_frames_own_counts_by_whatever_key(self, write) -> None:
        own = {"x_fov": 60.0, "y_fov": 2 * np.degrees(np.arctan(12 / 27.712813))}
        found = read(write(FOCAL, lambda number: own if number == 2 else {}))
        np.testing.assert_allclose(found.K[:, 0, 0], [30, 30, 27.712813, 30], rtol=1e-6)

    @pytest.mark.parametrize("told", [{"x_fov": 0}, {"x_fov": 180.0}, {"camera_angle_y": -1.0}], ids=str)
    def test_no_angle(self, write, told) -> None:
        with pytest.raises(SourceError, match="between 0 and 180 degrees") as caught:
            read(write(told))
        assert caught.value.field == next(iter(told))


class TestSeparatorsOfWindows:
    @pytest.fixture
    def windows(self, write):
        """Masks in a folder of their own; all names with the separators of Windows."""

        def named(number: int) -> dict[str, str]:
            return {
                "file_path": f".\\images\\{number:03d}.png",
                "mask_path": f"masks\\{number:03d}.png",
                "depth_path": f"d\\{number}.png",
            }

        folder = write(
            {**FOCAL, "integer_depth_scale": 1e-3, "test_filenames": [".\\images\\002.png"]}, named
        )
        white = np.full((HEIGHT, WIDTH), 255, np.uint8)
        white[:, :5] = 0
        for number in range(COUNT):
            for place, picture in (("masks", white), ("d", np.full((HEIGHT, WIDTH), 20000, np.uint16))):
                (folder / place).mkdir(exist_ok=True)
                name = f"{number:03d}" if place == "masks" else f"{number}"
                Image.fromarray(picture).save(folder / place / f"{name}.png")
        return folder

    def test_all_files_are_found(self, windows) -> None:
        found = read(windows)
        assert len(found) == COUNT
        assert not found.mask[:, :, 0].any()
        assert found.depth_mm is not None
        assert found.test.tolist() == [2]
        assert not any("\\" in name for name in found.frame_names)
        names = {name for name, *_ in source_fingerprint(windows)["files"]}
        assert {"images/001.png", "masks/001.png", "d/1.png"} <= names

    def test_with_slashes_it_is_the_same(self, windows) -> None:
        file = windows / "transforms.json"
        first = read(windows)
        file.write_text(file.read_text().replace("\\\\", "/"))
        assert read(windows).frame_names == first.frame_names

    def test_a_file_that_is_called_so_is_taken(self, write) -> None:
        """On this system it is a letter like others."""
        folder = write(FOCAL, lambda number: {"file_path": f"images\\{number}.png"})
        for number in range(COUNT):
            (folder / "images" / f"{number:03d}.png").rename(folder / f"images\\{number}.png")
        assert len(read(folder)) == COUNT

    def test_none_leads_out_of_the_folder(self, write) -> None:
        folder = write(FOCAL, lambda number: {"file_path": f"..\\images\\{number:03d}.png"})
        with pytest.raises(SourceError, match="leads out of the folder"):
            read(folder)

    def test_one_image_by_two_spellings(self, write) -> None:
        spelled = ("images/000.png", "images\\000.png", "images/002.png", "images/003.png")
        with pytest.raises(SourceError, match=r"frame images/000\.png.*listed twice"):
            read(write(FOCAL, lambda number: {"file_path": spelled[number]}))


class TestColoursOfPoints:
    @pytest.mark.parametrize(
        ("kind", "value", "expected"),
        [
            ("f4", 0.6, 153),
            ("f8", 1.0, 255),
            ("f4", 153.0, 153),
            ("u2", 39321, 153),
            ("u2", 153, 153),
            ("u1", 1, 1),
            ("i4", 153, 153),
        ],
    )
    def test_by_their_kind(self, write, kind, value, expected) -> None:
        rows = np.zeros(8, dtype=[*((axis, "f4") for axis in "xyz"), *((c, kind) for c in COLORS)])
        rows["x"] = np.arange(8)
        for color in COLORS:
            rows[color][2:] = value
        folder = write({**FOCAL, "ply_file_path": "points.ply"})
        PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "points.ply"))
        np.testing.assert_array_equal(read(folder).points_rgb[:, 1], [0, 0] + 6 * [expected])


class TestFilesOfSplits:
    """As in the synthetic scenes of NeRF: a file and a folder for each split, images named without suffix."""

    @pytest.fixture
    def scene(self, tmp_path):
        def written(splits=("train", "val", "test"), **of_one) -> Path:
            texture = np.random.default_rng(0).integers(40, 255, (HEIGHT, WIDTH + 40, 3)).astype(np.uint8)
            for at, split in enumerate(splits):
                (tmp_path / split).mkdir()
                frames = []
                for number in range(COUNT):
                    shift = 10 * at + number
                    image = Image.fromarray(texture[:, shift : shift + WIDTH])
                    image.save(tmp_path / split / f"r_{number}.png")
                    pose = np.diag([1.0, -1, -1, 1])
                    pose[0, 3] = shift
                    name = f"./{split}/r_{number}"
                    frames.append({"file_path": name, "rotation": 0.03, "transform_matrix": pose.tolist()})
                content = {"camera_angle_x": np.pi / 3, "frames": frames, **of_one.get(split, {})}
                (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
            return tmp_path

        return written

    def test_one_trains_and_one_evaluates(self, scene, caplog) -> None:
        folder = scene()
        found = read(folder)
        assert not caplog.messages
        assert sorted(np.array(found.frame_names)[found.train]) == [
            f"./train/r_{k}"[2:] for k in range(COUNT)
        ]
        assert sorted(np.array(found.frame_names)[found.test]) == [f"test/r_{k}" for k in range(COUNT)]
        centers = {
            name: center[0] for name, center in zip(found.frame_names, found.cameras.centers, strict=True)
        }
        assert centers["train/r_2"] == 2
        assert centers["test/r_1"] == 21
        np.testing.assert_allclose(found.K[:, 0, 0], 27.712813, rtol=1e-6)

    def test_files_that_count(self, scene) -> None:
        folder = scene()
        names = {name for name, *_ in source_fingerprint(folder)["files"]}
        assert {"transforms_train.json", "transforms_test.json", "train/r_0.png", "test/r_3.png"} <= names
        assert not any("val" in name for name in names)
        assert glance(folder).test == COUNT

    def test_without_a_test_the_validation_evaluates(self, scene) -> None:
        found = read(scene(("train", "val")))
        assert {found.frame_names[k].split("/")[0] for k in found.test} == {"val"}

    def test_training_frames_alone_are_split_by_the_usual_rule(self, scene) -> None:
        found = read(scene(("train",)), IngestConfig(holdout_every=2))
        assert len(found) == COUNT
        assert len(found.test) == COUNT // 2

    def test_each_file_has_its_own_camera(self, scene) -> None:
        found = read(scene(test={"camera_angle_x": 1.2}))
        focal = dict(zip(found.frame_names, found.K[:, 0, 0], strict=True))
        assert focal["train/r_0"] == pytest.approx(27.712813)
        assert focal["test/r_0"] == pytest.approx(16 / np.tan(0.6))

    def test_errors_name_the_file(self, scene) -> None:
        folder = scene()
        file = folder / "transforms_test.json"
        content = json.loads(file.read_text())
        del content["frames"][2]["transform_matrix"]
        file.write_text(json.dumps(content))
        with pytest.raises(SourceError, match=r"transforms_test\.json, frame \./test/r_2, field transform_m"):
            read(folder)

    def test_files_that_contradict_each_other(self, scene) -> None:
        folder = scene(test={"length_unit": "mm"})
        with pytest.raises(SourceError, match=r"transforms_test\.json, field length_unit: 'mm', but None in"):
            read(folder)

    def test_a_frame_of_two_splits(self, scene) -> None:
        folder = scene()
        (folder / "transforms_test.json").write_text((folder / "transforms_train.json").read_text())
        with pytest.raises(SourceError, match=r"transforms_train\.json lists this frame, too"):
            read(folder)

    def test_a_single_file_counts_first(self, scene, write) -> None:
        scene()
        assert len(read(write())) == COUNT

    def test_a_part_of_it_is_read_without_poses(self, scene, caplog) -> None:
        folder = scene()
        found = read(folder / "train")
        assert found.world_from_camera is None
        expected = f"train is read without poses; {folder / 'transforms_train.json'} lists frames"
        assert any(expected in line for line in caplog.messages)
