r"""Anatomy of the phantom: a bent tube with semilunar folds, taeniae, polyps and two closed ends.

The wall is a regular grid over (u, theta): u runs along the profile of the tube in mm (over one cap,
the tube, the other cap), theta round the axis. Every surface point therefore has stable coordinates,
and everything painted on the wall is the same in every recording.

Lengths are millimetres. The world frame is that of the centre line's start: +z along the tube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from data_catalog.phantom.config import PhantomConfig, stream
from data_catalog.phantom.variation import Variation, vary

__all__ = ["CenterLine", "Polyp", "Wall", "build_wall"]

TUBE_LENGTH_MM = 125.0
GRID_STEP_MM = 0.5
_CENTER_STEP_MM = 0.25
_BEYOND_MM = 40.0  # the centre line goes on inside the caps


@dataclass(frozen=True)
class CenterLine:
    """The tube's axis with a frame that does not twist.

    Args:
        arc_mm: arc length of the samples, [P]; 0 and `TUBE_LENGTH_MM` are where the caps begin.
        points: positions, [P, 3].
        frames: columns are two directions across the tube and the tangent, [P, 3, 3].
    """

    arc_mm: Float[np.ndarray, "p"]
    points: Float[np.ndarray, "p 3"]
    frames: Float[np.ndarray, "p 3 3"]

    def point(self, arc_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Positions at arc lengths."""
        return np.stack([np.interp(arc_mm, self.arc_mm, self.points[:, k]) for k in range(3)], axis=1)

    def frame(self, arc_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
        """Orthonormal frames at arc lengths."""
        flat = self.frames.reshape(-1, 9)
        mixed = np.stack([np.interp(arc_mm, self.arc_mm, flat[:, k]) for k in range(9)], axis=1)
        mixed = mixed.reshape(-1, 3, 3)
        tangent = mixed[:, :, 2] / np.linalg.norm(mixed[:, :, 2], axis=1, keepdims=True)
        first = mixed[:, :, 0] - (mixed[:, :, 0] * tangent).sum(1, keepdims=True) * tangent
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(tangent, first), tangent], axis=2)


@dataclass(frozen=True)
class Polyp:
    """A sessile bump: where it sits on the wall, and its size."""

    arc_mm: float
    theta_rad: float
    radius_mm: float
    height_mm: float


