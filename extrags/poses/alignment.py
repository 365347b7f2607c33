"""Alignment of frames with depth: point to plane, and texture to texture.

World-frame twists (turn, shift) are estimated by Gauss-Newton. A residual between a moving and a reference
frame depends on the difference of their two twists alone, so the equations of a pair, found once, serve a
single frame against fixed ones as well as all frames together.

Sources: Chen and Medioni: Object modelling by registration of multiple range images, IVC 1992 (point to
plane); Kerl, Sturm and Cremers: Dense visual SLAM for RGB-D cameras, IROS 2013 (both terms, robust weights).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from extrags.cameras import invert_poses, project_points
from extrags.poses.depth_views import LEVELS, DepthView

__all__ = ["Agreement", "Posed", "agreement", "align", "moved", "pair_equations", "solve_twists"]

REACH = (0.15, 0.1, 0.05, 0.03)
"""Per level: points farther than this share of their depth from the surface they fall on do not count."""
STRIDES = (3, 3, 2, 1)
"""Per level: stride over the samples; coarse levels need only an approximate pose."""
AGREES = 0.02
"""Share of the depth within which two frames show the same surface."""
ITERATIONS = 8
SMALLEST_STEPS = (1e-3, 3e-4, 1e-4, 1e-5)
"""Per level, in radians and depths: a smaller update ends the iteration."""
MIN_POINTS = 60
MIN_GEOMETRIC_SCALE = 5e-4
MIN_TEXTURE_SCALE = 0.05
TUKEY = 4.7
NEAR_SHARE = 1e-3


@dataclass(frozen=True)
class Posed:
    """A frame and where it is."""

    view: DepthView
    world_from_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Equations:
    """Normal equations of a pair, for the moving frame's twist about a centre: `A x = b`."""

    A: Float[np.ndarray, "6 6"]
    b: Float[np.ndarray, "6"]
    count: int


@dataclass(frozen=True)
class Agreement:
    """How well a frame fits others.

    Args:
        overlap: share of its points that fall into another frame, on nothing that hides them.
        surface: share of these that meet the other's surface.
        texture: correlation of the finest texture there, 0 where there is none.
        residual_mm: median distance from the surface met, in the unit of the depth.
    """

    overlap: float
    surface: float
    texture: float
    residual_mm: float

    @property
    def score(self) -> float:
        """For the choice among poses; overlap hardly counts, or frames would huddle together."""
        return self.surface + max(self.texture, 0.0) + 0.1 * self.overlap


def align(
    view: DepthView,
    start: Float[np.ndarray, "4 4"],
    references: Sequence[Posed],
    *,
    first_level: int = 0,
) -> Float[np.ndarray, "4 4"]:
    """Pose of a frame against fixed ones, from coarse to fine.

    Args:
        view: the frame.
        start: a guess.
        references: what it is held against.
        first_level: skip the coarser levels for a good guess.

    Returns:
        `world_from_camera`; the last pose with enough overlap where the frames cease to overlap.
    """
    pose = start.copy()
    for level in range(first_level, len(LEVELS)):
        for _ in range(ITERATIONS):
            parts = [pair_equations(Posed(view, pose), other, level, pose[:3, 3]) for other in references]
            if sum(part.count for part in parts) < MIN_POINTS:
                return pose
            A, b = np.sum([part.A for part in parts], axis=0), np.sum([part.b for part in parts], axis=0)
            twist = _solved(A, b, view.median_depth)
            pose = moved(pose, twist, pose[:3, 3])
            scaled = np.abs(twist) / np.repeat([1.0, view.median_depth], 3)
            if scaled.max() < SMALLEST_STEPS[level]:
                break
    return pose


