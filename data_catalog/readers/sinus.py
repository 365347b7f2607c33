"""Reader of the Johns Hopkins sinus sequence: undistorted frames with structure from motion.

On disk: `images/NNNN.jpg`, one for each line of `visible_view_indexes`; `camera_intrinsics_per_view` (fx,
fy, cx, cy, one to a line); `motion.yaml` (position x, y, z and quaternion x, y, z, w of each view, camera to
world);
`structure.ply` (points, then a camera element that is skipped); `undistorted_mask.bmp` (white is tissue).
Axes are OpenCV's throughout and nothing is turned; lengths have an arbitrary unit (`metric=False`). Images
are cropped to the mask's bounding box and shrunk 4x by area unless the settings say otherwise.

Source: Liu et al., "Dense depth estimation in monocular endoscopy with self-supervised learning methods",
IEEE TMI 2020 (data layout of the accompanying example set).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from data_catalog.calibration_files import LENS_OF_POSES
from data_catalog.checks import check_intrinsics
from data_catalog.dataset import Descriptor
from data_catalog.folder_reader import FolderReader
from data_catalog.images import read_mask
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.rotations import quaternion_rotation
from data_catalog.sampling import LensSampling
from extrags.cameras import compose
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.lens import Lens
from extrags.yaml_text import read_yaml

__all__ = ["READER", "read_points", "read_poses", "read_view_names"]

_USUAL_DOWNSCALE = 4


def _recognises(folder: Path) -> bool:
    return (folder / "motion.yaml").is_file() and (folder / "structure.ply").is_file()


def _files(folder: Path) -> list[Path]:
    fixed = ("camera_intrinsics_per_view", "motion.yaml", "structure.ply", "undistorted_mask.bmp")
    listed = [folder / name for name in (*fixed, "visible_view_indexes")]
    return sorted([*(file for file in listed if file.is_file()), *(folder / "images").glob("*.jpg")])


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    views = read_view_names(folder)
    poses = read_poses(folder)
    if len(poses) != len(views):
        raise PoseError(
            f"{len(poses)} poses for {len(views)} frames in visible_view_indexes",
            file=folder / "motion.yaml",
            field="poses",
        )
    mask_file = folder / "undistorted_mask.bmp"
    mask = read_mask(mask_file)
    lens = _lens(folder, mask.shape[1], mask.shape[0])
    return SourceFrames(
        frames=[
            PosedFrame(
                name=view,
                file=folder / "images" / f"{view}.jpg",
                lens=lens,
                world_from_camera=pose,
                mask_file=mask_file,
            )
            for view, pose in zip(views, poses, strict=True)
        ],
        pose_file=folder / "motion.yaml",
        metric=False,
        sampling=partial(
            LensSampling.planned, usual_downscale=_USUAL_DOWNSCALE, box=_bounding_box(mask, mask_file)
        ),
        points=read_points(folder),
        lens_stays=LENS_OF_POSES,
    )


READER = FolderReader(
    name="sinus",
    version=2,
    summary="motion.yaml, structure.ply and images/ of the Hopkins sinus set",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="OpenCV camera axes, camera to world; arbitrary unit",
    named_sets=(
        Descriptor(
            name="sinus/hopkins",
            description="Human sinus endoscopy, 35 undistorted frames with COLMAP-like poses and 570 points",
            frames=35,
            width=1920,
            height=1080,
            length_unit="arbitrary (structure from motion)",
            axes="OpenCV camera axes, camera-to-world; used as they are",
            has_depth=False,
            has_poses=True,
            split="every n-th frame held out (ingest.holdout_every)",
            licence="GPL-3.0",
            format="sinus",
            folder="sinus_hopkins",
        ),
    ),
)


def read_view_names(folder: Path) -> list[str]:
    """Names of the frames, in the order of the poses.

    Raises:
        SourceError: a view that is listed twice.
    """
    file = folder / "visible_view_indexes"
    names = [f"{int(line):08d}" for line in _text(file).split()]
    twice = next((name for index, name in enumerate(names) if name in names[:index]), None)
    if twice is not None:
        raise SourceError("the view is listed twice", file=file, frame=twice, field="frames")
    return names


def read_poses(folder: Path) -> Float[np.ndarray, "f 4 4"]:
    """`world_from_camera` of each view.

    Raises:
        PoseError: an entry is incomplete or no rotation; names the pose.
        SourceError: the file is no YAML of the expected shape.
    """
    import yaml

    file = folder / "motion.yaml"
    try:
        content: Any = read_yaml(_text(file), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except ValueError as error:
        raise SourceError(f"not readable as YAML: {error}", file=file) from error
    entries = content.get("poses[]") if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise SourceError("no block `poses[]`", file=file, field="poses[]")
    poses = []
    for index in range(len(entries)):
        key = f"poses[{index}]"
        try:
            position = [float(entries[key]["position"][axis]) for axis in "xyz"]
            quaternion = [float(entries[key]["orientation"][axis]) for axis in "xyzw"]
        except (KeyError, TypeError, ValueError) as error:
            raise PoseError(f"incomplete pose: {error!r}", file=file, frame=index, field=key) from error
        poses.append(compose(quaternion_rotation(quaternion, file=file, frame=index), np.array(position)))
    return np.stack(poses)


def read_points(folder: Path) -> Float[np.ndarray, "p 3"]:
    """The points of the structure from motion.

    Raises:
        SourceError: the header does not count the points, or lines are missing.
    """
    file = folder / "structure.ply"
    lines = _text(file).splitlines()
    count = next((int(line.split()[2]) for line in lines if line.startswith("element vertex ")), None)
    if count is None or "end_header" not in lines:
        raise SourceError("no PLY header with `element vertex`", file=file)
    start = lines.index("end_header") + 1
    rows = [line.split()[:3] for line in lines[start : start + count]]
    if len(rows) != count or any(len(row) != 3 for row in rows):
        raise SourceError(f"{count} points announced, {len(rows)} found", file=file, field="vertex")
    return np.asarray(rows, dtype=np.float64)


def _lens(folder: Path, width: int, height: int) -> Lens:
    file = folder / "camera_intrinsics_per_view"
    values = [float(value) for value in _text(file).split()]
    if len(values) < 4:
        raise SourceError(f"{len(values)} numbers; expected fx, fy, cx, cy", file=file, field="K")
    if len(values) % 4 or values != values[:4] * (len(values) // 4):
        raise SourceError(
            f"{len(values)} numbers, which are not fx, fy, cx, cy over and over; expected one camera for all "
            "views",
            file=file,
            field="K",
        )
    lens = Lens("PINHOLE", tuple(values[:4]), width, height)
    check_intrinsics(lens.K, width, height, file=file)
    return lens


def _bounding_box(mask: Bool[np.ndarray, "h w"], file: Path) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        raise SourceError("the mask leaves no pixel", file=file, field="mask")
    return (
        int(columns[0]),
        int(rows[0]),
        int(columns[-1] - columns[0] + 1),
        int(rows[-1] - rows[0] + 1),
    )


def _text(file: Path) -> str:
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file)
    return file.read_text()
