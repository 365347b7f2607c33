"""Reader of SimCol3D sequences: synthetic colon with depth and exact poses.

On disk: `FrameBuffer_NNNN.png` (RGBA), `Depth_NNNN.png` (16 bit), `SavedPosition_*.txt` and
`SavedRotationQuaternion_*.txt` (one line a frame; the quaternion as x, y, z, w). Read as follows:

* K: fx = fy = 227.604 px, cx = cy = 237.5 px for 475 x 475 pixels, scaled with the image; the `cam.txt` that
  comes with the set has its numbers in an order of its own and is not used.
* Depth: value / 256 / 255 * 20 cm, z-depth; 0 is unknown, and so is the clip value 255 * 256 (20 cm).
* Poses: Unity's, left-handed with y up, in cm: p_world = R(q) diag(1, -1, 1) p_camera + t, with p_camera in
  OpenCV's axes. The world is mirrored as a whole (y negated), which makes the motion a proper one.

Lengths become millimetres.

Source: Rau et al., "SimCol3D: 3D reconstruction during colonoscopy challenge", Medical Image Analysis 2024.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_catalog.formats import FolderFormat
from data_catalog.images import Resampling, natural_key, read_colour, read_depth, spread
from data_catalog.rotations import quaternion_rotation
from data_catalog.splits import every_nth
from data_catalog.visibility import observed_from_depth
from extrags.cameras import Cameras, compose
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.sequence import EndoscopicSequence

__all__ = ["DEPTH_STEP_MM", "FORMAT", "decode_depth_mm", "intrinsics", "read_poses"]

_USUAL_DOWNSCALE = 2
_FOCAL_SHARE = 227.604 / 475
_MM_PER_CM = 10.0
_CLIP_CODE = 255 * 256
DEPTH_STEP_MM = 20 / 255 * _MM_PER_CM
"""The encoding keeps eight bits."""
_MIRROR = np.diag([1.0, -1.0, 1.0])


def _recognises(folder: Path) -> bool:
    return any(folder.glob("SavedPosition*.txt")) and any(folder.glob("FrameBuffer_*.png"))


def _files(folder: Path) -> list[Path]:
    patterns = ("FrameBuffer_*.png", "Depth_*.png", "SavedPosition*.txt", "SavedRotationQuaternion*.txt")
    return sorted(file for pattern in patterns for file in folder.glob(pattern))


def _read(folder: Path, config: IngestConfig, name: str) -> EndoscopicSequence:
    poses = read_poses(folder)
    files = sorted(folder.glob("FrameBuffer_*.png"), key=lambda file: natural_key(file.name))
    numbers = [file.stem.split("_")[-1] for file in files]
    # The pose files may describe the whole recording, of which only a part is here.
    beyond = [number for number in numbers if int(number) >= len(poses)]
    if beyond:
        raise PoseError(
            f"{len(poses)} poses, but there is a frame {beyond[0]}; expected one line a frame from 0000 on",
            file=_pose_file(folder, "SavedPosition"),
            frame=beyond[0],
            field="world_from_camera",
        )
    missing = sorted(set(range(int(numbers[-1]) + 1)) - {int(number) for number in numbers})
    if missing:
        raise SourceNotFoundError(
            "no such file, though frames before and after it are there",
            file=folder / f"FrameBuffer_{missing[0]:04d}.png",
            frame=f"{missing[0]:04d}",
            field="rgb",
        )
    kept = spread(len(files), config.max_frames)
    colours, depths = [], []
    resampling: Resampling | None = None
    for index in kept:
        number = numbers[index]
        colour = read_colour(files[index], frame=number)
        if resampling is None:
            resampling = Resampling.planned(colour.shape[1], colour.shape[0], config, _USUAL_DOWNSCALE)
        depth_file = folder / f"Depth_{number}.png"
        depth = decode_depth_mm(read_depth(depth_file, frame=number))
        colours.append(resampling.colour(colour, file=files[index], frame=number))
        depths.append(resampling.depth(depth, file=depth_file, frame=number))
    if resampling is None:
        raise SourceNotFoundError("no FrameBuffer_NNNN.png", file=folder)
    K = resampling.intrinsics(intrinsics(resampling.source_width, resampling.source_height))
    world_from_camera = poses[[int(numbers[index]) for index in kept]]
    split = every_nth(len(kept), config.holdout_every, file=folder)
    cameras = Cameras(
        np.repeat(K[None], len(kept), axis=0), world_from_camera, resampling.width, resampling.height
    )
    depth_mm = np.stack(depths)
    return EndoscopicSequence(
        name=name,
        rgb=np.stack(colours),
        K=cameras.K,
        mask=np.ones(depth_mm.shape, dtype=bool),
        split=split,
        world_from_camera=world_from_camera,
        depth_mm=depth_mm,
        recording=np.zeros(len(kept), dtype=np.int64),
        frame_names=tuple(numbers[index] for index in kept),
        metric=True,
        observed=observed_from_depth(cameras, depth_mm, split.train, split.test, tolerance_mm=DEPTH_STEP_MM),
    )


FORMAT = FolderFormat(
    name="simcol3d",
    version=1,
    summary="FrameBuffer_NNNN.png with Depth_NNNN.png and SavedPosition*.txt of SimCol3D",
    recognises=_recognises,
    files=_files,
    read=_read,
    conventions="Unity axes (left-handed, y up), cm; turned into OpenCV's and mm on reading",
)


def intrinsics(width: int, height: int) -> Float[np.ndarray, "3 3"]:
    """K for images of a size; 90 degrees and a little more of field of view."""
    focal = _FOCAL_SHARE * width
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def decode_depth_mm(code: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """z-depth in mm of the 16-bit code; 0 where the code is 0 or clipped."""
    depth = code / 256 / 255 * 20 * _MM_PER_CM
    return np.where((code > 0) & (code < _CLIP_CODE), depth, 0).astype(np.float32)


def read_poses(folder: Path) -> Float[np.ndarray, "f 4 4"]:
    """`world_from_camera` in OpenCV axes and mm, one for each line of the pose files.

    Raises:
        PoseError: the two files differ in length, or a line is no pose.
        SourceNotFoundError: a pose file is missing.
    """
    position_file = _pose_file(folder, "SavedPosition")
    rotation_file = _pose_file(folder, "SavedRotationQuaternion")
    positions = _numbers(position_file, 3)
    quaternions = _numbers(rotation_file, 4)
    if len(positions) != len(quaternions):
        raise PoseError(
            f"{len(positions)} positions, but {len(quaternions)} rotations in {rotation_file.name}",
            file=position_file,
            field="world_from_camera",
        )
    poses = []
    for index, (position, quaternion) in enumerate(zip(positions, quaternions, strict=True)):
        unity = quaternion_rotation(quaternion, file=rotation_file, frame=index)
        # Camera: OpenCV's y is Unity's -y. World: mirrored the same way, so that det stays +1.
        rotation = _MIRROR @ unity @ _MIRROR
        poses.append(compose(rotation, _MIRROR @ np.asarray(position) * _MM_PER_CM))
    return np.stack(poses)


def _pose_file(folder: Path, start: str) -> Path:
    found = sorted(folder.glob(f"{start}*.txt"))
    if not found:
        raise SourceNotFoundError("no such file", file=folder / f"{start}_*.txt")
    return found[0]


def _numbers(file: Path, columns: int) -> list[list[float]]:
    rows = []
    for index, line in enumerate(file.read_text().splitlines()):
        if not line.strip():
            continue
        try:
            row = [float(value) for value in line.split()]
        except ValueError as error:
            raise PoseError(f"not a number: {error}", file=file, frame=index) from error
        if len(row) != columns or not np.isfinite(row).all():
            raise PoseError(
                f"expected {columns} finite numbers, found {line.strip()!r}", file=file, frame=index
            )
        rows.append(row)
    if not rows:
        raise SourceError("the file holds no pose", file=file)
    return rows