def pair_equations(moving: Posed, reference: Posed, level: int, centre: Float[np.ndarray, "3"]) -> Equations:
    """Gauss-Newton equations of one frame against another.

    Args:
        moving: its samples are projected.
        reference: into this one.
        level: of `LEVELS`.
        centre: world point the turn is about.
    """
    met = _met(moving, reference, REACH[level], level)
    if met is None:
        return Equations(np.zeros((6, 6)), np.zeros(6), 0)
    to_world = reference.world_from_camera[:3, :3]
    arm = met.points @ to_world.T + reference.world_from_camera[:3, 3] - centre
    A, b = np.zeros((6, 6)), np.zeros(6)

    normals = met.normals @ to_world.T
    distance = (met.normals * (met.points - met.surface)).sum(-1)
    jacobian = np.concatenate([np.cross(arm, normals), normals], axis=1)
    scale = max(1.4826 * float(np.median(np.abs(distance))), MIN_GEOMETRIC_SCALE * met.depth)
    weight = _tukey(distance / scale) / scale**2
    A += (jacobian * weight[:, None]).T @ jacobian
    b -= (jacobian * weight[:, None]).T @ distance

    if len(met.textured) >= MIN_POINTS:
        rows = met.textured
        for channel in range(2):
            found, along_x, along_y = met.texture[:, channel].T
            difference = found - met.own_texture[:, channel]
            x, y, z = met.points[rows].T
            fx, fy = reference.view.K[0, 0], reference.view.K[1, 1]
            gradient = np.stack(
                [along_x * fx / z, along_y * fy / z, -(along_x * fx * x + along_y * fy * y) / z**2], axis=1
            )
            gradient = gradient @ to_world.T
            jacobian = np.concatenate([np.cross(arm[rows], gradient), gradient], axis=1)
            scale = max(1.4826 * float(np.median(np.abs(difference))), MIN_TEXTURE_SCALE)
            weight = _tukey(difference / scale) / scale**2
            A += (jacobian * weight[:, None]).T @ jacobian
            b -= (jacobian * weight[:, None]).T @ difference
    return Equations(A, b, len(distance))


def solve_twists(
    pairs: Sequence[tuple[int, int, Equations]], count: int, unit: float
) -> Float[np.ndarray, "c 6"]:
    """Twists of all frames from the equations of pairs; the first frame stays.

    Args:
        pairs: (moving, reference, equations), all about one centre.
        count: number of frames.
        unit: length that a turn of one radian is compared with.
    """
    size = 6 * count
    A, b = np.zeros((size, size)), np.zeros(size)
    for moving, reference, equations in pairs:
        i, j = np.s_[6 * moving : 6 * moving + 6], np.s_[6 * reference : 6 * reference + 6]
        A[i, i] += equations.A
        A[j, j] += equations.A
        A[i, j] -= equations.A
        A[j, i] -= equations.A
        b[i] += equations.b
        b[j] -= equations.b
    twists = np.zeros(size)
    twists[6:] = _solved(A[6:, 6:], b[6:], unit)
    return twists.reshape(count, 6)


