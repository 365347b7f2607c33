"""Measured depth of training frames, carried by the poses to the frames that see the same surface.

Where depth, poses and intrinsics are right, it meets the depth that is measured there. What it is off by
tells of errors that frames have in common (`extrags.rig_calibration`) and of each frame's own
(`extrags.measured_depth`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import Cameras, project_points, transform_points, unproject_pixels
from extrags.errors import SourceError
from extrags.lens import Lens
from extrags.radial_lens import RadialLens
from extrags.sequence import EndoscopicSequence
from extrags.source_frames import select_sources

__all__ = ["MEDIAN", "CarriedDepth", "Correction", "Pair", "evenly", "relative_error"]

CHECKED_FRAMES = 60
"""Training frames at most that are carried to others, spread over the recording."""

COMPARED_WITH = 6
"""Frames each is carried to."""

WIDTH_PX = 256
"""Depth maps are looked up at every so many pixels that about this width is left."""

POINTS = 1500
"""Pixels of a frame that are carried, about."""

LEAST_POINTS = 100
"""Points that meet depth in the other frame, below which a pair tells nothing."""

CARRIED_TOGETHER = 6
"""Pairs: arrays of all at once would be given back to the system and asked for anew at each operation."""

LEAST_PAIRS = 12
"""Pairs below which a few that see the two sides of a fold decide; five frames have as many, mostly."""

SAME_SURFACE = 0.5
"""Log-ratio of depths beyond which a point is hidden by another surface."""

SMOOTH_STEP = 0.26
"""Log-ratio of the depths round a pixel up to which they are of one surface."""

ROUNDS = 3
"""Of reweighted least squares for the motion of a pair."""

STEP = 1e-3
"""Of its derivatives, in radians and in median depths of a frame."""

MEDIAN = float(np.sqrt(2) / 1.4826)
"""Median of the absolute difference of two depths, by the standard deviation of the error of either."""


@dataclass(frozen=True)
class Correction:
    """What is changed of all frames alike.

    Args:
        log_factor: logarithm of a factor on depth.
        offset: added to depth after that, in the sequence's unit.
        log_focal: logarithms of factors on both focal lengths.
        shift: of the principal point, as a share of the image's width.
        distortion: radial distortion of a lens that was said to be a pinhole, k of COLMAP's `DIVISION`: a
            pixel at r focal lengths from the principal point sees what a pinhole has at r / (1 + k r^2).
        time: in frames, by which each frame's pose is taken from later on the path of its recording.
        turn: of each camera about its own axes, a rotation vector in radians.
        move: of each camera along its own axes, in the sequence's unit.
    """

    log_factor: float = 0.0
    offset: float = 0.0
    log_focal: tuple[float, float] = (0.0, 0.0)
    shift: tuple[float, float] = (0.0, 0.0)
    distortion: float = 0.0
    time: float = 0.0
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    move: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def of_depth(self, depth: Float[np.ndarray, "*p"]) -> Float[np.ndarray, "*p"]:
        """Corrected depth; 0 stays 0, and so does what would lie behind the camera."""
        found = np.exp(self.log_factor) * depth + self.offset
        return np.asarray(np.where((depth > 0) & (found > 0), found, 0))

    def of_intrinsics(self, K: Float[np.ndarray, "*b 3 3"], width: float) -> Float[np.ndarray, "*b 3 3"]:
        """Corrected intrinsics of images of this width."""
        found = K.copy()
        found[..., 0, 0] *= np.exp(self.log_focal[0])
        found[..., 1, 1] *= np.exp(self.log_focal[1])
        found[..., :2, 2] += np.array(self.shift) * width
        return found

    def of_lens(
        self, K: Float[np.ndarray, "b 3 3"], lens: RadialLens | None, width: int, height: int
    ) -> tuple[Float[np.ndarray, "b 3 3"], RadialLens | None]:
        """Corrected intrinsics and lens of images of this size.

        Raises:
            SourceError: where the distortion folds back inside the image.
        """
        K = self.of_intrinsics(K, float(width))
        if self.distortion == 0:
            return K, lens
        corners = np.array([[x - K[0, 0, 2], y - K[0, 1, 2]] for x in (0, width) for y in (0, height)])
        if self.distortion * np.square(corners / K[0, [0, 1], [0, 1]]).sum(1).max() >= 1:
            raise SourceError("the distortion folds back inside the image", field="lens")
        linear = (float(K[0, 0, 0]), float(K[0, 1, 1]), float(K[0, 0, 2]), float(K[0, 1, 2]))
        fit = Lens("DIVISION", (*linear, self.distortion), width, height).radial()
        # All frames have one lens; only its linear part may be of the frame.
        K[:, [0, 1], [0, 1]] *= fit.K[0, 0] / K[0, 0, 0]
        return K, fit.lens

    def of_poses(
        self, world_from_camera: Float[np.ndarray, "f 4 4"], recording: Int[np.ndarray, "f"] | None = None
    ) -> Float[np.ndarray, "f 4 4"]:
        """Corrected poses.

        Args:
            world_from_camera: of all frames, in the order of the recording.
            recording: to which each belongs; None for one.
        """
        from scipy.spatial.transform import Rotation

        if self.time != 0:
            owner = np.zeros(len(world_from_camera), int) if recording is None else recording
            world_from_camera = world_from_camera.copy()
            for one in np.unique(owner):
                world_from_camera[owner == one] = _later(world_from_camera[owner == one], self.time)
        further = np.eye(4)
        further[:3, :3] = Rotation.from_rotvec(self.turn).as_matrix()
        further[:3, 3] = self.move
        return np.asarray(world_from_camera @ further)


@dataclass(frozen=True)
class Pair:
    """Two training frames, by their positions among these, that see the same surface."""

    first: int
    second: int


@dataclass
class CarriedDepth:
    """Depth of training frames, as it is looked up from other frames.

    Args:
        sequence: with poses and depth.
    """

    sequence: EndoscopicSequence
    cameras: Cameras = field(init=False)
    typical: Float[np.ndarray, "n"] = field(init=False)
    """Median depth of each training frame; 0 where none is known."""
    pairs: list[Pair] = field(init=False)

    def __post_init__(self) -> None:
        self._stride = max(1, round(self.sequence.width / WIDTH_PX))
        cameras = self.sequence.training_cameras
        K = cameras.K.copy()
        # The pixel that is kept is the middle one.
        K[:, :2, 2] -= self._stride // 2 + 0.5
        K[:, :2] /= self._stride
        K[:, :2, 2] += 0.5
        height, width = self.sequence.mask[0][self._kept].shape
        self.cameras = Cameras(K, cameras.world_from_camera, width, height, cameras.lens)
        self._ratios: dict[Pair, Float[np.ndarray, "p"]] = {}
        self._inverse_depth: dict[int, Float[np.ndarray, "h w"]] = {}
        self._pixels: dict[int, tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, "p"]]] = {}
        self.typical = np.array([_median(self.known(k)) for k in range(len(self.cameras))])
        self.pairs = self._found_pairs()

    @classmethod
    def of(cls, sequence: EndoscopicSequence) -> CarriedDepth | None:
        """That of a sequence.

        Args:
            sequence: with or without poses and depth.

        Returns:
            None without poses or measured depth, and where fewer than `LEAST_PAIRS` pairs share a surface.
        """
        if sequence.world_from_camera is None or sequence.depth_error is not None or len(sequence.train) < 2:
            return None
        if not sequence.training_depth_known:
            return None
        carried = cls(sequence)
        return carried if len(carried.pairs) >= LEAST_PAIRS else None

    def ratio(self, pair: Pair) -> Float[np.ndarray, "p"]:
        """That of `log_ratios` for one of the pairs, with everything as it is given."""
        return self._ratios[pair]

    def known(self, position: int) -> Float[np.ndarray, "h w"]:
        """Depth of a training frame inside its mask, else 0, at the pixels that are kept."""
        frame = int(self.sequence.train[position])
        assert self.sequence.depth_mm is not None
        depth, mask = (stack[frame][self._kept] for stack in (self.sequence.depth_mm, self.sequence.mask))
        return np.where(mask, depth, 0).astype(np.float64)

    @property
    def _kept(self) -> tuple[slice, slice]:
        kept = slice(self._stride // 2, None, self._stride)
        return kept, kept

    def log_ratios(
        self,
        pairs: Sequence[Pair],
        *,
        motions: Float[np.ndarray, "m 4 4"] | None = None,
        correction: Correction | None = None,
        along_ray: bool = False,
        every: int = 1,
    ) -> list[Float[np.ndarray, "_"]]:
        """Log of the depth that the second frame has where the first one's points fall, over theirs.

        Between pixels the inverse of depth is interpolated, which is linear over a plane. NaN where the
        pixels round a point are not of one surface, or unknown, or outside the image.

        Args:
            pairs: of frames.
            motions: from the first camera's axes to the second's, in place of those of the poses.
            correction: of what is common to all frames.
            along_ray: read depth as the distance along the ray.
            every: carry one in so many of the points.

        Returns:
            Of each pair, one for each of its points.
        """
        cameras = self.cameras
        if correction is not None:
            K, lens = correction.of_lens(cameras.K, cameras.lens, cameras.width, cameras.height)
            sequence = self.sequence
            poses = correction.of_poses(sequence.cameras.world_from_camera, sequence.recording)
            poses = poses[sequence.train]
            cameras = replace(cameras, K=K, lens=lens, world_from_camera=poses)
        if motions is None:
            first, second = ([getattr(pair, which) for pair in pairs] for which in ("first", "second"))
            poses = cameras.world_from_camera
            motions = np.linalg.inv(poses[second]) @ poses[first]
        found = []
        for begin in range(0, len(pairs), CARRIED_TOGETHER):
            some = slice(begin, begin + CARRIED_TOGETHER)
            found += self._log_ratios(pairs[some], cameras, motions[some], correction, along_ray, every)
        return found

    def _log_ratios(
        self,
        pairs: Sequence[Pair],
        cameras: Cameras,
        motions: Float[np.ndarray, "m 4 4"],
        correction: Correction | None,
        along_ray: bool,
        every: int,
    ) -> list[Float[np.ndarray, "_"]]:
        """`log_ratios` of a few pairs, by cameras that are corrected already."""
        lens, height, width = cameras.lens, cameras.height, cameras.width
        first, second = np.array([(pair.first, pair.second) for pair in pairs]).T
        of_first = [self._carried(position) for position in first.tolist()]
        centers = np.concatenate([centers[::every] for centers, _ in of_first])
        z = np.concatenate([depth[::every] for _, depth in of_first])
        counts = [len(depth[::every]) for _, depth in of_first]
        cuts = np.cumsum([0, *counts])
        z = z if correction is None else correction.of_depth(z)
        # Mostly those of all frames, which need not be repeated for each point.
        alike = bool((cameras.K[0] == cameras.K).all())
        of_ray, of_pixel = (
            cameras.K[0] if alike else np.repeat(cameras.K[which], counts, axis=0)
            for which in (first, second)
        )
        points = unproject_pixels(centers, of_ray, lens) * z[:, None]
        if along_ray:
            points = points * (z / np.linalg.norm(points, axis=1))[:, None]
        # Of all points one number of the matrix after the other, in which order they are used.
        of_points = np.repeat(motions.reshape(len(pairs), 16).T, counts, axis=1).reshape(4, 4, -1)
        carried = transform_points(np.moveaxis(of_points, -1, 0), points)
        reached = np.linalg.norm(carried, axis=1) if along_ray else carried[:, 2]
        u, v = project_points(carried, of_pixel, lens).T - 0.5
        with np.errstate(invalid="ignore"):
            inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
        inside &= (carried[:, 2] > 0) & (z > 0)
        u, v = u[inside], v[inside]
        column, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        right, down = u - column, v - row
        pixel = row * width + column
        corners = np.empty((4, len(pixel)))
        ends = np.concatenate([[0], np.cumsum(inside)])[cuts].tolist()
        for position, begin, end in zip(second.tolist(), ends[:-1], ends[1:], strict=True):
            inverse, of_pair = self._inverse(position).ravel(), pixel[begin:end]
            for corner, after in enumerate((0, 1, width, width + 1)):
                corners[corner, begin:end] = inverse[of_pair + after]
        # One corner after the other: reductions over so few numbers take several times as long.
        a, b, c, d = corners
        there = (1 - down) * (1 - right) * a
        there += (1 - down) * right * b
        there += down * (1 - right) * c
        there += down * right * d
        nearest = np.maximum(np.maximum(a, b), np.maximum(c, d))
        farthest = np.minimum(np.minimum(a, b), np.minimum(c, d))
        one_surface = (farthest > 0) & (nearest < np.exp(SMOOTH_STEP) * farthest)
        with np.errstate(divide="ignore", invalid="ignore"):
            there = 1 / there
            ratio = np.log(there if correction is None else correction.of_depth(there)) - np.log(
                reached[inside]
            )
        found = np.full(len(z), np.nan)
        found[inside] = np.where(one_surface & (np.abs(ratio) < SAME_SURFACE), ratio, np.nan)
        return [found[begin:end] for begin, end in pairwise(cuts)]

    def beyond_motion(self, pair: Pair) -> Float[np.ndarray, "p"]:
        """Log-ratios of a pair after the rigid motion between its cameras that makes them smallest.

        Gauss-Newton with the weights of a Cauchy distribution; the derivatives by differences, so that they
        hold for any lens.
        """
        poses, length = self.cameras.world_from_camera, float(self.typical[pair.first])
        motion = np.linalg.inv(poses[pair.second]) @ poses[pair.first]
        best = ratio = self.ratio(pair)
        for _ in range(ROUNDS):
            steps = np.stack([_moved(motion, step, length) for step in STEP * np.eye(6)])
            moved = self.log_ratios([pair] * len(steps), motions=steps)
            J = (np.stack(moved, axis=1) - ratio[:, None]) / STEP
            both = np.isfinite(ratio) & np.isfinite(J).all(1)
            if both.sum() < LEAST_POINTS:
                break
            spread = max(relative_error([ratio]) * np.sqrt(2), 1e-6)
            root = 1 / np.sqrt(1 + (ratio[both] / (2 * spread)) ** 2)
            step, *_ = np.linalg.lstsq(root[:, None] * J[both], -root * ratio[both], rcond=1e-6)
            motion = _moved(motion, step, length)
            (ratio,) = self.log_ratios([pair], motions=motion[None])
            if relative_error([ratio]) < relative_error([best]):
                best = ratio
        return best

    def sources(self, chosen: Int[np.ndarray, "k"]) -> dict[int, list[int]]:
        """The frames that some are compared with: they see the same surface from places that differ.

        Args:
            chosen: positions among the training frames.
        """
        typical = self.typical.copy()
        if not (typical > 0).any():
            return {}
        typical[typical == 0] = np.median(typical[typical > 0])
        poses, K = (part.astype(np.float64) for part in (self.cameras.world_from_camera, self.cameras.K))
        size = self.cameras.height, self.cameras.width
        found = select_sources(poses, K, size, typical, COMPARED_WITH, chosen)
        return {k: [other for other in found[k].tolist() if other >= 0] for k in chosen.tolist()}

    def _found_pairs(self) -> list[Pair]:
        """Pairs of some frames and their sources that meet enough of each other's surface."""
        found = []
        for position, others in self.sources(evenly(len(self.cameras), CHECKED_FRAMES)).items():
            pairs = [Pair(position, other) for other in others]
            for pair, ratio in zip(pairs, self.log_ratios(pairs), strict=True):
                if np.isfinite(ratio).sum() >= LEAST_POINTS:
                    self._ratios[pair] = ratio
                    found.append(pair)
        return found

    def _carried(self, position: int) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, "p"]]:
        """Pixels of a frame on a grid, and their depth."""
        if position not in self._pixels:
            depth = self.known(position)
            stride = max(1, int(np.sqrt(depth.size / POINTS)))
            v, u = np.mgrid[stride // 2 : depth.shape[0] : stride, stride // 2 : depth.shape[1] : stride]
            v, u = v.ravel(), u.ravel()
            known = depth[v, u] > 0
            centers = np.stack([u[known], v[known]], axis=1) + 0.5
            self._pixels[position] = centers, depth[v, u][known]
        return self._pixels[position]

    def _inverse(self, position: int) -> Float[np.ndarray, "h w"]:
        if position not in self._inverse_depth:
            depth = self.known(position)
            self._inverse_depth[position] = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
        return self._inverse_depth[position]


def _moved(
    motion: Float[np.ndarray, "4 4"], step: Float[np.ndarray, "6"], length: float
) -> Float[np.ndarray, "4 4"]:
    """A motion, then a turn in radians and a shift in `length`, of the second camera's axes."""
    from scipy.spatial.transform import Rotation

    further = np.eye(4)
    further[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    further[:3, 3] = length * step[3:]
    return np.asarray(further @ motion)


def _later(poses: Float[np.ndarray, "f 4 4"], frames: float) -> Float[np.ndarray, "f 4 4"]:
    """Poses of a path so many frames later: splines between its own, beyond them as if it went on evenly."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(poses) < 2:
        return poses
    place = np.arange(len(poses)) + frames
    before = np.clip(np.floor(place).astype(np.int64), 0, len(poses) - 2)
    share = place - before
    here, there = poses[before], poses[before + 1]
    turn = Rotation.from_matrix(np.swapaxes(here[:, :3, :3], 1, 2) @ there[:, :3, :3]).as_rotvec()
    found = here.copy()
    found[:, :3, :3] = here[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    found[:, :3, 3] += share[:, None] * (there[:, :3, 3] - here[:, :3, 3])
    inside = (place >= 0) & (place <= len(poses) - 1)
    if len(poses) > 2 and inside.any():
        times = np.arange(len(poses))
        turned = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))(place[inside])
        found[inside, :3, :3] = turned.as_matrix()
        found[inside, :3, 3] = CubicSpline(times, poses[:, :3, 3])(place[inside])
    return np.asarray(found)


def relative_error(ratios: list[Float[np.ndarray, "_"]]) -> float:
    """Relative error of depth that explains log-ratios, a median.

    Of points that the other frame looks through alone (a ratio above 0): those behind its surface may be
    hidden by it, and most are where two frames see the two sides of a fold. An error of either frame makes as
    many of the one as of the other, in one direction of a pair or in both. NaN does not count.

    Args:
        ratios: from `CarriedDepth.log_ratios`.
    """
    known = np.concatenate([ratio[ratio > 0] for ratio in ratios]) if ratios else np.zeros(0)
    return float(np.median(known) / MEDIAN) if len(known) else 0.0


def evenly(count: int, at_most: int) -> np.ndarray:
    """Up to so many of the first `count` indices, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, at_most)).round().astype(np.int64))


def _median(depth: Float[np.ndarray, "h w"]) -> float:
    known = depth[depth > 0]
    return float(np.median(known)) if len(known) else 0.0
