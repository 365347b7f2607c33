"""Calibration files of three toolboxes, each against the toolbox's own projection."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog import glance, read, resolve, source_fingerprint
from data_catalog.c3vd.scaramuzza import ScaramuzzaCamera
from data_catalog.calibration_files import read_calibration
from data_catalog.inspection import inspect
from data_catalog.readers import frames_folder
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError
from extrags.lens import Lens
from tests.data_catalog.layouts import write_endonerf

WIDTH, HEIGHT = 160, 128
K = np.array([[110.0, 0, 83.0], [0, 113.0, 60.5], [0, 0, 1]])
RAYS = np.column_stack([np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2)), np.ones(50)])

OCAMCALIB = """\
#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB).

 5 -9.1e+01 0.000000e+00 1.3e-03 -2.1e-06 8.0e-09

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB)

 3 130.1 80.2 -3.1

#center: "row" and "column", starting from 0 (C convention)

62.25 78.5

#affine parameters "c", "d", "e"

0.9985 0.0012 -0.0021

#image size: "height" and "width"

128 160
"""


def opencv_file(
    path: Path,
    distortion: list[float],
    *,
    fisheye: bool = False,
    sized: bool = True,
    points: bool = False,
) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if sized:
        storage.write("image_width", WIDTH)
        storage.write("image_height", HEIGHT)
    if fisheye:
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([distortion]))
    if points:
        storage.write("image_points", np.zeros((25, 250, 2), np.float32))
        storage.write("grid_points", np.zeros((1, 54, 3), np.float32))
    storage.release()
    return path


def kalibr_file(path: Path, model: str, terms: list[float]) -> Path:
    path.write_text(
        "cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n"
        f"  distortion_coeffs: {terms}\n  distortion_model: {model}\n"
        f"  intrinsics: [110.0, 113.0, 83.0, 60.5]\n  resolution: [{WIDTH}, {HEIGHT}]\n  rostopic: /scope\n"
    )
    return path


def projected(lens: Lens | ScaramuzzaCamera, rays: np.ndarray) -> np.ndarray:
    """Pixels with their centres at integers, as the toolboxes count."""
    if isinstance(lens, ScaramuzzaCamera):
        return lens.project(rays)
    return np.stack(lens.project(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]), axis=1) - 0.5


class TestOpenCV:
    @pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
    @pytest.mark.parametrize("count", [4, 5, 8])
    def test_projection_is_opencvs(self, tmp_path, suffix, count) -> None:
        terms = [-0.21, 0.05, 0.002, -0.001, 0.01, 0.02, -0.01, 0.004][:count]
        lens = read_calibration(opencv_file(tmp_path / f"scope.{suffix}", terms), WIDTH, HEIGHT)
        expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), K, np.array(terms))[0][:, 0]
        np.testing.assert_allclose(projected(lens, RAYS), expected, atol=1e-9)

    @pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
    @pytest.mark.parametrize("name", ["distortion_coefficients", "dist_coeff", "distortion"])
    def test_a_plain_list_is_distortion_too(self, tmp_path, suffix, name) -> None:
        path, terms = tmp_path / f"scope.{suffix}", [-0.21, 0.05, 0.002, -0.001, 0.01]
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", K)
        storage.startWriteStruct(name, cv2.FILE_NODE_SEQ)
        for term in terms:
            storage.write("", term)
        storage.endWriteStruct()
        storage.release()
        expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), K, np.array(terms))[0][:, 0]
        found = projected(read_calibration(path, WIDTH, HEIGHT), RAYS)
        np.testing.assert_allclose(found, expected, atol=1e-9)

    @pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
    def test_ros(self, tmp_path, model) -> None:
        terms = [-0.21, 0.05, 0.002, -0.001, 0.01] if model == "plumb_bob" else [0.03, -0.01, 0.004, -0.001]
        path = tmp_path / "camera_info.yaml"
        path.write_text(
            f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_name: scope\n"
            f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {K.ravel().tolist()}\n"
            f"distortion_model: {model}\n"
            f"distortion_coefficients:\n  rows: 1\n  cols: {len(terms)}\n  data: {terms}\n"
            "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
        )
        if model == "plumb_bob":
            expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), K, np.array(terms))[0][:, 0]
        else:
            zeros = np.zeros(3)
            expected = cv2.fisheye.projectPoints(RAYS[:, None], zeros, zeros, K, np.array(terms))[0][:, 0]
        found = projected(read_calibration(path, WIDTH, HEIGHT), RAYS)
        np.testing.assert_allclose(found, expected, atol=1e-9)

    @pytest.mark.parametrize(
        ("entry", "problem"),
        [
            ("lens_distortion: [-0.3, 0.1, 0, 0]", "'lens_distortion' is not known here"),
            ("distortion_coefficients: none", "expected numbers"),
            ("distortion_coefficients:", "expected numbers"),
            ("distortion_coefficients: {rows: 2, cols: 2, data: [0.1]}", "expected numbers"),
            ("distortion_model: division\ndistortion_coefficients: [0.1, 0, 0, 0]", "found 'division'"),
            ("camera_model: omni\ndistortion_coefficients: [0.1, 0, 0, 0]", "camera_model: found 'omni'"),
            ("camera_model: {type: omni}\ndistortion_coefficients: [0.1, 0, 0, 0]", "found 'omni'"),
            ("camera_model: {type: pinhole, k1: 0.1}", "'k1' is distortion"),
            ("distortion_model: standard\ndistortion_coefficients: [0.1, 0, 0, 0]", "such as pinhole"),
            ("fisheye_model: maybe\ndistortion_coefficients: [0.1, 0, 0, 0]", "fisheye_model: found 'maybe'"),
            (
                "distortion_model: none\ndistortion_coefficients: [0.1, 0, 0, 0]",
                "found 'none', but dist",
            ),
            (
                "fisheye: false\ndistortion_model: equidistant\ndistortion_coefficients: [0.1, 0, 0, 0]",
                "found 'equidistant', a fisheye, but fisheye is False",
            ),
        ],
    )
    def test_distortion_that_cannot_be_read_is_refused(self, tmp_path, entry, problem) -> None:
        path = tmp_path / "scope.yml"
        path.write_text(f"camera_matrix: {K.tolist()}\n{entry}\n")
        with pytest.raises(SourceError, match=problem):
            read_calibration(path, WIDTH, HEIGHT)

    def test_fisheye(self, tmp_path) -> None:
        terms = [0.03, -0.01, 0.004, -0.001]
        lens = read_calibration(opencv_file(tmp_path / "a.yml", terms, fisheye=True), WIDTH, HEIGHT)
        expected = cv2.fisheye.projectPoints(RAYS[:, None], np.zeros(3), np.zeros(3), K, np.array(terms))[0]
        np.testing.assert_allclose(projected(lens, RAYS), expected[:, 0], atol=1e-9)

    @pytest.mark.parametrize(
        "told",
        [
            {"fisheye_model": "true"},
            {"fisheye_model": 1.0},
            {"fisheye": True},
            {"camera_model": "fisheye"},
            {"model": "OPENCV_FISHEYE"},
            {"camera_model": "pinhole", "distortion_model": "Kannala-Brandt"},
        ],
    )
    def test_a_fisheye_by_other_names(self, tmp_path, told) -> None:
        """Its terms would be taken for radial and tangential ones, pixels beside the right place."""
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [0.03, -0.01, 0.004, -0.001]}
        (tmp_path / "a.json").write_text(json.dumps({**content, "fisheye_model": 1}))
        (tmp_path / "b.json").write_text(json.dumps({**content, **told}))
        expected = read_calibration(tmp_path / "a.json", WIDTH, HEIGHT)
        assert expected.model == "OPENCV_FISHEYE"
        assert read_calibration(tmp_path / "b.json", WIDTH, HEIGHT) == expected

    @pytest.mark.parametrize(
        "told",
        [
            *({"camera_model": name} for name in ("Olympus CF-H190", 3, "standard", [], {"type": "pinhole"})),
            *({"camera_model": name} for name in ("rational", "Pinhole + Brown", "pinhole-radtan")),
            *({"fisheye_model": nothing} for nothing in ("", "none", None)),
        ],
        ids=str,
    )
    def test_free_text_does_not_stand_in_the_way(self, tmp_path, told) -> None:
        """Makers and calibration programs write what they like; the coefficients are those of OpenCV."""
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [-0.2, 0.05, 0, 0, 0]}
        (tmp_path / "a.json").write_text(json.dumps(content | told))
        assert read_calibration(tmp_path / "a.json", WIDTH, HEIGHT).model == "FULL_OPENCV"

    def test_a_fisheye_within_an_entry(self, tmp_path) -> None:
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [0.03, -0.01, 0, 0]}
        for name in ({"projection": "pinhole", "type": "equidistant"}, "pinhole-equi"):
            (tmp_path / "a.json").write_text(json.dumps({**content, "camera_model": name}))
            assert read_calibration(tmp_path / "a.json", WIDTH, HEIGHT).model == "OPENCV_FISHEYE"

    def test_what_is_not_about_the_lens_is_passed_over(self, tmp_path) -> None:
        (tmp_path / "a.yml").write_text(
            f"camera_matrix: {K.tolist()}\ndistance_to_board: 5\nworking_distance_mm: 20\n"
            "model: Olympus GIF-H190\ndistortion_model: plumb_bob\nlens_distortion: [0, 0.0]\n"
        )
        assert read_calibration(tmp_path / "a.yml", WIDTH, HEIGHT).is_pinhole

    def test_ros_calls_a_camera_cam0(self, tmp_path) -> None:
        """Which is Kalibr's name for the first one."""
        (tmp_path / "a.yaml").write_text(
            f"camera_name: cam0\ncamera_matrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}\n"
            "distortion_model: plumb_bob\ndistortion_coefficients: [0.1, 0, 0, 0, 0]\n"
        )
        assert read_calibration(tmp_path / "a.yaml", WIDTH, HEIGHT).model == "FULL_OPENCV"

    def test_no_distortion_is_a_pinhole(self, tmp_path) -> None:
        lens = read_calibration(opencv_file(tmp_path / "a.yml", [0.0] * 5), WIDTH, HEIGHT)
        assert isinstance(lens, Lens)
        assert lens.is_pinhole
        np.testing.assert_allclose(lens.K[:2, 2], [83.5, 61.0])

    @pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
    def test_points_that_lie_beside_the_camera(self, tmp_path, suffix) -> None:
        """OpenCV's own calibration writes them, with two and three numbers in an entry."""
        terms = [-0.2, 0.05, 0, 0, 0]
        plain = opencv_file(tmp_path / f"plain.{suffix}", terms)
        file = opencv_file(tmp_path / f"scope.{suffix}", terms, points=True)
        assert "2f" in file.read_text()
        assert read_calibration(file, WIDTH, HEIGHT) == read_calibration(plain, WIDTH, HEIGHT)

    def test_images_of_another_size(self, tmp_path) -> None:
        file = opencv_file(tmp_path / "a.yml", [-0.2, 0.05, 0, 0])
        small, large = (read_calibration(file, s * WIDTH, s * HEIGHT) for s in (1, 2))
        np.testing.assert_allclose(projected(large, RAYS) + 0.5, 2 * (projected(small, RAYS) + 0.5))
        with pytest.raises(SourceError, match="for 160 x 128 pixels; an image of 160 x 90"):
            read_calibration(file, 160, 90)
        assert read_calibration(opencv_file(file, [0.1, 0, 0, 0], sized=False), 320, 200).width == 320

    @pytest.mark.parametrize(
        ("content", "problem"),
        [
            ("camera_matrix: [1, 2", "calibration"),
            ("%YAML:1.0\n---\ncamera_matrix: 3\n", "camera_matrix"),
            ("just words", "no calibration recognised"),
        ],
    )
    def test_damaged(self, tmp_path, content, problem) -> None:
        (tmp_path / "a.yml").write_text(content)
        with pytest.raises(SourceError, match=problem):
            read_calibration(tmp_path / "a.yml", WIDTH, HEIGHT)

    @pytest.mark.parametrize(
        "told",
        [
            f"image_size: [{WIDTH}, {HEIGHT}]\n",
            f"imageSize: [{WIDTH}, {HEIGHT}]\n",
            f"imageWidth: {WIDTH}\nimageHeight: {HEIGHT}\n",
        ],
    )
    def test_sizes_by_other_names(self, tmp_path, told) -> None:
        """Of a file whose size is passed over, images of half the size would get the camera of the whole."""
        file = opencv_file(tmp_path / "a.yml", [-0.2, 0.05, 0, 0])
        expected = read_calibration(file, WIDTH // 2, HEIGHT // 2)
        text = opencv_file(file, [-0.2, 0.05, 0, 0], sized=False).read_text()
        file.write_text(f"\ufeff{text}{told}", encoding="utf-8")
        assert read_calibration(file, WIDTH // 2, HEIGHT // 2) == expected

    def test_half_a_size(self, tmp_path) -> None:
        file = opencv_file(tmp_path / "a.yml", [-0.2, 0.05, 0, 0], sized=False)
        file.write_text(f"{file.read_text()}image_width: {WIDTH}\n")
        with pytest.raises(SourceError, match=r"field image_width, image_height: found .*expected 2 finite"):
            read_calibration(file, WIDTH, HEIGHT)

    def test_terms_that_stand_by_themselves(self, tmp_path) -> None:
        """They were passed over: a pinhole, without a word."""
        text = f"camera_matrix: {K.tolist()}\n"
        (tmp_path / "a.yml").write_text(f"{text}k1: 0.0\np2: 0\n")
        assert read_calibration(tmp_path / "a.yml", WIDTH, HEIGHT).is_pinhole
        (tmp_path / "a.yml").write_text(f"{text}k1: -0.2\n")
        with pytest.raises(SourceError, match=r"field distortion_coefficients: .*'k1' is not known here"):
            read_calibration(tmp_path / "a.yml", WIDTH, HEIGHT)

    def test_terms_that_are_not_known(self, tmp_path) -> None:
        with pytest.raises(SourceError, match="thin-prism and tilt terms"):
            read_calibration(opencv_file(tmp_path / "a.yml", [0.1] * 12), WIDTH, HEIGHT)
        with pytest.raises(SourceError, match=r"3 numbers; expected 0, 4, 5, 8, 12, 14"):
            read_calibration(opencv_file(tmp_path / "b.yml", [0.1] * 3), WIDTH, HEIGHT)
        with pytest.raises(SourceNotFoundError, match="no such calibration file"):
            read_calibration(tmp_path / "none.yml", WIDTH, HEIGHT)


class TestKalibr:
    @pytest.mark.parametrize(
        ("model", "terms"),
        [("radtan", [-0.2, 0.05, 0.002, -0.001]), ("equidistant", [0.03, -0.01, 0.004, -0.001])],
    )
    def test_projection(self, tmp_path, model, terms) -> None:
        lens = read_calibration(kalibr_file(tmp_path / "camchain.yaml", model, terms), WIDTH, HEIGHT)
        if model == "radtan":
            expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), K, np.array(terms))[0][:, 0]
        else:
            coefficients = np.array(terms)
            expected = cv2.fisheye.projectPoints(RAYS[:, None], np.zeros(3), np.zeros(3), K, coefficients)[0]
            expected = expected[:, 0]
        np.testing.assert_allclose(projected(lens, RAYS), expected, atol=1e-9)

    def test_field_of_view_model_and_none(self, tmp_path) -> None:
        lens = read_calibration(kalibr_file(tmp_path / "a.yaml", "fov", [0.9]), WIDTH, HEIGHT)
        assert isinstance(lens, Lens)
        assert lens.model == "FOV"
        plain = read_calibration(kalibr_file(tmp_path / "b.yaml", "none", []), WIDTH, HEIGHT)
        assert isinstance(plain, Lens)
        assert plain.is_pinhole

    def test_what_is_not_known(self, tmp_path) -> None:
        with pytest.raises(SourceError, match="found 'omni'; expected none, radtan"):
            read_calibration(kalibr_file(tmp_path / "a.yaml", "omni", [1.0]), WIDTH, HEIGHT)
        with pytest.raises(SourceError, match="expected 4 finite numbers"):
            read_calibration(kalibr_file(tmp_path / "b.yaml", "radtan", [1.0]), WIDTH, HEIGHT)


