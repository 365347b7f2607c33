"""How far training frames disagree about their measured depth, and what is made of it.

Measured depth is taken as it is: Gaussians start on all of it, and the loss draws them to it. Depth maps that
are off by some percent, each in its own way, as those of a stereo matcher or a monocular network are, start a
shell round the surface instead. Frames tell: depth that poses carry from one frame to another meets what is
measured there, or it does not. Poses that are off cause differences too, but such as a rigid motion between
the two cameras takes away. What is left beyond that is the depth's own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from extrags.cameras import Cameras, project_points, transform_points, unproject_pixels
from extrags.frame_stacks import stacked
from extrags.sequence import EndoscopicSequence
from extrags.source_frames import select_sources

__all__ = ["MeasuredDepthError", "as_given", "measured_depth_error", "with_depth_error"]

_log = logging.getLogger(__name__)

_TOPIC = {"topic": "depth and poses", "field": "depth_mm"}
"""Of warnings, for tables of what is questionable in a source."""

LEAST_ERROR = 0.01
"""Of depth, beyond any motion of the frames, from which on it is not taken as it is. Exact depth has at most
0.0003, in steps of eight bits 0.007, with poses that are off by 2 % of the depth and a degree 0.002, with a
focal length that is off by 5 % 0.002; smooth errors of 2 % 0.011 to 0.016 (docs/experiments/depth.md)."""

CHECKED_FRAMES = 60
"""Training frames at most that are compared with others, spread over the recording."""

COMPARED_WITH = 6
"""Frames each is compared with."""

POINTS = 1500
"""Pixels of a frame that are carried to others, about."""

FITTED_PAIRS = 40
"""Pairs at most whose motion is fitted, and that tell the unit."""

EXACT = 0.003
"""Error of depth that is not looked into any further."""

LEAST_POINTS = 100
"""Points that meet depth in the other frame, below which a pair tells nothing."""

SAME_SURFACE = 0.5
"""Log-ratio of depths beyond which a point is hidden by another surface."""

SMOOTH_STEP = 0.26
"""Log-ratio of the depths round a pixel up to which they are of one surface."""

ROUNDS = 3
"""Of reweighted least squares for the motion of a pair."""

LOG_FACTORS = np.linspace(-0.5, 0.5, 21)
"""Logarithms of factors on depth that are tried; beyond them readers refuse a source."""

LEAST_LOG_FACTOR = 0.015
"""Logarithm of a factor that is corrected."""

CLEARLY_LESS = 0.5
"""Share of the disagreement that is left, at most, where depth is in another unit than the poses."""

CLEARLY_ALONG_RAY = 0.25
"""Share of the disagreement that is left, at most, where depth is the distance along the ray: where a scope
moves little, either reading carries nearly as well."""

_NORMAL = 1.4826 / np.sqrt(2)
"""Standard deviation of one of two equal errors, by the median of the absolute difference."""


@dataclass(frozen=True)
class MeasuredDepthError:
    """What frames tell of each other's measured depth.

    Args:
        error: relative error of depth that would explain the differences; a median over all pairs.
        beyond_motion: the same after the best rigid motion of each pair is taken out.
        frame_error: relative error of each training frame, [N]; `error` for frames that were not compared.
        unit: factor on all depth with which it agrees with the poses; 1 where no other does clearly better.
        along_ray: whether it agrees clearly better when it is read as the distance along each pixel's ray.
        pairs: how many pairs of frames met enough of each other's surface.
    """

    error: float
    beyond_motion: float
    frame_error: Float[np.ndarray, "n"]
    unit: float
    along_ray: bool
    pairs: int


@dataclass(frozen=True)
class _Pair:
    """Two training frames, by their positions among these, that see the same surface."""

    first: int
    second: int


class _Frames:
    """Depth of training frames, as it is looked up from other frames."""

    def __init__(self, sequence: EndoscopicSequence) -> None:
        assert sequence.depth_mm is not None
        self.sequence = sequence
        self.cameras: Cameras = sequence.training_cameras
        self._inverse_depth: dict[int, Float[np.ndarray, "h w"]] = {}
        self._points: dict[int, Float[np.ndarray, "p 3"]] = {}

    def known(self, position: int) -> Float[np.ndarray, "h w"]:
        """Depth of a training frame inside its mask, else 0."""
        frame = int(self.sequence.train[position])
        assert self.sequence.depth_mm is not None
        return np.where(self.sequence.mask[frame], self.sequence.depth_mm[frame], 0).astype(np.float64)

    def points(self, position: int) -> Float[np.ndarray, "p 3"]:
        """Surface points of a frame on a grid of pixels, in its camera's axes."""
        if position not in self._points:
            depth = self.known(position)
            stride = max(1, int(np.sqrt(depth.size / POINTS)))
            v, u = np.mgrid[stride // 2 : depth.shape[0] : stride, stride // 2 : depth.shape[1] : stride]
            v, u = v.ravel(), u.ravel()
            z = depth[v, u]
            known = z > 0
            centers = np.stack([u[known], v[known]], axis=1) + 0.5
            rays = unproject_pixels(centers, self.cameras.K[position], self.cameras.lens)
            self._points[position] = np.asarray(rays * z[known, None])
        return self._points[position]

    def log_ratio(
        self, pair: _Pair, motion: Float[np.ndarray, "4 4"], *, along_ray: bool = False
    ) -> Float[np.ndarray, "p"]:
        """Log of the depth that the second frame has where the first one's points fall, over theirs.

        Between pixels the inverse of depth is interpolated, which is linear over a plane. NaN where the
        pixels round a point are not of one surface, or unknown, or outside the image.

        Args:
            pair: of frames.
            motion: from the first camera's axes to the second's.
            along_ray: read depth as the distance along the ray.
        """
        points = self.points(pair.first)
        if along_ray:
            points = points * (points[:, 2:] / np.linalg.norm(points, axis=1, keepdims=True))
        carried = transform_points(motion, points)
        reached = np.linalg.norm(carried, axis=1) if along_ray else carried[:, 2]
        pixels = project_points(carried, self.cameras.K[pair.second], self.cameras.lens) - 0.5
        inverse = self._inverse(pair.second)
        height, width = inverse.shape
        with np.errstate(invalid="ignore"):
            inside = (pixels >= 0).all(1) & (pixels[:, 0] < width - 1) & (pixels[:, 1] < height - 1)
        inside &= carried[:, 2] > 0
        column, row = np.floor(pixels[inside]).astype(np.int64).T
        right, down = (pixels[inside] - np.stack([column, row], axis=1)).T
        corners = np.stack([inverse[row + j, column + i] for j in (0, 1) for i in (0, 1)])
        shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
        nearest, farthest = corners.max(0), corners.min(0)
        one_surface = (farthest > 0) & (nearest < np.exp(SMOOTH_STEP) * farthest)
        with np.errstate(divide="ignore"):
            ratio = -np.log((shares * corners).sum(0)) - np.log(reached[inside])
        found = np.full(len(points), np.nan)
        found[inside] = np.where(one_surface & (np.abs(ratio) < SAME_SURFACE), ratio, np.nan)
        return found

    def _inverse(self, position: int) -> Float[np.ndarray, "h w"]:
        if position not in self._inverse_depth:
            depth = self.known(position)
            self._inverse_depth[position] = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
        return self._inverse_depth[position]

    def motion(self, pair: _Pair, scale: float = 1.0) -> Float[np.ndarray, "4 4"]:
        """From the first camera to the second, in the unit of depth over `scale`."""
        poses = self.cameras.world_from_camera
        motion = np.linalg.inv(poses[pair.second]) @ poses[pair.first]
        motion[:3, 3] /= scale
        return np.asarray(motion)


def measured_depth_error(sequence: EndoscopicSequence) -> MeasuredDepthError | None:
    """How far training frames disagree about their depth.

    Args:
        sequence: with poses and depth of training frames.

    Returns:
        None without poses or depth, or where no two frames see enough of the same surface.
    """
    if sequence.world_from_camera is None or not sequence.training_depth_known or len(sequence.train) < 2:
        return None
    frames = _Frames(sequence)
    pairs = _pairs(frames)
    return _error_of(frames, pairs) if pairs else None


def with_depth_error(
    sequence: EndoscopicSequence, error: float | Literal["auto"] = "auto"
) -> EndoscopicSequence:
    """The sequence, its measured depth with the error that frames find in it.

    Where they agree, and where depth is estimated or unknown, the sequence is returned as it is. Else depth
    has an expected error (`EndoscopicSequence.depth_error`) from here on, so that the depth stage looks for a
    better one (`extrags.depth.combination`), and what was measured stays beside it for the evaluation. Depth
    in another unit than the poses, or along the ray, is converted first. Warnings tell of all this.

    Args:
        sequence: in the unit of its poses.
        error: relative error of all depth; auto: as training frames tell, frame by frame.
    """
    if sequence.depth_mm is None or sequence.depth_error is not None or not sequence.training_depth_known:
        return sequence
    if error != "auto":
        return _uncertain(sequence, np.full(len(sequence.train), error)) if error > 0 else sequence
    found = measured_depth_error(sequence)
    if found is not None and (found.along_ray or found.unit != 1):
        sequence = _converted(sequence, found)
        found = measured_depth_error(sequence)
    if found is None or found.beyond_motion < LEAST_ERROR:
        return sequence
    _log.warning(
        "%s: training frames disagree about their depth by %.1f %%, as if each were off by %.1f %% in its "
        "own way; it is corrected by what is estimated from the images (ingest.depth_error)",
        sequence.name,
        100 * found.error * np.sqrt(2),
        100 * found.error,
        extra=_TOPIC,
    )
    return _uncertain(sequence, found.frame_error)


def _converted(sequence: EndoscopicSequence, found: MeasuredDepthError) -> EndoscopicSequence:
    """With z-depth in the unit of the poses, which a warning tells of."""
    off = 100 * found.error * np.sqrt(2)
    if found.along_ray:
        _log.warning(
            "%s: depth that the poses carry from frame to frame is off by %.1f %% (median), but fits when it "
            "is read as the distance along each pixel's ray; it is converted to z-depth, the distance along "
            "the optical axis (ingest.depth_error=0 takes it as it is)",
            sequence.name,
            off,
            extra=_TOPIC,
        )
        return _multiplied(sequence, lambda frame: 1 / _ray_lengths(sequence, frame))
    _log.warning(
        "%s: depth and poses are in different units: carried from frame to frame depth is off by %.1f %% "
        "(median), and fits when it is multiplied by %.3f, which is done: lengths are those of the poses "
        "(ingest.depth_error=0 takes it as it is)",
        sequence.name,
        off,
        found.unit,
        extra=_TOPIC,
    )
    return _multiplied(sequence, lambda frame: found.unit)


def as_given(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """A sequence from `with_depth_error` without the expected error, which holds for its poses alone."""
    if sequence.depth_error is None:
        return sequence
    return replace(sequence, depth_error=None, withheld_depth_mm=None)


def _uncertain(sequence: EndoscopicSequence, of_training: Float[np.ndarray, "n"]) -> EndoscopicSequence:
    """With a relative error of each training frame's depth; of the others the median of these."""
    of_frame = np.full(len(sequence), np.median(of_training))
    of_frame[sequence.train] = of_training
    size = (sequence.height, sequence.width)
    depth_error = stacked((np.full(size, error, np.float32) for error in of_frame), len(of_frame))
    true = sequence.depth_mm if sequence.withheld_depth_mm is None else sequence.withheld_depth_mm
    return replace(sequence, depth_error=depth_error, withheld_depth_mm=true)


def _ray_lengths(sequence: EndoscopicSequence, frame: int) -> Float[np.ndarray, "h w"]:
    """Distance along each pixel's ray where z-depth is 1."""
    v, u = np.mgrid[: sequence.height, : sequence.width]
    centers = np.stack([u.ravel(), v.ravel()], axis=1) + 0.5
    rays = unproject_pixels(centers, sequence.K[frame], sequence.lens)
    return np.asarray(np.linalg.norm(rays, axis=1).reshape(sequence.height, sequence.width))


def _multiplied(
    sequence: EndoscopicSequence, factor: Callable[[int], float | Float[np.ndarray, "h w"]]
) -> EndoscopicSequence:
    """With all depth multiplied, frame by frame."""

    def longer(depth_mm: np.ndarray | None) -> np.ndarray | None:
        if depth_mm is None:
            return None
        frames = (np.nan_to_num(depth * factor(k)).astype(depth.dtype) for k, depth in enumerate(depth_mm))
        return stacked(frames, len(depth_mm))

    return replace(
        sequence,
        depth_mm=longer(sequence.depth_mm),
        withheld_depth_mm=longer(sequence.withheld_depth_mm),
    )


def _error_of(frames: _Frames, pairs: list[_Pair]) -> MeasuredDepthError:
    ratios = [_finite(frames.log_ratio(pair, frames.motion(pair))) for pair in pairs]
    error = _error(np.concatenate(ratios))
    some = [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, FITTED_PAIRS).round().astype(int))]
    beyond = error
    if error > EXACT:
        beyond = _error(np.concatenate([_beyond_motion(frames, pair) for pair in some]))
    frame_error = np.full(len(frames.cameras), error)
    for position in {pair.first for pair in pairs}:
        own = [r for pair, r in zip(pairs, ratios, strict=True) if pair.first == position]
        # The difference has the error of the other frame in it, which is taken to be as large as most are.
        square = 2 * _error(np.concatenate(own)) ** 2 - error**2
        frame_error[position] = np.sqrt(max(square, (error / 2) ** 2))
    unit, along_ray = _unit(frames, some, error, beyond), _is_along_ray(frames, some, error)
    return MeasuredDepthError(error, beyond, frame_error, unit, along_ray, len(pairs))


