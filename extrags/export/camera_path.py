"""Camera paths as JSON in the layout of nerfstudio's viewer, which its `ns-render camera-path` takes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from extrags.cameras import Cameras
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.output_files import write_file
from extrags.sequence_checks import check_intrinsics, check_pose

__all__ = ["CameraPath", "flight_through", "read_camera_path", "write_camera_path"]

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_PINHOLE = "perspective"
"""As the layout calls it; others are `fisheye` and `equirectangular`."""
_WIDEST_FOV_DEG = 179.0
_LARGEST_SIDE_PX = 8192
_LARGEST_COUNT = 100_000


@dataclass(frozen=True)
class CameraPath:
    """Cameras to be flown along.

    Args:
        cameras: every frame of the flight.
        fps: frames per second.
    """

    cameras: Cameras
    fps: float = 24.0


def flight_through(parts: Sequence[Cameras], steps: int) -> Cameras:
    """One flight through all cameras of each part; from one part to the next it cuts.

    Args:
        parts: of one image size, e.g. the recordings of a scene, or virtual trajectories.
        steps: from each camera to the next of its part; 1 takes the cameras themselves.

    Raises:
        ShapeError: when the image sizes differ.
    """
    return Cameras.concatenated([part.interpolated(steps) for part in parts])


def write_camera_path(path: CameraPath, file: Path) -> None:
    """Write every camera with its matrix (OpenGL axes: x right, y up, z backward) and field of view.

    The layout knows a vertical field of view alone, no principal point and no second focal length; exact
    intrinsics stand beside it as `K`, which other programs skip and `read_camera_path` reads.
    """
    cameras = path.cameras
    entries = [
        {
            "camera_to_world": (pose @ _OPENGL).flatten().tolist(),
            "fov": math.degrees(2 * math.atan(cameras.height / 2 / K[1, 1])),
            "aspect": cameras.width / cameras.height,
            "K": K.tolist(),
        }
        for pose, K in zip(cameras.world_from_camera, cameras.K, strict=True)
    ]
    content = {
        "camera_type": _PINHOLE,
        "render_width": cameras.width,
        "render_height": cameras.height,
        "fps": path.fps,
        "seconds": len(cameras) / path.fps,
        "camera_path": entries,
    }
    write_file(file, json.dumps(content, indent=1) + "\n")


def read_camera_path(file: Path) -> CameraPath:
    """Read a camera path, of nerfstudio's viewer or of `write_camera_path`.

    Raises:
        SourceNotFoundError: when there is no such file.
        SourceError: when it is no camera path, its cameras are no pinholes (`camera_type` other than
            perspective), or a number in it is wrong; names the camera.
        PoseError: when a matrix is no rigid motion.
    """
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file)
    try:
        # Editors on Windows put a mark at the beginning.
        content = json.loads(file.read_text(encoding="utf-8-sig"))
        width, height = int(content["render_width"]), int(content["render_height"])
        fps = float(content.get("fps", 24.0))
        kind = content.get("camera_type", _PINHOLE)
        entries = content["camera_path"]
        if not isinstance(entries, list):
            raise TypeError("camera_path is no list")
    except KeyError as error:
        raise SourceError("no camera path: the field is missing", file=file, field=error.args[0]) from error
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise SourceError(f"no camera path: {error}", file=file) from error
    if kind != _PINHOLE:
        raise SourceError(
            f"{json.dumps(kind)[:80]}; expected {_PINHOLE}: other cameras are not rendered",
            file=file,
            field="camera_type",
        )
    if not (0 < width <= _LARGEST_SIDE_PX and 0 < height <= _LARGEST_SIDE_PX):
        raise SourceError(f"images of {width} x {height} pixels", file=file, field="render_width")
    if not 0 < len(entries) <= _LARGEST_COUNT:
        raise SourceError(f"{len(entries)} cameras", file=file, field="camera_path")
    if not 0.1 <= fps <= 1000:
        raise SourceError(f"{fps:g} frames per second; expected 0.1 to 1000", file=file, field="fps")
    read = [_camera(entry, index, width, height, file) for index, entry in enumerate(entries)]
    K, poses = zip(*read, strict=True)
    return CameraPath(Cameras(np.stack(K), np.stack(poses), width, height), fps)


def _camera(entry: Any, index: int, width: int, height: int, file: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        matrix = np.array(entry["camera_to_world"], dtype=np.float64).reshape(4, 4)
        given = np.array(entry["K"], dtype=np.float64).reshape(3, 3) if "K" in entry else None
        fov_deg = float(entry["fov"]) if given is None else math.nan
    except KeyError as error:
        raise SourceError("the field is missing", file=file, frame=index, field=error.args[0]) from error
    except (ValueError, TypeError, OverflowError) as error:
        raise SourceError(str(error), file=file, frame=index, field="camera_path") from error
    if given is None:
        if not 0 < fov_deg < _WIDEST_FOV_DEG:
            raise SourceError(
                f"a field of view of {fov_deg:g} degrees; expected more than 0 and less than "
                f"{_WIDEST_FOV_DEG:g}",
                file=file,
                frame=index,
                field="fov",
            )
        focal = height / 2 / math.tan(math.radians(fov_deg) / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    else:
        check_intrinsics(given, width, height, frame=index, file=file)
        K = given
    try:
        return K, check_pose(matrix, frame=index, file=file) @ _OPENGL
    except PoseError as error:
        raise PoseError(error.problem, file=file, frame=index, field="camera_to_world") from error