class TestScaramuzza:
    def test_rays_are_the_toolboxs(self, tmp_path) -> None:
        """cam2world of the toolbox's C code: rows and columns, z backwards."""
        (tmp_path / "calib_results.txt").write_text(OCAMCALIB)
        camera = read_calibration(tmp_path / "calib_results.txt", WIDTH, HEIGHT)
        assert isinstance(camera, ScaramuzzaCamera)
        c, d, e = 0.9985, 0.0012, -0.0021
        rng = np.random.default_rng(0)
        row, column = rng.uniform(20, 110, 40), rng.uniform(20, 140, 40)
        x = (row - 62.25 - d * (column - 78.5)) / (c - d * e)
        y = (-e * (row - 62.25) + c * (column - 78.5)) / (c - d * e)
        z = np.polyval([8.0e-09, -2.1e-06, 1.3e-03, 0, -9.1e01], np.hypot(x, y))
        expected = np.column_stack([y, x, -z])
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(camera.rays(np.column_stack([column, row])), expected, atol=1e-12)

    def test_other_degrees(self, tmp_path) -> None:
        (tmp_path / "a.txt").write_text(OCAMCALIB.replace(" 5 -9.1e+01", " 6 -9.1e+01 0"))
        with pytest.raises(SourceError, match="6 coefficients; expected 5"):
            read_calibration(tmp_path / "a.txt", WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def plain_frames(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(0)
    for index in range(4):
        small = rng.integers(40, 255, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
        image = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        Image.fromarray(image).save(folder / f"{index}.png")
    return folder


class TestPlainFrames:
    def test_without_it_they_are_guessed(self, plain_frames) -> None:
        sequence = read(plain_frames)
        assert sequence.intrinsics == "guessed"
        assert sequence.K[0, 0, 0] == pytest.approx(WIDTH / 2)

    def test_with_it_they_are_given_and_straight(self, plain_frames, tmp_path, caplog) -> None:
        file = opencv_file(tmp_path / "scope.yml", [-0.2, 0.03, 0.0, 0.0])
        sequence = read(plain_frames, IngestConfig(calibration=str(file)))
        assert sequence.intrinsics == "given"
        assert "assuming a horizontal field of view" not in caplog.text
        assert sequence.K[0, 0, 0] == pytest.approx(np.sqrt(110.0 * 113.0))
        assert (sequence.rgb != read(plain_frames).rgb).any()

    def test_scaramuzzas_too(self, plain_frames, tmp_path) -> None:
        (tmp_path / "calib_results.txt").write_text(OCAMCALIB)
        config = IngestConfig(calibration=str(tmp_path / "calib_results.txt"))
        sequence = read(plain_frames, config)
        assert (sequence.width, sequence.height) == (WIDTH, HEIGHT)
        assert sequence.K[0, 0, 0] == pytest.approx(0.9985 * 91.0)
        assert sequence.intrinsics == "given"

    def test_content_counts_and_not_the_path(self, plain_frames, tmp_path) -> None:
        terms = [-0.2, 0.03, 0.0, 0.0]
        first = opencv_file(tmp_path / "a.yml", terms)
        (tmp_path / "other").mkdir()
        second = opencv_file(tmp_path / "other" / "b.yml", terms)

        def key(file: Path) -> str:
            return json.dumps(source_fingerprint(resolve(plain_frames), IngestConfig(calibration=str(file))))

        assert key(first) == key(second)
        before = key(first)
        opencv_file(first, [-0.21, *terms[1:]])
        assert key(first) != before
        assert "calibration" not in source_fingerprint(plain_frames)
        with pytest.raises(SourceNotFoundError, match="no such calibration file"):
            key(tmp_path / "none.yml")

    def test_what_a_reader_does_not_foresee_is_an_error_of_the_source(
        self, plain_frames, tmp_path, monkeypatch
    ) -> None:
        """As without a calibration file."""

        def stumbles(*_: object) -> None:
            raise KeyError("entry")

        config = IngestConfig(calibration=str(opencv_file(tmp_path / "a.yml", [0.1, 0, 0, 0])))
        found = resolve(plain_frames)
        monkeypatch.setattr(
            "data_catalog.folders._registered", [replace(frames_folder.READER, frames=stumbles)]
        )
        with pytest.raises(SourceError, match=r"its content is not understood \(KeyError: 'entry'\)"):
            read(found, config)

    @pytest.mark.parametrize(
        "stated", ['{"field_of_view_deg": 80}', '{"fx": 90, "k1": -0.3}', '{"fx": 90}', "[damaged"]
    )
    def test_it_takes_the_place_of_intrinsics_beside_the_frames(self, plain_frames, tmp_path, stated) -> None:
        """Of a lens with distortion, the advice was this setting, and the same error came again."""
        config = IngestConfig(calibration=str(opencv_file(tmp_path / "a.yml", [0.1, 0, 0, 0])))
        expected = read(plain_frames, config).K
        file = plain_frames / "intrinsics.json"
        file.write_text(stated)
        try:
            found = read(plain_frames, config)
            assert glance(plain_frames, config).width == WIDTH
        finally:
            file.unlink()
        assert found.intrinsics == "given"
        np.testing.assert_array_equal(found.K, expected)

    def test_not_for_a_source_that_states_its_intrinsics(self, tmp_path) -> None:
        config = IngestConfig(calibration=str(opencv_file(tmp_path / "a.yml", [0.1, 0, 0, 0])))
        with pytest.raises(ConfigError, match="phantom/3@sparse states its intrinsics itself"):
            read("phantom/3@sparse", config)

    @pytest.mark.parametrize("write", [write_transforms, write_colmap, write_endonerf])
    def test_not_for_a_source_whose_poses_were_solved_with_its_own(self, clip, tmp_path, write) -> None:
        write(clip, tmp_path / "source")
        file = opencv_file(tmp_path / "a.yml", [0.1, 0, 0, 0], sized=False)
        for look in (read, glance):
            with pytest.raises(ConfigError, match=r"states its intrinsics itself\. Its poses were solved"):
                look(tmp_path / "source", IngestConfig(calibration=str(file)))


class TestInPlaceOfStatedIntrinsics:
    def test_of_poses_json(self, posed_folder, tmp_path) -> None:
        """It was refused, though a tracker's poses do not depend on the lens."""
        stated = read(posed_folder)
        other = stated.K[0] * [[1.05], [1.05], [1]] - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        file = tmp_path / "scope.json"
        file.write_text(json.dumps({"camera_matrix": other.tolist()}))
        config = IngestConfig(calibration=str(file))
        found = read(posed_folder, config)
        assert found.intrinsics == "given"
        np.testing.assert_allclose(found.K[:, 0, 0], 1.05 * stated.K[:, 0, 0])
        np.testing.assert_array_equal(found.world_from_camera, stated.world_from_camera)
        (finding,) = [item for item in inspect(posed_folder, config).findings if item.topic == "calibration"]
        focal = stated.K[0, 0, 0]
        told = f"focal length {focal:.1f} px there and {1.05 * focal:.1f} px in the file"
        assert f"scope.json, takes the place of the intrinsics stated there: {told}" in finding.sentence
        # The lower right corner is twice as far from the first pixel as the principal point.
        corner = 0.05 * np.hypot(*stated.K[0, :2, 2])
        median, most = re.findall(r"([\d.]+) px", finding.sentence)[-2:]
        assert float(most) == pytest.approx(2 * corner, rel=0.05)
        assert 0 < float(median) < corner * 2

    @pytest.mark.parametrize("kind", ["fisheye", "scaramuzza"])
    def test_of_another_kind(self, posed_folder, tmp_path, kind) -> None:
        if kind == "fisheye":
            content = {"camera_matrix": read(posed_folder).K[0].tolist()}
            file = tmp_path / "scope.json"
            file.write_text(json.dumps({**content, "distortion_coefficients": [0.1, 0, 0, 0], "fisheye": 1}))
        else:
            file = tmp_path / "calib_results.txt"
            file.write_text(OCAMCALIB.replace("128 160", "40 48").replace("62.25 78.5", "20 24"))
        config = IngestConfig(calibration=str(file))
        (finding,) = [item for item in inspect(posed_folder, config).findings if item.topic == "calibration"]
        assert "px apart in the median over the image" in finding.sentence