def _is_along_ray(frames: _Frames, pairs: list[_Pair], error: float) -> bool:
    """Whether depth agrees clearly better when it is read as the distance along the ray."""
    if error <= LEAST_ERROR:
        return False
    ratios = (_finite(frames.log_ratio(pair, frames.motion(pair), along_ray=True)) for pair in pairs)
    return _error(np.concatenate(list(ratios))) < CLEARLY_ALONG_RAY * error


def _unit(frames: _Frames, pairs: list[_Pair], error: float, beyond: float) -> float:
    """The factor on depth with which it agrees with the poses, 1 where it does as it is, or with none."""
    if error <= EXACT or beyond > CLEARLY_LESS * error:
        return 1.0
    from scipy.optimize import minimize_scalar

    def error_with(log_factor: float) -> float:
        # Depth times a factor beside these poses is this depth beside poses that move by less.
        factor = float(np.exp(log_factor))
        found = (_finite(frames.log_ratio(pair, frames.motion(pair, factor))) for pair in pairs)
        return _error(np.concatenate(list(found)))

    tried = np.array([error_with(value) for value in LOG_FACTORS])
    best = int(tried.argmin())
    if not 0 < best < len(tried) - 1:
        return 1.0
    within = (float(LOG_FACTORS[best - 1]), float(LOG_FACTORS[best + 1]))
    search = minimize_scalar(error_with, bounds=within, method="bounded", options={"xatol": 1e-3})
    found, left = float(search.x), float(search.fun)
    return float(np.exp(found)) if abs(found) >= LEAST_LOG_FACTOR and left < CLEARLY_LESS * error else 1.0


