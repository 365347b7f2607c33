"""One video's folder, in either of the two layouts it is published in.

C3VDv2::

    rgb/NNNN.png               fisheye, 8 bit
    depth/NNNN_depth.tiff      16-bit z-depth: code / 65535 * 100 mm; 0 and 65535 are no depth
    pose.txt                   one line a frame, 16 numbers: camera to world, mm
    coverage_mesh.obj          the surface in the video's own world
    calibration.json           only in simulated sets: the camera, in place of the published one

C3VD: the same in one flat folder, as `NNNN_color.png` and `NNNN_depth.tiff`. Numbers may lack their leading
zeros (`9_color.png`); they are matched and sorted as numbers.

Axes: OpenCV's camera axes (x right, y down, z forward), camera to world, millimetres; nothing is turned.
The numbers of a pose stand column after column as published, though its documentation calls them row-major;
which it is is read off the place of (0, 0, 0, 1), for the whole file.
"""

from __future__ import annotations

import json
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from data_catalog.c3vd.published import find_recording, published_sets
from data_catalog.c3vd.scaramuzza import CALIBRATIONS, CalibrationName, ScaramuzzaCamera, camera_from_json
from data_catalog.checks import check_pose
from data_catalog.images import read_color, read_depth
from extrags.errors import PoseError, SourceError, SourceNotFoundError

__all__ = [
    "CALIBRATION_FILE",
    "DEPTH_RANGE_MM",
    "POSE_FILE",
    "Layout",
    "Video",
    "decode_depth_mm",
    "is_video",
    "read_depth_mm",
    "read_pose_file",
]

logger = logging.getLogger(__name__)

DEPTH_RANGE_MM = 100.0
"""What the largest code stands for, in both datasets."""
CLIP_CODE = 65535
POSE_FILE = "pose.txt"
CALIBRATION_FILE = "calibration.json"
Layout = Literal["column-major", "row-major"]

# A colon is not a metre long: a translation this far out is in another unit, or not a translation.
_LARGEST_TRANSLATION_MM = 2000.0
_LARGEST_8_BIT_CODE = 255
_FLAT = re.compile(r"(\d+)_color\.png")
_FOLDERED = re.compile(r"(\d+)\.png")
_DEPTH = re.compile(r"(\d+)_depth\.tiff?")


