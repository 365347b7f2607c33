"""Whether the arrays of a sequence are what they should be: what can be told from the numbers alone.

Axes of poses, the unit of depth and the polarity of a mask show only where depth is carried from frame to
frame; `data_catalog.checks` looks for that in what it reads.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from extrags.cameras import as_rotation
from extrags.errors import PoseError, SourceError
from extrags.sequence import EndoscopicSequence

__all__ = [
    "SMALLEST_SIDE_PX",
    "check_arrays",
    "check_axis_in_image",
    "check_depth",
    "check_image_size",
    "check_intrinsics",
    "check_pose",
    "check_split",
]

SMALLEST_SIDE_PX = 6
"""Of frames: SSIM, in which every run ends, mirrors half its window of 11 pixels at the edges. What the
catalogue reads has more (`data_catalog.resampling`)."""


def check_arrays(sequence: EndoscopicSequence, *, file: object = None) -> None:
    """Refuse a sequence whose arrays no stage could use.

    Args:
        sequence: with poses and depth, or without.
        file: named in errors.

    Raises:
        PoseError: a pose that is not a rigid motion.
        SourceError: frames too small, a split that leaks or repeats a frame, intrinsics that are no pinhole,
            a frame without any valid pixel, or depth that is no depth; names frame and field.
    """
    check_image_size(sequence.width, sequence.height, file=file)
    check_split(sequence, file=file)
    for index in range(len(sequence)):
        name = sequence.frame_name(index)
        check_intrinsics(sequence.K[index], sequence.width, sequence.height, frame=name, file=file)
        if sequence.lens is not None:
            check_axis_in_image(sequence.K[index], sequence.width, sequence.height, frame=name, file=file)
        if not sequence.mask[index].any():
            raise SourceError("the mask leaves no pixel", file=file, frame=name, field="mask")
        if sequence.world_from_camera is not None:
            check_pose(sequence.world_from_camera[index], frame=name, file=file)
        for field in ("depth_mm", "withheld_depth_mm"):
            depth = getattr(sequence, field)
            if depth is not None:
                check_depth(depth[index], frame=name, file=file, field=field)


def check_image_size(width: int, height: int, *, file: object = None) -> None:
    """Refuse frames that are too small for any run to end well.

    Raises:
        SourceError: says the smallest size.
    """
    if min(width, height) < SMALLEST_SIDE_PX:
        raise SourceError(
            f"frames of {width} x {height} px; expected at least {SMALLEST_SIDE_PX} px a side",
            file=file,
            field="rgb",
        )


def check_split(sequence: EndoscopicSequence, *, file: object = None) -> None:
    """Refuse a split that names a frame twice; whether it has training frames is for the stages to say.

    Raises:
        SourceError: names the first frame, or the part of the split.
    """
    for name, indices in (("train", sequence.train), ("test", sequence.test)):
        if np.unique(indices).size != indices.size:
            raise SourceError(f"the {name} split names a frame twice", file=file, field="split")
    shared = np.intersect1d(sequence.train, sequence.test)
    if shared.size:
        raise SourceError(
            f"{shared.size} of {len(sequence)} frames both train and evaluate, this one is the first",
            file=file,
            frame=sequence.frame_name(int(shared[0])),
            field="split",
        )


def check_pose(
    pose: Float[np.ndarray, "4 4"], *, frame: object = None, file: object = None
) -> Float[np.ndarray, "4 4"]:
    """The rigid motion a matrix stands for, its rotation projected to SO(3) where it lost digits.

    Raises:
        PoseError: not finite, not a rotation, mirrored, or a last row other than 0, 0, 0, 1.
    """
    if not np.isfinite(pose).all():
        raise PoseError(
            f"{int((~np.isfinite(pose)).sum())} of 16 entries are NaN or infinite",
            file=file,
            frame=frame,
            field="world_from_camera",
        )
    if not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        hint = " The matrix looks transposed" if np.allclose(pose[:, 3], (0, 0, 0, 1), atol=1e-6) else ""
        raise PoseError(
            f"the last row is {np.round(pose[3], 4).tolist()}, expected [0, 0, 0, 1].{hint}",
            file=file,
            frame=frame,
            field="world_from_camera",
        )
    rigid = np.eye(4)
    rigid[:3, :3] = as_rotation(np.asarray(pose[:3, :3], dtype=np.float64), frame=frame, file=file)
    rigid[:3, 3] = pose[:3, 3]
    return rigid


def check_intrinsics(
    K: Float[np.ndarray, "3 3"], width: int, height: int, *, frame: object = None, file: object = None
) -> None:
    """Refuse a K that is no pinhole for an image of this size, in pixels.

    Raises:
        SourceError: names the entry that is wrong.
    """

    def refuse(problem: str) -> SourceError:
        return SourceError(problem, file=file, frame=frame, field="K")

    if not np.isfinite(K).all():
        raise refuse("K holds NaN or infinity")
    for name, focal, size in (("fx", K[0, 0], width), ("fy", K[1, 1], height)):
        if focal <= 0:
            raise refuse(f"focal length {name} = {focal:g} px; expected a positive number")
        if not 0.05 * size < focal < 100 * size:
            raise refuse(f"focal length {name} = {focal:g} px does not fit an image of {width} x {height} px")
    if not np.allclose([K[1, 0], K[2, 0], K[2, 1], K[2, 2]], (0, 0, 0, 1), atol=1e-9) or abs(K[0, 1]) > 1e-9:
        raise refuse(f"expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], found {np.round(K, 4).tolist()}")
    for name, center, size in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
        if not -size < center < 2 * size:
            raise refuse(f"principal point {name} = {center:g} px lies far outside {width} x {height} px")


def check_axis_in_image(
    K: Float[np.ndarray, "3 3"], width: int, height: int, *, frame: object = None, file: object = None
) -> None:
    """Refuse original pixels of a lens whose axis they do not show: there is no pinhole about it.

    Raises:
        SourceError: names the principal point.
    """
    if not (0 < K[0, 2] < width and 0 < K[1, 2] < height):
        raise SourceError(
            f"the axis of the lens, at ({K[0, 2]:g}, {K[1, 2]:g}) px, lies outside the image of {width} x "
            f"{height} px; expected it inside",
            file=file,
            frame=frame,
            field="K",
        )


def check_depth(
    depth_mm: Float[np.ndarray, "h w"],
    *,
    frame: object = None,
    file: object = None,
    field: str = "depth_mm",
) -> None:
    """Refuse a depth map with values that are no depth; 0 means unknown, and may stand throughout.

    Raises:
        SourceError: names the kind of value and how many there are.
    """
    for found, kind in (
        (np.isnan(depth_mm), "NaN"),
        (np.isinf(depth_mm), "infinite"),
        (depth_mm < 0, "negative"),
    ):
        count = int(found.sum())
        if count:
            v, u = np.argwhere(found)[0]
            raise SourceError(
                f"{count} of {depth_mm.size} depth values are {kind}, the first at row {v}, column {u}; "
                "expected millimetres, 0 where unknown",
                file=file,
                frame=frame,
                field=field,
            )