def _finite(ratios: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
    return np.asarray(ratios[np.isfinite(ratios)])


def _error(ratios: Float[np.ndarray, "n"]) -> float:
    return float(_NORMAL * np.median(np.abs(ratios))) if len(ratios) else 0.0


def _pairs(frames: _Frames) -> list[_Pair]:
    """Pairs of training frames that see the same surface from places that differ."""
    cameras = frames.cameras
    count = len(cameras)
    typical = np.ones(count)
    for position in range(count):
        known = frames.known(position)
        known = known[known > 0]
        typical[position] = np.median(known) if len(known) else 0
    if not (typical > 0).any():
        return []
    typical[typical == 0] = np.median(typical[typical > 0])
    chosen = np.unique(np.linspace(0, count - 1, min(count, CHECKED_FRAMES)).round().astype(np.int64))
    poses, size = cameras.world_from_camera.astype(np.float64), (cameras.height, cameras.width)
    sources = select_sources(poses, cameras.K.astype(np.float64), size, typical, COMPARED_WITH)
    found = []
    for position in chosen.tolist():
        for other in sources[position][sources[position] >= 0].tolist():
            pair = _Pair(position, other)
            if np.isfinite(frames.log_ratio(pair, frames.motion(pair))).sum() >= LEAST_POINTS:
                found.append(pair)
    return found


def _beyond_motion(frames: _Frames, pair: _Pair) -> Float[np.ndarray, "n"]:
    """Log-ratios of a pair after the rigid motion that makes them smallest.

    Gauss-Newton with the weights of a Cauchy distribution; the derivative by differences, so that it holds
    for any lens.
    """
    motion = frames.motion(pair)
    length = float(np.median(frames.points(pair.first)[:, 2]))
    best = frames.log_ratio(pair, motion)
    for _ in range(ROUNDS):
        ratio = frames.log_ratio(pair, motion)
        columns = []
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-3
            columns.append((frames.log_ratio(pair, _moved(motion, step, length)) - ratio) / 1e-3)
        J = np.stack(columns, axis=1)
        both = np.isfinite(ratio) & np.isfinite(J).all(1)
        if both.sum() < LEAST_POINTS:
            break
        if _error(ratio[np.isfinite(ratio)]) < _error(best[np.isfinite(best)]):
            best = ratio
        spread = max(_error(ratio[both]) * np.sqrt(2), 1e-6)
        root = 1 / np.sqrt(1 + (ratio[both] / (2 * spread)) ** 2)
        step, *_ = np.linalg.lstsq(root[:, None] * J[both], -root * ratio[both], rcond=1e-6)
        motion = _moved(motion, step, length)
    return np.asarray(best[np.isfinite(best)])


def _moved(
    motion: Float[np.ndarray, "4 4"], step: Float[np.ndarray, "6"], length: float
) -> Float[np.ndarray, "4 4"]:
    """A motion, then a turn in radians and a shift in `length`, of the second camera's axes."""
    from scipy.spatial.transform import Rotation

    further = np.eye(4)
    further[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    further[:3, 3] = length * step[3:]
    return np.asarray(further @ motion)