@dataclass(frozen=True)
class Video:
    """What lies in a video's folder, opened but not read.

    Args:
        folder: where it lies.
        numbers: of its frames, as in the file names, ascending without a gap.
        color_files: one per frame.
        depth_files: one per frame, or empty where the video has no depth.
        world_from_camera: of each frame, in mm, [F, 4, 4].
        layout: how the numbers of a pose stand in pose.txt.
        camera: the lens at the size it was calibrated for.
        calibration: where the camera comes from.
        mesh_file: `coverage_mesh.obj`, or None where there is none.
        depth_range_mm: what the largest depth code stands for.
    """

    folder: Path
    numbers: tuple[int, ...]
    color_files: tuple[Path, ...]
    depth_files: tuple[Path, ...]
    world_from_camera: Float[np.ndarray, "f 4 4"]
    layout: Layout
    camera: ScaramuzzaCamera
    calibration: str
    mesh_file: Path | None
    depth_range_mm: float = DEPTH_RANGE_MM

    @classmethod
    def open(
        cls,
        folder: Path,
        *,
        calibration: CalibrationName | None = None,
        depth_range_mm: float = DEPTH_RANGE_MM,
    ) -> Video:
        """Look through a folder and read its poses.

        Args:
            folder: in one of the two layouts.
            calibration: the published camera; None goes by the folder's name where it is a known video's,
                else by its layout (flat: C3VD). `calibration.json`, where there is one, comes before both.
            depth_range_mm: what the largest depth code stands for.

        Raises:
            SourceNotFoundError: a frame, its depth or pose.txt is missing; names it.
            PoseError: see `read_pose_file`; or poses that do not fit the frames.
            SourceError: a calibration that makes no lens, or two files of one frame.
        """
        color = _numbered(folder / "rgb", _FOLDERED, "rgb")
        depth_folder = folder / "depth"
        flat = not color
        if flat:
            color, depth_folder = _numbered(folder, _FLAT, "rgb"), folder
        if not color:
            raise SourceNotFoundError(
                "no frame; expected rgb/NNNN.png (C3VDv2) or NNNN_color.png (C3VD)", file=folder, field="rgb"
            )
        depth = _numbered(depth_folder, _DEPTH, "depth")
        numbers = tuple(sorted(color))
        missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
        if missing:
            like = color[numbers[0]].name.split("_")
            width = len(like[0].removesuffix(".png"))
            wanted = f"{missing[0]:0{width}d}{'_color' if flat else ''}.png"
            more = f", and {len(missing) - 1} more after it" if len(missing) > 1 else ""
            raise SourceNotFoundError(
                f"no such file, though frames before and after it are there{more}",
                file=color[numbers[0]].with_name(wanted),
                frame=missing[0],
                field="rgb",
            )
        without = [number for number in numbers if number not in depth]
        if depth and without:
            raise SourceNotFoundError(
                f"no depth for this frame, though {len(depth)} of {len(numbers)} frames have one",
                file=depth_folder / f"{without[0]:04d}_depth.tiff",
                frame=without[0],
                field="depth",
            )
        if not depth and not flat and depth_folder.is_dir() and any(depth_folder.iterdir()):
            logger.warning(
                "%s is not read: no file in it is called NNNN_depth.tiff",
                depth_folder,
                extra={"topic": "not read", "field": "depth"},
            )
        pose_file = folder / POSE_FILE
        poses, layout = read_pose_file(pose_file)
        mesh = folder / "coverage_mesh.obj"
        camera, origin = _camera(folder, flat, calibration)
        return cls(
            folder=folder,
            numbers=numbers,
            color_files=tuple(color[number] for number in numbers),
            depth_files=tuple(depth[number] for number in numbers) if depth else (),
            world_from_camera=_poses_of_frames(poses, numbers, pose_file),
            layout=layout,
            camera=camera,
            calibration=origin,
            mesh_file=mesh if mesh.is_file() else None,
            depth_range_mm=depth_range_mm,
        )

    def __len__(self) -> int:
        return len(self.numbers)

    def color(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """The fisheye image of a frame, by position."""
        return read_color(self.color_files[index], frame=self.numbers[index])

    def depth_mm(self, index: int) -> Float[np.ndarray, "h w"]:
        """The fisheye's z-depth of a frame, by position; 0 where unknown.

        Raises:
            SourceError: a damaged file, or an 8-bit copy.
        """
        return read_depth_mm(self.depth_files[index], self.numbers[index], self.depth_range_mm)

    def files(self, indices: list[int] | range | None = None) -> list[Path]:
        """Every file that reading these frames looks at, sorted."""
        chosen = range(len(self)) if indices is None else indices
        fixed = [
            self.folder / name
            for name in (POSE_FILE, "coverage_mesh.obj", CALIBRATION_FILE)
            if (self.folder / name).is_file()
        ]
        frames = [self.color_files[k] for k in chosen]
        return sorted([*fixed, *frames, *(self.depth_files[k] for k in chosen if self.depth_files)])


def is_video(folder: Path) -> bool:
    """Whether a folder holds a video of these datasets, from file names only."""
    frames = any(_numbered(folder, _FLAT, "rgb", checked=False)) or any(
        _numbered(folder / "rgb", _FOLDERED, "rgb", checked=False)
    )
    depth = any(_numbered(place, _DEPTH, "depth", checked=False) for place in (folder / "depth", folder))
    poses = (folder / POSE_FILE).is_file()
    return (frames and (poses or depth)) or (poses and (depth or (folder / "coverage_mesh.obj").is_file()))


def read_depth_mm(file: Path, frame: object, depth_range_mm: float) -> Float[np.ndarray, "h w"]:
    """z-depth of a depth file in mm; 0 where unknown.

    Args:
        file: 16-bit codes.
        frame: named in errors.
        depth_range_mm: what the largest code stands for.

    Raises:
        SourceError: a damaged file, or an 8-bit copy.
    """
    code = read_depth(file, frame=frame)
    largest = float(code.max(initial=0))
    if largest <= _LARGEST_8_BIT_CODE and largest > 0:
        raise SourceError(
            f"no code is above {largest:.0f}, which is {largest / CLIP_CODE * depth_range_mm:.2g} "
            "mm; expected 16-bit codes. Was the file converted to 8 bits?",
            file=file,
            frame=frame,
            field="depth",
        )
    return decode_depth_mm(code, depth_range_mm)


def decode_depth_mm(
    code: Float[np.ndarray, "h w"], depth_range_mm: float = DEPTH_RANGE_MM
) -> Float[np.ndarray, "h w"]:
    """z-depth in mm of the 16-bit code; 0 where the code is 0 or clipped."""
    known = (code > 0) & (code < CLIP_CODE)
    return np.where(known, code * np.float32(depth_range_mm / CLIP_CODE), 0).astype(np.float32)


def read_pose_file(file: Path) -> tuple[Float[np.ndarray, "f 4 4"], Layout]:
    """`world_from_camera` of each line of a pose.txt, and how its numbers stand.

    Raises:
        SourceNotFoundError: no such file.
        PoseError: a line without 16 finite numbers, without (0, 0, 0, 1) as a row or column, that stands
            otherwise than the lines before it, whose rotation is none, or with a translation beyond reason.
    """
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file, field="world_from_camera")
    rows: list[list[float]] = []
    for line in file.read_text().splitlines():
        if not line.strip():
            continue
        try:
            row = [float(value) for value in line.replace(",", " ").split()]
        except ValueError as error:
            raise _pose_error(f"not a number: {error}", file, len(rows)) from error
        if len(row) != 16:
            raise _pose_error(f"{len(row)} numbers; expected 16, one pose", file, len(rows))
        if not np.isfinite(row).all():
            raise _pose_error("the line holds NaN or infinity", file, len(rows))
        rows.append(row)
    if not rows:
        raise PoseError("the file holds no pose", file=file, field="world_from_camera")
    matrices = np.asarray(rows).reshape(-1, 4, 4)
    layout = _layout(matrices, file)
    if layout == "column-major":
        matrices = matrices.transpose(0, 2, 1)
    poses = np.stack([check_pose(matrix, frame=k, file=file) for k, matrix in enumerate(matrices)])
    far = np.flatnonzero(np.abs(poses[:, :3, 3]).max(axis=1) > _LARGEST_TRANSLATION_MM)
    if far.size:
        frame = int(far[0])
        raise _pose_error(
            f"the camera is at {np.round(poses[frame, :3, 3], 1).tolist()}; expected millimetres, within "
            f"{_LARGEST_TRANSLATION_MM / 1000:g} m of the origin",
            file,
            frame,
        )
    return poses, layout


