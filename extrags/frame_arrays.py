"""A sequence from arrays in memory, checked as a reader checks a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Real, UInt8

from extrags.errors import ConfigError, ShapeError, SourceError
from extrags.frame_stacks import stacked
from extrags.known_depth import is_background
from extrags.reading_corrections import with_corrections
from extrags.sequence import EndoscopicSequence
from extrags.sequence_checks import check_arrays, check_pose
from extrags.splits import Split, every_nth

__all__ = ["sequence_from_arrays"]

_HELD_OUT_EVERY = 8


def sequence_from_arrays(
    rgb: UInt8[np.ndarray, "f h w 3"] | Float[np.ndarray, "f h w 3"],
    K: Real[np.ndarray, "3 3"] | Real[np.ndarray, "f 3 3"],
    *,
    world_from_camera: Real[np.ndarray, "f 4 4"] | None = None,
    depth_mm: Real[np.ndarray, "f h w"] | None = None,
    mask: Bool[np.ndarray, "h w"] | Bool[np.ndarray, "f h w"] | None = None,
    specular: Bool[np.ndarray, "f h w"] | None = None,
    split: Split | None = None,
    name: str = "arrays",
    metric: bool = False,
    frame_names: Sequence[str] = (),
) -> EndoscopicSequence:
    """A sequence of pinhole frames from arrays, with the checks that every reader's sequence passes.

    What numbers alone do not tell is not checked: OpenGL axes, poses from world to camera, or depth in
    another unit than poses or inverse; readers refuse those where frames have depth.

    Args:
        rgb: colours as the camera encoded them: 8-bit, or floats in [0, 1], which are rounded to 8 bits.
        K: intrinsics in pixels, of all frames or of each; pixel centres are at +0.5.
        world_from_camera: camera to world, OpenCV axes (x right, y down, z forward). None: the poses stage
            estimates them.
        depth_mm: z-depth (not along the ray) in the unit of the poses; 0, NaN and infinity are unknown, and
            so is what is over 1000 times as far away as the near part of its image.
        mask: true where a pixel shows tissue, of all frames or of each; None: everywhere.
        specular: true on specular highlights, which then have no weight in training. None: not known;
            readers look for them, this function does not.
        split: training and held-out frames. None holds out frames 0, 8, 16, ...
        name: for messages and reports.
        metric: whether lengths are millimetres; else their unit is arbitrary.
        frame_names: one per frame, for messages.

    Raises:
        ConfigError: the name is no text, or `metric` neither true nor false.
        ShapeError: sizes or types do not fit, or the split names frames that are not there.
        PoseError: a pose is no rigid motion: mirrored, scaled, transposed or not finite.
        SourceError: colours out of range, intrinsics that are no pinhole of this size, negative depth, no
            depth at all, a mask without a pixel, a frame in both parts of the split, two frames of one name;
            names frame and field.

    Returns:
        The sequence; arrays that need no conversion are not copied. What is corrected of every source is
        corrected here too, each with a warning (`extrags.reading_corrections`): colours of frames of another
        light, and masks and depth of instruments, among them.
    """
    if not isinstance(name, str):
        raise ConfigError(f"name is {name!r}, expected a text")
    if not isinstance(metric, bool | np.bool_):
        raise ConfigError(f"{name}: metric is {metric!r}, expected True or False")
    rgb = np.asarray(rgb)
    if rgb.ndim != 4 or rgb.shape[-1] != 3 or not len(rgb):
        raise ShapeError(f"{name}: rgb is {rgb.dtype} {rgb.shape}, expected uint8 or float [F, H, W, 3]")
    frames, height, width = rgb.shape[:3]
    labels = tuple(frame_names) or tuple(f"{k:04d}" for k in range(frames))
    if len(labels) != frames:
        raise ShapeError(f"{name}: {len(labels)} frame names for {frames} frames")
    repeated = [label for label, count in Counter(labels).items() if count > 1]
    if repeated:
        raise SourceError(f"{name}: two frames are called {repeated[0]!r}", field="frame_names")
    K = _numbers(K, f"{name}: K").astype(np.float64, copy=False)
    mask = np.ones((height, width), dtype=np.bool_) if mask is None else np.asarray(mask)
    sequence = EndoscopicSequence(
        name=name,
        rgb=_as_bytes(rgb, labels),
        K=np.tile(K, (frames, 1, 1)) if K.shape == (3, 3) else K,
        mask=np.broadcast_to(mask, (frames, height, width)) if mask.shape == (height, width) else mask,
        split=every_nth(frames, _HELD_OUT_EVERY) if split is None else split,
        world_from_camera=None if world_from_camera is None else _rigid(world_from_camera, labels),
        depth_mm=None if depth_mm is None else _without_gaps(_numbers(depth_mm, f"{name}: depth_mm")),
        specular=None if specular is None else np.asarray(specular),
        metric=bool(metric),
        frame_names=labels,
    )
    check_arrays(sequence)
    if not len(sequence.train):
        raise SourceError("no training frame is left; expected at least one", field="split")
    if sequence.depth_mm is not None and not any(bool((depth > 0).any()) for depth in sequence.depth_mm):
        raise SourceError(
            "no pixel of any frame has a depth; pass None where none is known", field="depth_mm"
        )
    return with_corrections(sequence)


def _as_bytes(rgb: np.ndarray, labels: Sequence[str]) -> np.ndarray:
    if not np.issubdtype(rgb.dtype, np.floating):
        return rgb
    for image, label in zip(rgb, labels, strict=True):
        low, high = float(image.min()), float(image.max())
        # Also false for NaN.
        if not 0 <= low <= high <= 1:
            raise SourceError(
                f"colours are {rgb.dtype} from {low:g} to {high:g}; expected floats in [0, 1], or uint8",
                frame=label,
                field="rgb",
            )
    return stacked((np.rint(image * 255).astype(np.uint8) for image in rgb), len(rgb))


def _rigid(poses: np.ndarray, labels: Sequence[str]) -> np.ndarray:
    given = _numbers(poses, "world_from_camera").astype(np.float64, copy=False)
    if given.shape != (len(labels), 4, 4):
        raise ShapeError(f"world_from_camera is {given.shape}, expected ({len(labels)}, 4, 4)")
    return np.stack([check_pose(pose, frame=label) for pose, label in zip(given, labels, strict=True)])


def _numbers(given: object, what: str) -> np.ndarray:
    """As an array of real numbers."""
    try:
        found = np.asarray(given)
    except ValueError as error:
        raise ShapeError(f"{what} is no array of numbers: {error}") from error
    if found.dtype.kind not in "biuf":
        raise ShapeError(f"{what} is {found.dtype} {found.shape}, expected real numbers")
    return found


def _without_gaps(depth_mm: np.ndarray) -> np.ndarray:
    """As float32, 0 where it is not finite, or a background."""
    if depth_mm.ndim != 3:
        raise ShapeError(f"depth_mm is {depth_mm.dtype} {depth_mm.shape}, expected [F, H, W]")
    finite = (np.where(np.isfinite(depth), depth, 0) for depth in depth_mm)
    known = (np.where(is_background(depth), 0, depth).astype(np.float32) for depth in finite)
    return stacked(known, len(depth_mm))