@dataclass(frozen=True)
class Wall:
    """The inner surface of the phantom.

    Args:
        center_line: the tube's axis.
        radius_mm: mean radius of the tube.
        u_mm: profile coordinate of the grid's rows, [U].
        theta_rad: angles of the grid's columns, [T]; the grid is periodic in this direction.
        points: surface, [U, T, 3].
        normals: unit normals into the lumen, [U, T, 3].
        along: unit tangents in the direction of u, [U, T, 3].
        crest: 0 in the pouches, 1 on the crests of the folds, [U, T].
        bump: 1 on the top of polyps, 0 elsewhere, [U, T].
        polyps: the bumps.
    """

    center_line: CenterLine
    radius_mm: float
    u_mm: Float[np.ndarray, "u"]
    theta_rad: Float[np.ndarray, "t"]
    points: Float[np.ndarray, "u t 3"]
    normals: Float[np.ndarray, "u t 3"]
    along: Float[np.ndarray, "u t 3"]
    crest: Float[np.ndarray, "u t"]
    bump: Float[np.ndarray, "u t"]
    polyps: tuple[Polyp, ...]

    @property
    def vertices(self) -> Float[np.ndarray, "v 3"]:
        """Grid points row by row, float32."""
        return self.points.reshape(-1, 3).astype(np.float32)

    @property
    def triangles(self) -> Int[np.ndarray, "f 3"]:
        """Two triangles per cell, cell by cell; columns wrap round. int32."""
        rows, columns = self.points.shape[:2]
        i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
        j_next = (j + 1) % columns
        near, far = i * columns, (i + 1) * columns
        lower = np.stack([near + j, far + j, near + j_next], axis=-1)
        upper = np.stack([far + j_next, near + j_next, far + j], axis=-1)
        return np.stack([lower, upper], axis=2).reshape(-1, 3).astype(np.int32)

    def grid_coordinates(
        self, triangle: Int[np.ndarray, "n"], barycentric: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Row and column of a hit, as real numbers, from embree's triangle index and (u, v)."""
        cell, upper = np.divmod(triangle, 2)
        i, j = np.divmod(cell, self.points.shape[1])
        flipped = upper.astype(bool)
        row = i + np.where(flipped, 1 - barycentric[:, 0], barycentric[:, 0])
        column = j + np.where(flipped, 1 - barycentric[:, 1], barycentric[:, 1])
        return row, column


def build_wall(config: PhantomConfig) -> Wall:
    """The anatomy of a scene; depends on its index and the number of polyps only."""
    rng = stream(config.scene, "shape")
    variation = vary(config)
    center_line = _center_line(rng, variation.curvature)
    radius = float(rng.uniform(16.5, 19.5)) * variation.radius
    cap = radius * np.pi / 2
    rows = int(np.ceil((TUBE_LENGTH_MM + 2 * cap) / GRID_STEP_MM)) + 1
    columns = int(np.ceil(2 * np.pi * radius / GRID_STEP_MM))
    u = np.linspace(-cap, TUBE_LENGTH_MM + cap, rows)
    theta = np.arange(columns) * (2 * np.pi / columns)

    # Profile: quarter circles close the ends, so that every ray hits the wall.
    past = np.clip(u - TUBE_LENGTH_MM, 0, None) / radius
    before = np.clip(-u, 0, None) / radius
    arc = np.clip(u, 0, TUBE_LENGTH_MM) + radius * (np.sin(past) - np.sin(before))
    profile = radius * np.cos(past) * np.cos(before)
    profile[[0, -1]] = 0.0

    scale, crest, shift, folds = _folds(rng, arc, theta, radius, variation)
    taeniae = rng.uniform(0, 2 * np.pi)
    scale = scale * (1 + 0.035 * np.cos(3 * (theta[None, :] - taeniae)))
    scale = scale * (1 + variation.roughness * (_slow_variation(rng, u, theta) - 1))

    frame = center_line.frame(arc)
    across = (
        np.cos(theta)[None, :, None] * frame[:, None, :, 0]
        + np.sin(theta)[None, :, None] * frame[:, None, :, 1]
    )
    distance = profile[:, None] * scale
    points = (
        center_line.point(arc)[:, None, :]
        + distance[..., None] * across
        # Folds lean over a little, so that they hide what is behind them.
        + shift[..., None] * frame[:, None, :, 2]
    )
    normals, _ = _normals(points, center_line.point(arc))
    polyps = _place_polyps(rng, config.polyps, folds)
    bump, height = _polyp_height(polyps, points, center_line)
    points = points + height[..., None] * normals
    normals, along = _normals(points, center_line.point(arc))
    return Wall(center_line, radius, u, theta, points, normals, along, crest, bump, tuple(polyps))


def _center_line(rng: np.random.Generator, curving: float) -> CenterLine:
    arc = np.arange(-_BEYOND_MM, TUBE_LENGTH_MM + _BEYOND_MM + 1e-9, _CENTER_STEP_MM)
    # Two slow waves of curvature across each axis; a radius of curvature above 65 mm keeps the
    # wall (radius below 22 mm) far from folding over itself.
    curvature = np.zeros((2, arc.size))
    for axis in range(2):
        for wavelength in (230.0, 120.0):
            amplitude = curving * rng.uniform(0.35, 1.0) / 150
            curvature[axis] += amplitude * np.sin(2 * np.pi * arc / wavelength + rng.uniform(0, 2 * np.pi))
    frame = np.eye(3)
    point = np.zeros(3)
    points, frames = np.empty((arc.size, 3)), np.empty((arc.size, 3, 3))
    for k in range(arc.size):
        points[k], frames[k] = point, frame
        turn = curvature[:, k] * _CENTER_STEP_MM
        # Parallel transport: turning about directions across the tube never twists the frame.
        tangent = frame[:, 2] + turn[0] * frame[:, 0] + turn[1] * frame[:, 1]
        tangent /= np.linalg.norm(tangent)
        first = frame[:, 0] - (frame[:, 0] @ tangent) * tangent
        first /= np.linalg.norm(first)
        frame = np.stack([first, np.cross(tangent, first), tangent], axis=1)
        point = point + _CENTER_STEP_MM * tangent
    start = int(np.argmin(np.abs(arc)))
    to_start = frames[start].T
    return CenterLine(arc, (points - points[start]) @ to_start.T, to_start @ frames)


def _folds(
    rng: np.random.Generator,
    arc: Float[np.ndarray, "u"],
    theta: Float[np.ndarray, "t"],
    radius: float,
    variation: Variation,
) -> tuple[Float[np.ndarray, "u t"], Float[np.ndarray, "u t"], Float[np.ndarray, "u t"], list[float]]:
    """Radius factor, crest mask and lean of the haustral folds."""
    inward = np.zeros((arc.size, theta.size))
    shift = np.zeros_like(inward)
    centers: list[float] = []
    position = rng.uniform(3, 9)
    side = rng.uniform(0, 2 * np.pi)
    while position < TUBE_LENGTH_MM - 4:
        centers.append(float(position))
        height = rng.uniform(5.0, 8.0) * variation.fold_height
        width = rng.uniform(1.6, 2.4)
        # Semilunar: deep on one side, gone on the other.
        facing = 0.5 + 0.5 * np.cos(theta - side)
        extent = _smoothstep((facing - 0.10) / 0.55)
        wander = rng.uniform(1.0, 3.0) * np.cos(theta - rng.uniform(0, 2 * np.pi)) + 0.8 * np.cos(
            2 * theta - rng.uniform(0, 2 * np.pi)
        )
        ripple = 1 + 0.12 * np.cos(5 * theta + rng.uniform(0, 2 * np.pi))
        offset = (arc[:, None] - (position + wander)[None, :]) / width
        # Flatter than a bell at the foot, round at the crest.
        ridge = 1 / (1 + offset**2) ** 1.5
        strength = (height * extent * ripple)[None, :] * ridge
        inward = np.maximum(inward, strength)
        shift += rng.uniform(-0.25, 0.25) * strength
        position += rng.uniform(13, 20) * variation.fold_spacing
        side += rng.uniform(0.55, 1.0) * np.pi
    crest = np.clip(inward / 6.0, 0, 1)
    pouch = 0.06 * (1 - crest)
    return 1 + pouch - inward / radius, crest, shift, centers


def _slow_variation(
    rng: np.random.Generator, u: Float[np.ndarray, "u"], theta: Float[np.ndarray, "t"]
) -> Float[np.ndarray, "u t"]:
    variation = np.ones((u.size, theta.size))
    for wavelength, waves, amplitude in (
        (70.0, 1, 0.04),
        (45.0, 2, 0.025),
        (11.0, 4, 0.006),
        (6.0, 9, 0.003),
    ):
        variation += amplitude * np.cos(
            2 * np.pi * u[:, None] / wavelength + waves * theta[None, :] + rng.uniform(0, 2 * np.pi)
        )
        variation += amplitude * np.cos(
            2 * np.pi * u[:, None] / (1.3 * wavelength) - waves * theta[None, :] + rng.uniform(0, 2 * np.pi)
        )
    return variation


def _place_polyps(rng: np.random.Generator, count: int, folds: list[float]) -> list[Polyp]:
    polyps: list[Polyp] = []
    for k in range(count):
        # One per stretch of the tube, half-way between two folds.
        target = 22 + (k + rng.uniform(0.25, 0.75)) * (TUBE_LENGTH_MM - 45) / max(count, 1)
        gaps = 0.5 * (np.asarray(folds[1:]) + np.asarray(folds[:-1]))
        arc = float(gaps[np.argmin(np.abs(gaps - target))] + rng.uniform(-2, 2))
        radius = float(rng.uniform(2.6, 4.6))
        polyps.append(
            Polyp(arc, float(rng.uniform(0, 2 * np.pi)), radius, radius * float(rng.uniform(0.7, 0.95)))
        )
    return polyps


def _polyp_height(
    polyps: list[Polyp], points: Float[np.ndarray, "u t 3"], center_line: CenterLine
) -> tuple[Float[np.ndarray, "u t"], Float[np.ndarray, "u t"]]:
    """Share of each bump's height and the height itself, measured from the wall."""
    share = np.zeros(points.shape[:2])
    height = np.zeros(points.shape[:2])
    for polyp in polyps:
        arc = np.array([polyp.arc_mm])
        frame = center_line.frame(arc)[0]
        direction = np.cos(polyp.theta_rad) * frame[:, 0] + np.sin(polyp.theta_rad) * frame[:, 1]
        # The foot is the wall point nearest to the ray from the axis.
        relative = points - center_line.point(arc)[0]
        along_ray = relative @ direction
        off_ray = np.linalg.norm(relative - along_ray[..., None] * direction, axis=-1)
        foot = points[np.unravel_index(np.argmin(off_ray + 1e3 * (along_ray < 0)), off_ray.shape)]
        distance = np.linalg.norm(points - foot, axis=-1) / polyp.radius_mm
        # A dome with a rounded shoulder: steep sides, no crease at the foot.
        dome = np.clip(1 - distance**2, 0, None) ** 0.5
        blend = _smoothstep((1.25 - distance) / 0.5)
        bell = np.exp(-((distance / 0.75) ** 4))
        bump = np.maximum(blend * 0.6 * dome, 0) + 0.4 * bell
        share = np.maximum(share, bump)
        height = np.maximum(height, polyp.height_mm * bump)
    return share, height


def _normals(
    points: Float[np.ndarray, "u t 3"], axis_points: Float[np.ndarray, "u 3"]
) -> tuple[Float[np.ndarray, "u t 3"], Float[np.ndarray, "u t 3"]]:
    """Unit normals into the lumen and unit tangents along u, by central differences."""
    along = np.gradient(points, axis=0)
    round_axis = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normals = np.cross(along, round_axis)
    # At the poles all columns meet: there the direction round the axis has no length.
    for row, inner in ((0, 1), (-1, -2)):
        normals[row] = normals[inner]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    inward = axis_points[:, None, :] - points
    flip = np.sign((normals * inward).sum(-1).sum(axis=1))
    flip[flip == 0] = 1
    # The cross product keeps one handedness over the grid: one sign, by majority of the rows.
    normals *= 1.0 if flip.sum() >= 0 else -1.0
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    return normals, along


def _smoothstep(x: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    t = np.clip(x, 0, 1)
    return np.asarray(t * t * (3 - 2 * t))