def _layout(matrices: Float[np.ndarray, "f 4 4"], file: Path) -> Layout:
    bottom = np.array([0.0, 0, 0, 1])
    as_rows = np.isclose(matrices[:, 3, :], bottom, atol=1e-6).all(axis=1)
    as_columns = np.isclose(matrices[:, :, 3], bottom, atol=1e-6).all(axis=1)
    neither = np.flatnonzero(~as_rows & ~as_columns)
    if neither.size:
        frame = int(neither[0])
        raise _pose_error(
            f"neither the last row {np.round(matrices[frame, 3], 4).tolist()} nor the last column "
            f"{np.round(matrices[frame, :, 3], 4).tolist()} is (0, 0, 0, 1)",
            file,
            frame,
        )
    # A pose at the origin reads either way; the others decide.
    only_columns, only_rows = as_columns & ~as_rows, as_rows & ~as_columns
    if only_columns.any() and only_rows.any():
        rows_are_rare = only_rows.sum() <= only_columns.sum()
        frame = int(np.flatnonzero(only_rows if rows_are_rare else only_columns)[0])
        here, elsewhere = ("row", "column") if rows_are_rare else ("column", "row")
        raise _pose_error(
            f"the numbers stand {here} after {here} here, and {elsewhere} after {elsewhere} in most lines",
            file,
            frame,
        )
    if only_rows.any():
        return "row-major"
    if not only_columns.any() and not np.allclose(matrices, matrices.transpose(0, 2, 1), atol=1e-6):
        raise PoseError(
            "every camera is at the origin, so nothing tells rows from columns",
            file=file,
            field="world_from_camera",
        )
    return "column-major"


def _pose_error(problem: str, file: Path, frame: int) -> PoseError:
    return PoseError(problem, file=file, frame=frame, field="world_from_camera")


def _poses_of_frames(
    poses: Float[np.ndarray, "p 4 4"], numbers: tuple[int, ...], file: Path
) -> Float[np.ndarray, "f 4 4"]:
    """Line k is the pose of frame number k, or of the k-th frame where the numbers start elsewhere."""
    if len(poses) == len(numbers):
        return poses
    if numbers[-1] >= len(poses):
        first = next(number for number in numbers if number >= len(poses))
        raise PoseError(
            f"{len(poses)} poses for {len(numbers)} frames, and there is a frame {first}; "
            "expected one line a frame",
            file=file,
            frame=first,
            field="world_from_camera",
        )
    logger.warning(
        "%s: %d poses, but frames %d to %d only; the rest of the video is not here",
        file,
        len(poses),
        numbers[0],
        numbers[-1],
    )
    return poses[list(numbers)]


def _camera(folder: Path, flat: bool, calibration: CalibrationName | None) -> tuple[ScaramuzzaCamera, str]:
    file = folder / CALIBRATION_FILE
    if file.is_file():
        try:
            content = json.loads(file.read_text())
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise SourceError(f"not readable as JSON: {error}", file=file, field="calibration") from error
        return camera_from_json(content, file=file), CALIBRATION_FILE
    known = find_recording(folder.resolve().name)
    if calibration is None and known is not None:
        calibration = published_sets()[known.dataset].calibration
    name: CalibrationName = calibration or ("c3vd" if flat else "c3vdv2")
    return CALIBRATIONS[name], f"as published with {name}"


def _numbered(folder: Path, pattern: re.Pattern[str], field: str, *, checked: bool = True) -> dict[int, Path]:
    """Files by the number in their name."""
    found: dict[int, Path] = {}
    if not folder.is_dir():
        return found
    for file in sorted(folder.iterdir()):
        match = pattern.fullmatch(file.name)
        if match is None or not file.is_file():
            continue
        number = int(match[1])
        if checked and number in found:
            raise SourceError(
                f"{found[number].name} and {file.name} are the same frame; expected one of them",
                file=file,
                frame=number,
                field=field,
            )
        found[number] = file
    return found
