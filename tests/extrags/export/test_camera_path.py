"""Camera paths: the layout of nerfstudio's viewer, read and written."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags.cameras import Cameras
from extrags.errors import ShapeError, SourceError, SourceNotFoundError
from extrags.export import CameraPath, flight_through, read_camera_path, write_camera_path
from tests.extrags.lit_tube import tube_cameras


def written(tmp_path: Path, cameras: Cameras, fps: float = 24.0) -> tuple[Path, dict[str, Any]]:
    file = tmp_path / "path.json"
    write_camera_path(CameraPath(cameras, fps), file)
    return file, json.loads(file.read_text())


def test_it_comes_back(tmp_path: Path) -> None:
    cameras = tube_cameras(5)
    file, _ = written(tmp_path, cameras, 12.5)
    back = read_camera_path(file)
    np.testing.assert_allclose(back.cameras.world_from_camera, cameras.world_from_camera, atol=1e-12)
    np.testing.assert_allclose(back.cameras.K, cameras.K)
    assert (back.cameras.width, back.cameras.height, back.fps) == (cameras.width, cameras.height, 12.5)


def test_axes_and_field_of_view_as_other_programs_read_them(tmp_path: Path) -> None:
    """OpenGL: a point in front of the camera has negative z, one above it positive y."""
    cameras = tube_cameras(3)
    _, content = written(tmp_path, cameras)
    assert content["camera_type"] == "perspective"
    assert content["seconds"] == pytest.approx(3 / 24)
    for index, entry in enumerate(content["camera_path"]):
        matrix = np.array(entry["camera_to_world"]).reshape(4, 4)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        pixel = np.array([50.0, 10.0])
        point = matrix @ np.array(
            [
                (pixel[0] - content["render_width"] / 2),
                -(pixel[1] - content["render_height"] / 2),
                -content["render_height"] / 2 / math.tan(math.radians(entry["fov"]) / 2),
                1,
            ]
        )
        found, depth = cameras[index].project(point[None, :3])
        np.testing.assert_allclose(found[0, 0], pixel, atol=1e-6)
        assert depth[0, 0] > 0


def test_a_path_of_another_program_has_no_intrinsics(tmp_path: Path) -> None:
    cameras = tube_cameras(2)
    file, content = written(tmp_path, cameras)
    for entry in content["camera_path"]:
        del entry["K"]
    del content["fps"], content["camera_type"]
    file.write_text(json.dumps(content))
    back = read_camera_path(file)
    np.testing.assert_allclose(back.cameras.K, cameras.K, rtol=1e-9)
    assert back.fps == 24.0


def test_a_mark_of_an_editor_is_no_content(tmp_path: Path) -> None:
    file, _ = written(tmp_path, tube_cameras(2))
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert len(read_camera_path(file).cameras) == 2


def test_a_flight_cuts_between_its_parts() -> None:
    first, second = tube_cameras(3), tube_cameras(2, start_mm=40.0)
    flight = flight_through([first, second], 4)
    assert len(flight) == 9 + 5
    steps = np.linalg.norm(np.diff(flight.centers, axis=0), axis=1)
    assert int(steps.argmax()) == 8
    assert np.delete(steps, 8).max() < 2
    with pytest.raises(ShapeError):
        flight_through([first, second.resized(32, 24)], 1)


class TestRefused:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"render_width": 0}, "field render_width"),
            ({"render_width": 1e400}, "no camera path"),
            (
                {"camera_type": "equirectangular"},
                r"field camera_type: .equirectangular.; expected perspective",
            ),
            ({"camera_type": "fisheye"}, "field camera_type"),
            ({"camera_type": None}, "field camera_type"),
            ({"camera_path": []}, "0 cameras"),
            ({"camera_path": {}}, "no list"),
            ({"camera_path": [{"fov": 50}]}, "frame 0, field camera_to_world: the field is missing"),
            ({"camera_path": [{"camera_to_world": 16 * [1]}]}, "frame 0, field fov: the field is missing"),
            ({"camera_path": [3]}, "frame 0, field camera_path"),
            ({"camera_path": [{"camera_to_world": [1.0] * 16, "fov": 50}]}, "frame 0"),
            ({"camera_path": [{"camera_to_world": np.eye(4).tolist(), "fov": 0}]}, "frame 0"),
            ({"fps": 0}, "0 frames per second"),
        ],
    )
    def test_wrong_content(self, change: dict[str, Any], message: str, tmp_path: Path) -> None:
        file, content = written(tmp_path, tube_cameras(2))
        file.write_text(json.dumps({**content, **change}))
        with pytest.raises(SourceError, match=message):
            read_camera_path(file)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"fov": 180}, "frame 1, field fov: a field of view of 180 degrees"),
            ({"fov": -20}, "frame 1, field fov"),
            ({"fov": math.nan}, "frame 1, field fov"),
            ({"K": [[60, 0, 32], [0, 60, 24], [0, 0, 7]]}, r"frame 1, field K: expected \[\[fx, 0, cx\]"),
            ({"K": [[60, 5, 32], [0, 60, 24], [0, 0, 1]]}, "frame 1, field K"),
            ({"K": [[-60, 0, 32], [0, 60, 24], [0, 0, 1]]}, "frame 1, field K: focal length fx = -60"),
            ({"camera_to_world": [*np.eye(4)[:3].ravel(), 9, 9, 9, 9]}, "frame 1, field camera_to_world"),
            ({"camera_to_world": (2 * np.eye(4)).ravel().tolist()}, "frame 1, field camera_to_world"),
            ({"camera_to_world": [math.inf] * 16}, "frame 1, field camera_to_world"),
        ],
    )
    def test_cameras_that_there_are_not(self, change: dict[str, Any], message: str, tmp_path: Path) -> None:
        file, content = written(tmp_path, tube_cameras(2))
        entry = content["camera_path"][1]
        if "fov" in change:
            del entry["K"]
        entry.update(change)
        file.write_text(json.dumps(content))
        with pytest.raises(SourceError, match=message):
            read_camera_path(file)

    @pytest.mark.parametrize("text", ["", "[]", "3", '{"camera_path": 1}', "\x00"])
    def test_other_files(self, text: str, tmp_path: Path) -> None:
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(SourceError, match="no camera path"):
            read_camera_path(tmp_path / "a.json")

    def test_another_json_lacks_a_field(self, tmp_path: Path) -> None:
        (tmp_path / "results.json").write_text('{"seconds": 3, "sequences": []}')
        with pytest.raises(SourceError, match="field render_width: no camera path: the field is missing"):
            read_camera_path(tmp_path / "results.json")

    def test_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(SourceNotFoundError):
            read_camera_path(tmp_path / "none.json")
