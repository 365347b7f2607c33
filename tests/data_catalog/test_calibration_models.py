"""Calibration files of other models than a pinhole with distortion, and of several cameras."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from data_catalog import read
from data_catalog.calibration_files import read_calibration
from data_catalog.readers import frames_folder
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.lens import Lens
from tests.data_catalog.test_calibration_files import HEIGHT, WIDTH, K, kalibr_file, opencv_file


class TestOtherModels:
    """Lenses whose terms would be taken for those of a pinhole with distortion."""

    @pytest.mark.parametrize(
        "told",
        [
            {"xi": 1.2},
            {"xi": {"rows": 1, "cols": 1, "data": [1.2]}},
            {"mirror_parameters": {"xi": 1.2}},
            {"xi": 1.2, "camera_model": {"type": "pinhole"}},
        ],
        ids=str,
    )
    def test_a_mirror_is_refused(self, tmp_path, told) -> None:
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [-0.05, 0.02, 0, 0]}
        (tmp_path / "a.json").write_text(json.dumps({**content, **told}))
        with pytest.raises(SourceError, match="unified omnidirectional model") as caught:
            read_calibration(tmp_path / "a.json", WIDTH, HEIGHT)
        assert caught.value.field == next(iter(told))
        assert caught.value.file == str(tmp_path / "a.json")

    def test_within_the_entry_of_the_model(self, tmp_path) -> None:
        content = {"camera_matrix": K.tolist(), "camera_model": {"type": "pinhole", "xi": 1.2}}
        (tmp_path / "a.json").write_text(json.dumps(content))
        with pytest.raises(SourceError, match=r"field xi: .*unified omnidirectional model"):
            read_calibration(tmp_path / "a.json", WIDTH, HEIGHT)

    def test_in_opencvs_own_files(self, tmp_path) -> None:
        file = opencv_file(tmp_path / "a.xml", [-0.05, 0.02, 0, 0])
        file.write_text(file.read_text().replace("</opencv_storage>", "<xi>1.2</xi></opencv_storage>"))
        with pytest.raises(SourceError, match=r"unified omnidirectional model"):
            read_calibration(file, WIDTH, HEIGHT)

    def test_without_a_mirror_it_is_a_pinhole(self, tmp_path) -> None:
        """With a parameter of zero the model is that of OpenCV's pinhole."""
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [-0.05, 0.02, 0, 0]}
        (tmp_path / "a.json").write_text(json.dumps({**content, "xi": 0.0, "mirror_parameters": {"xi": 0}}))
        assert read_calibration(tmp_path / "a.json", WIDTH, HEIGHT).model == "OPENCV"

    @pytest.mark.parametrize("name", ["calibration_model", "lens_model", "projection_model"])
    def test_names_of_the_model(self, tmp_path, name) -> None:
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [0.03, -0.01, 0.004, -0.001]}
        file = tmp_path / "a.json"
        file.write_text(json.dumps({**content, name: "fisheye"}))
        assert read_calibration(file, WIDTH, HEIGHT).model == "OPENCV_FISHEYE"
        file.write_text(json.dumps({**content, name: {"type": "fisheye", "version": 2}}))
        assert read_calibration(file, WIDTH, HEIGHT).model == "OPENCV_FISHEYE"
        file.write_text(json.dumps({**content, name: "pinhole"}))
        assert read_calibration(file, WIDTH, HEIGHT).model == "OPENCV"
        for other in ("orthographic", "omnidir", "MEI"):
            file.write_text(json.dumps({**content, name: other}))
            with pytest.raises(SourceError, match=f"field {name}: found '{other}'"):
                read_calibration(file, WIDTH, HEIGHT)

    def test_a_product_is_no_model(self, tmp_path) -> None:
        content = {"camera_matrix": K.tolist(), "distortion_coefficients": [-0.2, 0.05, 0, 0]}
        file = tmp_path / "a.json"
        file.write_text(json.dumps({**content, "lens_model": "Olympus WA50013A"}))
        assert read_calibration(file, WIDTH, HEIGHT).model == "OPENCV"
        for name in ("calibration_model", "projection_model"):
            file.write_text(json.dumps({**content, name: "mapping 7"}))
            with pytest.raises(SourceError, match=f"field {name}: found 'mapping 7'"):
                read_calibration(file, WIDTH, HEIGHT)

    @pytest.mark.parametrize(
        ("told", "problem"),
        [
            ({"xi": 1.2}, "field xi: .*unified omnidirectional model"),
            ({"projection_model": "fisheye"}, "field projection_model: .*expected a pinhole"),
            ({"lens_model": "opencv_fisheye"}, "field lens_model: .*expected a pinhole"),
            ({"calibration_model": "something"}, "field calibration_model: .*expected a pinhole"),
        ],
    )
    def test_beside_plain_frames(self, tmp_path, told, problem) -> None:
        (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K.tolist(), **told}))
        with pytest.raises(SourceError, match=problem):
            frames_folder.read_intrinsics(tmp_path, WIDTH, HEIGHT)
        (tmp_path / "intrinsics.json").write_text(
            json.dumps({"K": K.tolist(), "xi": 0, next(iter(told)): None})
        )
        np.testing.assert_array_equal(frames_folder.read_intrinsics(tmp_path, WIDTH, HEIGHT), K)


