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

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_catalog.dataset import Descriptor
from data_catalog.folder_reader import FolderReader
from data_catalog.images import image_size, read_depth
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.rotations import quaternion_rotation
from data_catalog.sampling import LensSampling
from extrags.cameras import compose
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.frame_names import natural_key
from extrags.lens import Lens
from extrags.observed_surface import observed_by_depth

__all__ = ["DEPTH_STEP_MM", "READER", "decode_depth_mm", "intrinsics", "read_poses"]

_USUAL_DOWNSCALE = 2
_FOCAL_SHARE = 227.604 / 475
_MM_PER_CM = 10.0
_CLIP_CODE = 255 * 256
DEPTH_STEP_MM = 20 / 255 * _MM_PER_CM
"""The encoding keeps eight bits."""
_MIRROR = np.diag([1.0, -1.0, 1.0])


def _recognises(folder: Path) -> bool:
    # Without its poses as well: depth would otherwise be taken for more frames.
    others = any(folder.glob("SavedPosition*.txt")) or any(folder.glob("Depth_*.png"))
    return others and any(folder.glob("FrameBuffer_*.png"))


def _files(folder: Path) -> list[Path]:
    frames = [file for pattern in ("FrameBuffer_*.png", "Depth_*.png") for file in folder.glob(pattern)]
    return sorted([*frames, *_pose_files(folder)])


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
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
    width, height = image_size(files[0], frame=numbers[0])
    lens = Lens.pinhole(intrinsics(width, height), width, height)
    return SourceFrames(
        frames=[
            PosedFrame(
                name=number,
                file=file,
                lens=lens,
                world_from_camera=poses[int(number)],
                depth_file=folder / f"Depth_{number}.png",
            )
            for number, file in zip(numbers, files, strict=True)
        ],
        pose_file=_pose_file(folder, "SavedPosition"),
        metric=True,
        read_depth=lambda file, frame: decode_depth_mm(read_depth(file, frame=frame)),
        sampling=partial(LensSampling.planned, usual_downscale=_USUAL_DOWNSCALE),
        observed=partial(observed_by_depth, tolerance_mm=DEPTH_STEP_MM),
        lens_stays="Its frames were rendered with that camera, and no other fits them",
    )


READER = FolderReader(
    name="simcol3d",
    version=1,
    summary="FrameBuffer_NNNN.png with Depth_NNNN.png and SavedPosition*.txt of SimCol3D",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="Unity axes (left-handed, y up), cm; turned into OpenCV's and mm on reading",
    named_sets=(
        Descriptor(
            name="simcol3d/s1",
            description="SimCol3D synthetic colon, first ten frames of S1, with depth and exact poses",
            frames=10,
            width=475,
            height=475,
            length_unit="mm (source: cm)",
            axes="Unity (left-handed, y up); turned into OpenCV's on reading",
            has_depth=True,
            has_poses=True,
            split="every n-th frame held out (ingest.holdout_every)",
            licence="CC BY-NC-SA 4.0",
            format="simcol3d",
            folder="simcol3d_s1",
        ),
    ),
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
        PoseError: the two files differ in length or belong to different sequences, there are several of a
            kind, or a line is no pose.
        SourceNotFoundError: a pose file is missing.
    """
    position_file, rotation_file = _pose_files(folder)
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


def _pose_files(folder: Path) -> tuple[Path, Path]:
    """The positions and the rotations of one sequence."""
    position_file = _pose_file(folder, "SavedPosition")
    rotation_file = _pose_file(folder, "SavedRotationQuaternion")
    of_positions, of_rotations = (
        file.stem.removeprefix(start)
        for file, start in ((position_file, "SavedPosition"), (rotation_file, "SavedRotationQuaternion"))
    )
    if of_positions != of_rotations:
        raise PoseError(
            f"the rotations beside it are {rotation_file.name}, by its name of another sequence",
            file=position_file,
            field="world_from_camera",
        )
    return position_file, rotation_file


def _pose_file(folder: Path, start: str) -> Path:
    found = sorted(folder.glob(f"{start}*.txt"))
    if not found:
        raise SourceNotFoundError(
            "no such file, though there are frames of SimCol3D (FrameBuffer_NNNN.png); expected the poses of "
            "all. To have them estimated, give FrameBuffer_NNNN.png alone a folder of their own",
            file=folder / f"{start}_*.txt",
            field="world_from_camera",
        )
    if len(found) > 1:
        raise PoseError(
            f"beside {found[0].name}, and nothing tells which of them belongs to these frames; expected one",
            file=found[1],
            field="world_from_camera",
        )
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
