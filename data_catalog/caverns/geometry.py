r"""Shape of a cavern: soft balls that melt into each other along a winding chain, with alcoves beside it.

Free space is where :math:`\sum_i w_i \exp(-q_i(x)) > 1`, :math:`q_i` a squared distance in the axes of ball i
(metaballs); negative weights leave boulders. Space is twisted before, so that no ball stays an ellipsoid.

Source: Blinn, "A generalization of algebraic surface drawing", ACM Transactions on Graphics 1 (1982).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_catalog.caverns.config import stream
from data_catalog.cavities.surface import Lattice, Wall, contour

__all__ = ["Cavern", "Passage", "build_cavern"]

_CHAMBERS = 7
_SOFTNESS = 2.2
"""How steeply a ball's density falls: exp(-2.2 (r^2 - 1)) is one on its surface."""
_NODES = 900_000
_MARGIN_MM = 4.0


@dataclass(frozen=True)
class Passage:
    """A wall, and a line between its sides that a camera can follow.

    Args:
        wall: the mesh, in mm.
        middle: the line, in mm, evenly spaced, [K, 3].
    """

    wall: Wall
    middle: Float[np.ndarray, "k 3"]


@dataclass(frozen=True)
class Cavern(Passage):
    """A cavern's wall and a line through all chambers of its chain.

    Args:
        lattice: the clearance it was contoured from; positive in free space.
    """

    lattice: Lattice


@dataclass(frozen=True)
class _Ball:
    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Rows: its axes, each divided by its radius."""
    weight: float


def build_cavern(scene: int) -> Cavern:
    """The cavern of a number."""
    rng = stream(scene, "shape")
    centers = _chain(rng)
    balls = [_ball(rng, center, rng.uniform(9, 16), 1.0) for center in centers]
    for _ in range(int(rng.integers(5, 10))):
        k = int(rng.integers(1, _CHAMBERS - 1))
        offset = rng.standard_normal(3)
        offset *= rng.uniform(9, 15) / np.linalg.norm(offset)
        balls.append(_ball(rng, centers[k] + offset, rng.uniform(4, 9), 1.0))
    for _ in range(int(rng.integers(5, 12))):
        k = int(rng.integers(0, _CHAMBERS))
        offset = rng.standard_normal(3)
        offset *= rng.uniform(9, 13) / np.linalg.norm(offset)
        balls.append(_ball(rng, centers[k] + offset, rng.uniform(2.0, 5.0), -rng.uniform(0.7, 1.5)))
    twist = rng.uniform(-0.02, 0.02)
    ripple, pitch = rng.uniform(0.0, 0.5), rng.uniform(5, 9)
    heading = rng.standard_normal(3)
    heading /= np.linalg.norm(heading)
    middle = _spline(centers)

    def clearance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        turned = _twisted(points, twist)
        density = np.full(len(points), 1e-6, dtype=np.float32)
        for ball in balls:
            x, y, z = (turned - ball.center.astype(np.float32)).T
            # Without BLAS, whose rounding may depend on the number of threads.
            square = sum(np.square(a * x + b * y + c * z) for a, b, c in ball.axes.astype(np.float32))
            density += ball.weight * np.exp(-_SOFTNESS * (square - 1))
        level = np.log(np.maximum(density, 1e-6))
        along = (points * heading.astype(np.float32)).sum(axis=1)
        # The logarithm falls by about 2 _SOFTNESS over one radius.
        return np.asarray(
            5.5 * level / _SOFTNESS + ripple * np.sin(2 * np.pi * along / pitch + 0.3 * turned[:, 1]),
            dtype=np.float32,
        )

    middle = _untwisted(middle, twist)
    reach = 19.0
    low, high = middle.min(axis=0) - reach - _MARGIN_MM, middle.max(axis=0) + reach + _MARGIN_MM
    lattice = Lattice.of(clearance, low, high, _NODES).without_islands().smoothed(0.8)
    return Cavern(contour(lattice), middle, lattice)


def _chain(rng: np.random.Generator) -> Float[np.ndarray, "c 3"]:
    """Middles of the chambers: a walk that turns a little at each."""
    heading = rng.standard_normal(3)
    heading /= np.linalg.norm(heading)
    centers = [np.zeros(3)]
    for _ in range(_CHAMBERS - 1):
        heading = heading + 0.42 * rng.standard_normal(3)
        heading /= np.linalg.norm(heading)
        centers.append(centers[-1] + heading * rng.uniform(13, 18))
    found = np.stack(centers)
    return np.asarray(found - found.mean(axis=0))


def _ball(rng: np.random.Generator, center: Float[np.ndarray, "3"], radius_mm: float, weight: float) -> _Ball:
    directions, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    radii = radius_mm * np.exp(rng.uniform(-0.22, 0.22, 3))
    return _Ball(np.asarray(center), directions / radii[:, None], float(weight))


def _spline(centers: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "k 3"]:
    from scipy.interpolate import CubicSpline

    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))])
    curve = CubicSpline(at, centers)
    return np.asarray(curve(np.arange(0.0, at[-1], 0.5)))


def _twisted(points: Float[np.ndarray, "n 3"], rate: float) -> Float[np.ndarray, "n 3"]:
    """Turned about z by an angle that grows with z."""
    angle = (rate * points[:, 2]).astype(np.float32)
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y, z = points.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1).astype(np.float32)


def _untwisted(points: Float[np.ndarray, "n 3"], rate: float) -> Float[np.ndarray, "n 3"]:
    return _twisted(points, -rate).astype(np.float64)