class TestSeveralCameras:
    @pytest.fixture
    def camchain(self, tmp_path) -> Path:
        file = kalibr_file(tmp_path / "camchain.yaml", "none", [])
        second = kalibr_file(tmp_path / "other.yaml", "none", []).read_text()
        file.write_text(file.read_text() + second.replace("cam0", "cam1").replace("110.0", "120.0"))
        return file

    @pytest.mark.parametrize(("camera", "focal_px"), [(None, 110), ("left", 110), ("right", 120)])
    def test_the_one_that_is_meant(self, camchain, camera, focal_px) -> None:
        lens = read_calibration(camchain, WIDTH, HEIGHT, camera=camera)
        assert isinstance(lens, Lens)
        assert lens.K[0, 0] == focal_px

    def test_one_alone_is_the_one(self, tmp_path) -> None:
        file = kalibr_file(tmp_path / "camchain.yaml", "none", [])
        assert read_calibration(file, WIDTH, HEIGHT, camera="right").K[0, 0] == 110  # type: ignore[union-attr]

    @pytest.mark.parametrize("camera", ["left", "right", None])
    def test_of_a_source(self, tmp_path, monkeypatch, camchain, caplog, camera) -> None:
        wide = np.random.default_rng(0).integers(40, 255, (HEIGHT, WIDTH + 20, 3)).astype(np.uint8)
        places = {"frames": 0} if camera is None else {"left": 6, "right": 0}
        for name, column in places.items():
            (tmp_path / "source" / name).mkdir(parents=True)
            for number in range(4):
                at = column + 2 * number
                image = Image.fromarray(np.ascontiguousarray(wide[:, at : at + WIDTH]))
                image.save(tmp_path / "source" / name / f"{number}.png")
        config = IngestConfig(calibration=str(camchain), stereo_camera=camera or "left")
        usual, reads = Path.read_text, []

        def read_text(file: Path, *given: Any, **more: Any) -> str:
            reads.append(file)
            return usual(file, *given, **more)

        monkeypatch.setattr(Path, "read_text", read_text)
        with caplog.at_level("INFO"):
            found = read(tmp_path / "source" / ("frames" if camera is None else ""), config)
        assert reads.count(camchain) == 1
        assert found.stereo_camera == camera
        assert found.K[0, 0, 0] == pytest.approx(120 if camera == "right" else 110)
        told = [record for record in caplog.records if " is taken" in record.message]
        assert [record.levelname for record in told] == ["WARNING" if camera is None else "INFO"]
        assert ("cam1 is taken" in told[0].message) == (camera == "right")
        if camera is None:
            assert "of cam0, cam1, cam0 is taken" in told[0].message
