"""Checks that every sequence passes before anything else sees it.

What is refused: non-finite or mirrored poses, intrinsics that are no pinhole, depth with NaN, infinity or
negative values (0 is the one mark for "unknown"; files' NaN and infinity were turned into 0), depth that is
known in no frame, a frame without any valid mask, a split that leaks, and camera axes or a depth scale that
depth itself contradicts. What the numbers alone show is looked for by `extrags.sequence_checks`; here stands
what takes several frames. What is readable but questionable is reported by `data_catalog.diagnostics`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from data_catalog.plausible_intrinsics import another_size
from data_catalog.pose_conventions import OPENCV, USUAL_MISTAKES, PoseConvention, other_readings
from extrags.cameras import invert_poses, project_points, transform_points, unproject_pixels
from extrags.errors import PoseError, SourceError
from extrags.sequence import EndoscopicSequence
from extrags.sequence_checks import check_arrays, check_depth, check_intrinsics, check_pose

__all__ = [
    "check_axes",
    "check_depth",
    "check_depth_scale",
    "check_intrinsics",
    "check_pose",
    "check_sequence",
    "depth_disagreement",
    "neighbouring_frames",
]


# Below this depth re-projection error (relative, median) poses are right. Another reading of the axes is
# named as the likely mistake when its error is small, and a small share of the error as given. Where cameras
# move little, some of 48 readings fits better than the right one by chance.
_SUSPICIOUS_ERROR = 0.03
_CONVINCING_ERROR = 0.10
_CLEARLY_BETTER = 0.35
# Depth along the ray carries nearly as well as z-depth where a scope moves little: in sequences of the
# catalogue it is off by 4 to 5 %, and by 0.2 % once it is divided by the length of the ray.
_RAY_SUSPICIOUS_ERROR = 0.02
_CLEARLY_ALONG_RAY = 0.25
# Depth that is a thousand times too far is off by 2 % beside steps of 7 % of the distance, and by a tenth of
# that once it is divided.
_FAR_SUSPICIOUS_ERROR = 0.005
_FAR_FACTOR = 0.2
_FAR_BETTER = 0.25
# A pair of views whose points mostly leave the image tells nothing.
_MIN_INSIDE_SHARE = 0.15
# Nor does depth of hardly any pixels (share of the image).
_MIN_COMPARED_SHARE = 0.03
# What less than this keeps, as narrow or inverted masks do, is soon outside the next frame, also where poses
# are right: then no motion at all seems to fit.
_NARROW_SHARE = 0.2
_CHECKED_PAIRS = 6
_CHECKED_POINTS = 400
# Factors by which depth may be off: a tenth of a thousandth to ten thousand, in steps of 5 %.
_DEPTH_FACTORS = np.exp(np.arange(-190, 191) * 0.05)
_FINE_STEPS = np.exp(np.arange(-10, 11) * 0.005)
_CLEARLY_OTHER_FACTOR = 1.5
_KNOWN_FACTORS = {
    1000.0: "depth in metres beside poses in millimetres",
    0.001: "depth in millimetres beside poses in metres",
    10.0: "depth in centimetres beside poses in millimetres",
    0.1: "depth in millimetres beside poses in centimetres",
    100.0: "depth in metres beside poses in centimetres",
    0.01: "depth in centimetres beside poses in metres",
    1 / 256: "16-bit codes that were not divided by 256",
    100 / 65535: "16-bit codes of 0 to 100 mm that were not decoded",
}


def check_sequence(
    sequence: EndoscopicSequence,
    *,
    file: object = None,
    stored: PoseConvention = OPENCV,
    depth_unit: str = "",
) -> None:
    """Refuse a sequence that no stage could use.

    Args:
        sequence: what a reader made.
        file: named in errors.
        stored: how the file should hold poses, for errors about them.
        depth_unit: in which unit files of the layout hold depth, for errors about it.

    Raises:
        PoseError: a pose that is not a rigid motion, or axes or positions that the depth contradicts.
        SourceError: anything else; names frame and field.
    """
    if not sequence.train.size:
        raise SourceError("no training frame is left; expected at least one", file=file, field="split")
    check_arrays(sequence, file=file)
    if sequence.depth_mm is not None and not any((depth > 0).any() for depth in sequence.depth_mm):
        raise SourceError("no pixel of any frame has a depth", file=file, field="depth_mm")
    check_axes(sequence, file=file, stored=stored)
    check_depth_scale(sequence, file=file, depth_unit=depth_unit)


def check_axes(sequence: EndoscopicSequence, *, file: object = None, stored: PoseConvention = OPENCV) -> None:
    """Refuse poses in other axes than OpenCV's camera-to-world, where depth can tell.

    Depth of one frame, carried to the next one by their poses, must meet that frame's depth. Where it does
    not, every other reading of the axes (24 proper ones, and the inverse) is tried; one that fits much
    better is named in the message, the usual mistakes before all others, in the words of the file (`stored`).
    Without depth, or with hardly any motion, nothing can be told.

    Raises:
        PoseError: another reading of the axes fits the depth much better.
        SourceError: K is that of an image of another size; or the mask keeps what is no tissue, and outside
            of it the poses fit as they are.
    """
    if sequence.world_from_camera is None or sequence.depth_mm is None:
        return
    pairs = _comparable_pairs(sequence)
    if not pairs:
        return
    poses = np.asarray(sequence.world_from_camera, dtype=np.float64)
    seen = _seen_points(sequence, pairs)
    as_given = _reprojection_error(sequence, poses, pairs, seen)
    if as_given < _SUSPICIOUS_ERROR:
        return
    _refuse_intrinsics_of_another_size(sequence, as_given, file)
    # Along a narrow part of the image another reading fits by chance, though not as well as the right one.
    convincing = _CONVINCING_ERROR if _are_wide(sequence, pairs) else _SUSPICIOUS_ERROR
    least = min(_CLEARLY_BETTER * as_given, convincing)
    fits = [
        (_reprojection_error(sequence, read, pairs, seen, max(least, _SUSPICIOUS_ERROR)), name)
        for name, read in other_readings(poses, stored)
    ]
    best_error, _ = min(fits)
    if best_error < least:
        if _is_proven_outside(sequence, pairs, file):
            return
        usual = [fit for fit in fits[:USUAL_MISTAKES] if fit[0] < _SUSPICIOUS_ERROR]
        error, name = min(usual or fits)
        raise PoseError(
            f"the poses contradict the depth: carried from frame to frame it is off by {as_given:.0%} "
            f"(median), but only by {error:.1%} when the poses are read as {name}. "
            f"Expected {stored.expected}",
            file=file,
            field="world_from_camera",
        )


def check_depth_scale(sequence: EndoscopicSequence, *, file: object = None, depth_unit: str = "") -> None:
    """Refuse depth in another unit than the poses, but not depth along the ray.

    Depth carried from frame to frame meets the next frame's depth only when both have one unit. Where it does
    not, but does so with all depth times one factor, that factor is named. Frames without parallax tell
    nothing, and where cameras move little any large factor fits as well as no motion: that is no unit.
    Where it meets it at least four times better once it is divided by the length of each pixel's ray, it is
    in the unit of the poses.

    Depth that is far too large hardly contradicts cameras that move little from frame to frame, as nothing
    comes nearer: there the error decides less than how much better another factor fits.

    Args:
        sequence: what a reader made.
        file: named in errors.
        depth_unit: in which unit files of the layout hold depth, as a clause; empty where it is that of the
            poses as it stands there.

    Raises:
        SourceError: another factor, at least 1.5 times more or less, fits much better; or a factor on the
            inverse of depth does; or K is that of an image of another size; or the mask keeps what is no
            tissue, and outside of it depth and poses fit as they are.
        PoseError: no motion at all fits much better, and no factor much better than that.
    """
    if sequence.world_from_camera is None or sequence.depth_mm is None:
        return
    pairs = _comparable_pairs(sequence)
    if not pairs:
        return
    poses = np.asarray(sequence.world_from_camera, dtype=np.float64)
    seen = _seen_points(sequence, pairs)
    as_given = _reprojection_error(sequence, poses, pairs, seen)
    if as_given > _RAY_SUSPICIOUS_ERROR and _is_along_ray(sequence, poses, pairs):
        return
    if as_given < _FAR_SUSPICIOUS_ERROR:
        return
    if as_given >= _SUSPICIOUS_ERROR:
        _refuse_intrinsics_of_another_size(sequence, as_given, file)

    def error_with(factor: float, at_most: float = np.inf) -> float:
        return _error_with_factor(factor, sequence, pairs, seen, at_most)

    factor, best = _best_factor(sequence, pairs, seen, min(_CLEARLY_BETTER * as_given, _CONVINCING_ERROR))
    if as_given >= _SUSPICIOUS_ERROR:
        _refuse_inverse_depth(sequence, pairs, as_given, best, file)
    if not max(factor, 1 / factor) >= _CLEARLY_OTHER_FACTOR:
        return
    if as_given < _SUSPICIOUS_ERROR and (factor > _FAR_FACTOR or best >= _FAR_BETTER * as_given):
        return
    if _is_proven_outside(sequence, pairs, file):
        return
    factor = min((factor * fine for fine in _FINE_STEPS), key=error_with)
    about = f"{float(f'{factor:.3g}'):g}"
    nearest = min(_KNOWN_FACTORS, key=lambda known: abs(np.log(known / factor)))
    known = abs(np.log(nearest / factor)) < 0.2 and not depth_unit
    hint = f", as of {_KNOWN_FACTORS[nearest]}" if known else ""
    still = error_with(np.inf)
    if best >= _CLEARLY_BETTER * still and still < min(_CLEARLY_BETTER * as_given, _CONVINCING_ERROR):
        if not _are_wide(sequence, pairs):
            return
        raise PoseError(
            f"the positions of the cameras contradict the depth: carried from frame to frame it is off by "
            f"{as_given:.0%} (median), but only by {still:.1%} if the cameras did not move at all (by "
            f"{best:.1%} when it is multiplied by about {about}{hint}, which so little motion cannot "
            "tell). "
            "Expected positions of cameras in the world, in the unit of the depth",
            file=file,
            field="world_from_camera",
        )
    raise SourceError(
        f"depth and poses are in different units: carried from frame to frame depth is off by "
        f"{as_given:.0%} (median), but only by {best:.1%} when it is multiplied by about "
        f"{about}{hint}. Expected depth in the unit of the poses{depth_unit and f': {depth_unit}'}",
        file=file,
        field="depth_mm",
    )


def _error_with_factor(
    factor: float,
    sequence: EndoscopicSequence,
    pairs: list[tuple[int, int]],
    seen: list[Float[np.ndarray, "_ 3"]],
    at_most: float = np.inf,
) -> float:
    """`_reprojection_error` of depth times a factor."""
    # Depth times a factor beside these poses is this depth beside poses that move by less.
    moved = np.array(sequence.world_from_camera, dtype=np.float64)
    moved[:, :3, 3] /= factor
    return _reprojection_error(sequence, moved, pairs, seen, at_most)


def _best_factor(
    sequence: EndoscopicSequence,
    pairs: list[tuple[int, int]],
    seen: list[Float[np.ndarray, "_ 3"]],
    below: float,
) -> tuple[float, float]:
    """The factor on depth that fits best, and its error; not a number and `below` where none has less."""
    # Most factors fit so badly that one pair of frames rules them out.
    factor, best = np.nan, below
    for other in _DEPTH_FACTORS.tolist():
        error = _error_with_factor(other, sequence, pairs, seen, best)
        if error < best:
            factor, best = other, error
    return factor, best


def _refuse_inverse_depth(
    sequence: EndoscopicSequence,
    pairs: list[tuple[int, int]],
    as_given: float,
    best: float,
    file: object,
) -> None:
    """Where no factor makes depth fit: whether one on its inverse does, as on the disparity of stereo.

    In sequences of the catalogue the inverse of the right depth is off by 1 to 25 % with the best factor, and
    the right one by 0.2 to 0.4 %.

    Args:
        sequence: with depth and poses.
        pairs: of frames.
        as_given: error of depth as it is.
        best: that with the best factor.
        file: named in the error.

    Raises:
        SourceError: a factor on the inverse fits much better than any on depth, and than no motion.
    """
    assert sequence.depth_mm is not None
    compared = sorted({index for pair in pairs for index in pair})
    first = sequence.depth_mm[compared[0]]
    # Of all frames the same constant, for which the factors are a wide range.
    constant = np.square(np.median(first[first > 0]).astype(np.float64))
    # Memory is taken by the frames that are compared alone.
    inverse = np.zeros(sequence.depth_mm.shape, np.float32)
    for index in compared:
        depth = sequence.depth_mm[index]
        inverse[index] = np.divide(constant, depth, out=np.zeros_like(depth), where=depth > 0)
    turned = replace(sequence, depth_mm=inverse)
    seen = _seen_points(turned, pairs)
    limit = min(_CLEARLY_BETTER * min(best, as_given), _SUSPICIOUS_ERROR)
    factor, error = _best_factor(turned, pairs, seen, limit)
    still = _error_with_factor(np.inf, turned, pairs, seen)
    if np.isnan(factor) or error >= _CLEARLY_BETTER * still:
        return
    raise SourceError(
        f"depth is inverse, as disparity is: carried from frame to frame it is off by {as_given:.0%} "
        f"(median), but only by {error:.1%} when a constant is divided by it. Expected z-depth in the unit "
        "of the poses: of disparity in pixels, the focal length in pixels times the baseline, over disparity",
        file=file,
        field="depth_mm",
    )


def depth_disagreement(sequence: EndoscopicSequence) -> float | None:
    """By how much depth that the poses carry from frame to frame differs from that frame's own, relatively.

    Median over the points of a pair of neighbouring frames, mean over the pairs that overlap.

    Returns:
        None without poses or depth, and where most neighbours do not overlap.
    """
    if sequence.world_from_camera is None or sequence.depth_mm is None:
        return None
    pairs = _comparable_pairs(sequence)
    errors = _pair_errors(sequence, np.asarray(sequence.world_from_camera, dtype=np.float64), pairs)
    overlapping = [error for error in errors if error is not None]
    return float(np.mean(overlapping)) if len(overlapping) > len(pairs) / 2 else None


def _is_along_ray(
    sequence: EndoscopicSequence,
    poses: Float[np.ndarray, "f 4 4"],
    pairs: list[tuple[int, int]],
) -> bool:
    """Whether depth is the distance along the ray, as poses tell: `extrags.measured_depth` converts it."""
    readings = (_pair_errors(sequence, poses, pairs, along_ray=along) for along in (False, True))
    both = [(plain, along) for plain, along in zip(*readings, strict=True) if None not in (plain, along)]
    if len(both) <= len(pairs) / 2:
        return False
    plain, along = np.mean(np.array(both, dtype=np.float64), axis=0)
    return bool(plain > _RAY_SUSPICIOUS_ERROR and along <= _CLEARLY_ALONG_RAY * plain)


def _refuse_intrinsics_of_another_size(sequence: EndoscopicSequence, as_given: float, file: object) -> None:
    """Where poses and depth contradict each other: before either is blamed, an evident mistake in K is."""
    for index in range(len(sequence)):
        problem = another_size(sequence.K[index], sequence.width, sequence.height)
        if problem is not None:
            raise SourceError(
                f"{problem} (with it, depth that the poses carry from frame to frame is off by "
                f"{as_given:.0%} in the median)",
                file=file,
                frame=sequence.frame_name(index),
                field="K",
            )


def _is_proven_outside(sequence: EndoscopicSequence, pairs: list[tuple[int, int]], file: object) -> bool:
    """Before poses or units are blamed: whether they fit the depth that the mask leaves out.

    Returns:
        True where they do, and what the mask keeps tells nothing, since it is outside the next frame.

    Raises:
        SourceError: they do, and contradict the depth that the mask keeps.
    """
    turned = replace(sequence, mask=~sequence.mask)
    if not _are_wide(turned, pairs):
        return False
    poses = np.asarray(sequence.world_from_camera, dtype=np.float64)
    outside = _reprojection_error(turned, poses, pairs)
    if outside >= _SUSPICIOUS_ERROR:
        return False
    compared = [error for error in _pair_errors(sequence, poses, pairs) if error is not None]
    inside = float(np.mean(compared)) if compared else 0.0
    if inside < _SUSPICIOUS_ERROR:
        return True
    raise SourceError(
        f"depth carried from frame to frame is off by {inside:.0%} (median) where the mask keeps it, "
        f"and by {outside:.1%} where the mask leaves it out: the mask is inverted. Expected white on tissue",
        file=file,
        field="mask",
    )


def neighbouring_frames(sequence: EndoscopicSequence, at_most: int = _CHECKED_PAIRS) -> list[tuple[int, int]]:
    """Neighbouring frames of one recording, at most so many pairs, spread over the sequence."""
    recording = np.zeros(len(sequence), dtype=int) if sequence.recording is None else sequence.recording
    neighbours = [(k, k + 1) for k in range(len(sequence) - 1) if recording[k] == recording[k + 1]]
    if len(neighbours) <= at_most:
        return neighbours
    chosen = np.round(np.linspace(0, len(neighbours) - 1, at_most)).astype(int)
    return [neighbours[int(k)] for k in chosen]


def _comparable_pairs(
    sequence: EndoscopicSequence, at_least: float = _MIN_COMPARED_SHARE
) -> list[tuple[int, int]]:
    """Of `neighbouring_frames` those with depth, in both masks, for such a share of the image."""
    depth, mask = sequence.depth_mm, sequence.mask
    if depth is None:
        return []
    return [
        pair
        for pair in neighbouring_frames(sequence)
        if all(((depth[index] > 0) & mask[index]).mean() >= at_least for index in pair)
    ]


def _are_wide(sequence: EndoscopicSequence, pairs: list[tuple[int, int]]) -> bool:
    """Whether no pair compares a narrow part of the image alone."""
    return set(pairs) <= set(_comparable_pairs(sequence, _NARROW_SHARE))


def _reprojection_error(
    sequence: EndoscopicSequence,
    poses: Float[np.ndarray, "f 4 4"],
    pairs: list[tuple[int, int]],
    seen: list[Float[np.ndarray, "_ 3"]] | None = None,
    at_most: float = np.inf,
) -> float:
    """Relative difference of carried and found depth: median over a pair's points, mean over pairs.

    A pair of which too few points stay inside the image counts as 1.

    Args:
        sequence: with depth.
        poses: one reading of them.
        pairs: of frames.
        seen: `_seen_points` of the pairs, where several readings are compared.
        at_most: infinity is returned as soon as it is certain that the mean is more than this.
    """
    if sequence.depth_mm is None:
        return 0.0
    errors: list[float] = []
    # Of rounding: no mean that is as much as this may count as more.
    limit = at_most * len(pairs) * (1 + 1e-9)
    for k, pair in enumerate(pairs):
        (error,) = _pair_errors(sequence, poses, [pair], None if seen is None else seen[k : k + 1])
        errors.append(1.0 if error is None else error)
        if sum(errors) > limit:
            return np.inf
    return float(np.mean(errors))


def _pair_errors(
    sequence: EndoscopicSequence,
    poses: Float[np.ndarray, "f 4 4"],
    pairs: list[tuple[int, int]],
    seen: list[Float[np.ndarray, "_ 3"]] | None = None,
    *,
    along_ray: bool = False,
) -> list[float | None]:
    """Of each pair the median, at most 1; None where too few points stay inside the image.

    Args:
        sequence: with depth.
        poses: one reading of them.
        pairs: of frames.
        seen: `_seen_points` of the pairs, where several readings are compared.
        along_ray: whether depth is read as the distance along the ray.
    """
    if sequence.depth_mm is None:
        return []
    cameras = sequence.cameras
    seen = _seen_points(sequence, pairs) if seen is None else seen
    errors: list[float | None] = []
    for (first, second), points in zip(pairs, seen, strict=True):
        relative = invert_poses(poses[second][None])[0] @ poses[first]
        # Of a point at depth z on a ray, z times the ray: divided by the length of the ray it lies z away.
        there = (
            points * (points[:, 2:] / np.linalg.norm(points, axis=1, keepdims=True)) if along_ray else points
        )
        carried = transform_points(relative, there)
        pixels = project_points(carried, sequence.K[second], sequence.lens)
        inside = cameras.contains(pixels)
        column, row = pixels[inside].astype(np.int64).T
        found = sequence.depth_mm[second][row, column]
        comparable = found > 0
        if comparable.sum() < _MIN_INSIDE_SHARE * max(1, len(points)):
            errors.append(None)
            continue
        reached = carried[inside][comparable]
        distance = np.linalg.norm(reached, axis=1) if along_ray else reached[:, 2]
        expected = found[comparable].astype(np.float64)
        errors.append(min(1.0, float(np.median(np.abs(distance - expected) / expected))))
    return errors


def _seen_points(
    sequence: EndoscopicSequence, pairs: list[tuple[int, int]]
) -> list[Float[np.ndarray, "_ 3"]]:
    """Points of known depth of each pair's first frame, in its camera: the same for all readings of poses."""
    assert sequence.depth_mm is not None
    found = []
    for first, _ in pairs:
        v, u = _checked_pixels(sequence.depth_mm[first], sequence.mask[first])
        z = sequence.depth_mm[first][v, u].astype(np.float64)
        known = (z > 0) & sequence.mask[first][v, u]
        centers = np.stack([u[known], v[known]], axis=1) + 0.5
        found.append(unproject_pixels(centers, sequence.K[first], sequence.lens) * z[known, None])
    return found


def _checked_pixels(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Rows and columns of a grid over the image, finer where depth is known in a small part of it."""
    height, width = depth.shape
    stride = max(1, int(np.sqrt(height * width / _CHECKED_POINTS)))
    seen = slice(stride // 2, None, stride)
    share = float(((depth[seen, seen] > 0) & mask[seen, seen]).mean())
    if share < _NARROW_SHARE:
        stride = max(1, int(stride * np.sqrt(max(share, _MIN_COMPARED_SHARE))))
    v, u = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    return v.ravel(), u.ravel()