def moved(
    pose: Float[np.ndarray, "4 4"], twist: Float[np.ndarray, "6"], centre: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """A pose turned about a world point and shifted."""
    turn = Rotation.from_rotvec(twist[:3]).as_matrix()
    result = pose.copy()
    result[:3, :3] = turn @ pose[:3, :3]
    result[:3, 3] = turn @ (pose[:3, 3] - centre) + centre + twist[3:]
    return result


def agreement(moving: Posed, references: Sequence[Posed]) -> Agreement:
    """How well a frame fits fixed ones, over all of them together."""
    seen, agree = 0, 0
    residuals: list[np.ndarray] = []
    first: list[np.ndarray] = []
    second: list[np.ndarray] = []
    finest = len(LEVELS) - 1
    for reference in references:
        # A generous reach, so that what contradicts is counted and not left out.
        met = _met(moving, reference, 0.5, finest)
        if met is None:
            continue
        distance = np.abs((met.normals * (met.points - met.surface)).sum(-1))
        close = np.linalg.norm(met.points - met.surface, axis=1) < REACH[0] * met.points[:, 2]
        fits = close & (distance < AGREES * met.points[:, 2])
        seen += len(fits)
        agree += int(fits.sum())
        residuals.append(distance[fits])
        both = fits[met.textured]
        first.append(met.texture[both, 0, 0])
        second.append(met.own_texture[both, 0])
    if seen < MIN_POINTS or agree == 0:
        return Agreement(0.0, 0.0, 0.0, float("inf"))
    a, b = np.concatenate(first), np.concatenate(second)
    texture = 0.0
    if len(a) >= MIN_POINTS and a.std() > 1e-3 and b.std() > 1e-3:
        texture = float(np.corrcoef(a, b)[0, 1])
    overlap = seen / (len(moving.view.samples) * len(references))
    return Agreement(overlap, agree / seen, texture, float(np.median(np.concatenate(residuals))))


@dataclass(frozen=True)
class _Met:
    """Samples of one frame that fall on the surface another shows, in the other's camera axes."""

    points: np.ndarray
    surface: np.ndarray
    normals: np.ndarray
    depth: float
    textured: np.ndarray
    """Rows of the arrays above whose texture can be compared."""
    texture: np.ndarray
    """Of the other frame, [rows, 2, 3]."""
    own_texture: np.ndarray
    """Of the moving frame, [rows, 2]."""


def _met(moving: Posed, reference: Posed, reach: float, level: int) -> _Met | None:
    view, other = moving.view, reference.view
    height, width = other.valid.shape
    between = invert_poses(reference.world_from_camera) @ moving.world_from_camera
    samples = view.samples[:: STRIDES[level]]
    points = view.points.reshape(-1, 3)[samples] @ between[:3, :3].T + between[:3, 3]
    z = points[:, 2]
    u, v = project_points(points, other.K).T
    inside = z > NEAR_SHARE * other.median_depth
    inside &= (u >= 1) & (u < width - 1) & (v >= 1) & (v < height - 1)
    rows = np.flatnonzero(inside)
    pixel = np.floor(v[rows]).astype(np.int64) * width + np.floor(u[rows]).astype(np.int64)
    surface = other.points.reshape(-1, 3)[pixel]
    normals = other.normals.reshape(-1, 3)[pixel]
    turned = view.normals.reshape(-1, 3)[samples[rows]] @ between[:3, :3].T
    counts = other.valid.reshape(-1)[pixel] & ((turned * normals).sum(-1) > 0.3)
    counts &= np.linalg.norm(points[rows] - surface, axis=1) < reach * z[rows]
    if int(counts.sum()) < MIN_POINTS:
        return None
    rows, pixel = rows[counts], pixel[counts]
    textured = np.flatnonzero(other.textured.reshape(-1)[pixel] & view.textured.reshape(-1)[samples[rows]])
    chosen = rows[textured]
    own = view.texture[level].reshape(-1, 2, 3)[samples[chosen]][:, :, 0]
    return _Met(
        points=points[rows],
        surface=surface[counts],
        normals=normals[counts],
        depth=float(np.median(z[rows])),
        textured=textured,
        texture=_bilinear(other.texture[level], u[chosen] - 0.5, v[chosen] - 0.5),
        own_texture=own,
    )


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[n, ...] of an image [h, w, ...] at array coordinates inside it."""
    height, width = image.shape[:2]
    column = np.clip(np.floor(x).astype(np.int64), 0, width - 2)
    row = np.clip(np.floor(y).astype(np.int64), 0, height - 2)
    a = (x - column)[:, None, None]
    b = (y - row)[:, None, None]
    top = (1 - a) * image[row, column] + a * image[row, column + 1]
    bottom = (1 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return np.asarray((1 - b) * top + b * bottom)


def _tukey(ratio: np.ndarray) -> np.ndarray:
    """Weights that fall to zero for residuals far beyond the usual."""
    inside = np.clip(1 - (ratio / TUKEY) ** 2, 0, None)
    return np.asarray(inside**2)


def _solved(A: np.ndarray, b: np.ndarray, unit: float) -> np.ndarray:
    """Slightly damped: in a straight tube without texture the motion along the axis is undetermined."""
    size = np.tile(np.repeat([1.0, unit], 3), len(b) // 6)
    scaled = A * np.outer(size, size)
    damping = 1e-6 * np.trace(scaled) / len(b) + 1e-12
    return np.asarray(size * np.linalg.solve(scaled + damping * np.eye(len(b)), b * size))
