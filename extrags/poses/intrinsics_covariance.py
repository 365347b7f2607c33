"""How well a bundle adjustment determines the intrinsics that all of its frames share.

The normal equations of bundle adjustment are reduced by the points (Schur complement), then by the poses;
what is left is the information on the intrinsics. Two covariances follow. The *model* one takes all
residuals for independent and of one size, as COLMAP does. The *clustered* one sums the gradients of each
point first, so that errors that repeat along a track (a feature that slides over a gloss or along an edge)
count as one: it is the one that is reported, where it is the larger.

Source: Triggs et al., "Bundle adjustment: a modern synthesis", 2000, sections 6 and 9; Liang and Zeger,
"Longitudinal data analysis using generalized linear models", Biometrika 1986 (clustered covariance).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from extrags.errors import ShapeError
from extrags.lens import LENS_PARAMETERS, Lens

__all__ = ["IntrinsicsCovariance", "intrinsics_covariance"]

_STEP = 1e-6
"""Of the numerical derivatives, relative to the parameter or to the depth."""
_GAUGE_FREEDOMS = 7
_SINGULAR = 1e-14
"""Smallest eigenvalue of the normal equations, scaled to a unit diagonal, that determines anything."""
_EIGENVALUE_TOLERANCE = 1e-3
"""Relative, of the smallest eigenvalue: it is only held against `_SINGULAR`."""


@dataclass(frozen=True)
class IntrinsicsCovariance:
    """Uncertainty of shared intrinsics.

    Args:
        parameters: their names, as in `extrags.lens.LENS_PARAMETERS`.
        model: covariance with independent residuals, [P, P].
        clustered: covariance with residuals that repeat within a point's track, [P, P].
        residual_px: standard deviation of one coordinate of one observation.
        n_observations: of points seen at least twice.
    """

    parameters: tuple[str, ...]
    model: Float[np.ndarray, "p p"]
    clustered: Float[np.ndarray, "p p"]
    residual_px: float
    n_observations: int

    def std(self, name: str) -> float:
        """Standard deviation of a parameter, the larger of the two; infinite where nothing bounds it."""
        k = self.parameters.index(name)
        variance = max(float(self.model[k, k]), float(self.clustered[k, k]))
        return float(np.sqrt(variance)) if np.isfinite(variance) else float("inf")


def intrinsics_covariance(
    lens: Lens,
    free: tuple[str, ...],
    world_from_camera: Float[np.ndarray, "f 4 4"],
    points: Float[np.ndarray, "p 3"],
    observed_frame: Int[np.ndarray, "o"],
    observed_point: Int[np.ndarray, "o"],
    observed_px: Float[np.ndarray, "o 2"],
) -> IntrinsicsCovariance:
    """Covariance of the free intrinsics at the minimum of a bundle adjustment.

    Poses and points are free; the seven freedoms of the world's frame are fixed at the first frame and at its
    distance to the farthest one.

    Args:
        lens: at the minimum.
        free: names of the parameters that were refined.
        world_from_camera: poses; only those of observing frames are looked at.
        points: triangulated points in the same unit.
        observed_frame: frame of each observation.
        observed_point: index of the point it observes.
        observed_px: where, in pixels of the lens, centres at +0.5.

    Returns:
        The covariance; infinite where there are no more observations than unknowns, or where the normal
        equations are singular.

    Raises:
        ShapeError: when nothing is free.
    """
    if not free:
        raise ShapeError("no intrinsics are free: there is no covariance")
    track = np.bincount(observed_point, minlength=len(points))
    used = track[observed_point] >= 2
    observed_frame, observed_px = observed_frame[used], observed_px[used]
    frames, frame = np.unique(observed_frame, return_inverse=True)
    kept, point = np.unique(observed_point[used], return_inverse=True)
    unknowns = 6 * len(frames) + 3 * len(kept) + len(free) - _GAUGE_FREEDOMS
    spare = 2 * len(frame) - unknowns
    unbounded = np.full((len(free), len(free)), np.inf)
    if len(frames) < 2 or spare <= 0:
        return IntrinsicsCovariance(free, unbounded, unbounded, float("nan"), len(frame))
    camera_from_world = np.linalg.inv(world_from_camera[frames])
    local = np.einsum("oij,oj->oi", camera_from_world[frame, :3, :3], points[kept][point])
    moved = local + camera_from_world[frame, :3, 3]
    residual = observed_px - _project(lens, moved)
    by_moved = _by_position(lens, moved)
    # A pose is turned about its own axes at the point and shifted in them: [O, 2, 6].
    by_pose = np.concatenate([-by_moved @ _cross(local), by_moved], axis=2)
    by_point = by_moved @ camera_from_world[frame, :3, :3]
    by_shared = _by_intrinsics(lens, free, moved)
    variance = float((residual**2).sum() / spare)
    shared = 6 * len(frames)
    size = shared + len(free)
    information = np.zeros((size, size))
    gradients: list[tuple[np.ndarray, np.ndarray]] = []
    order = np.argsort(point, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(point[order])) + 1):
        seen, place = np.unique(frame[rows], return_inverse=True)
        touched = np.concatenate([(6 * seen[:, None] + np.arange(6)).reshape(-1), np.arange(shared, size)])
        by_row = np.zeros((len(rows), 2, len(touched)))
        own = 6 * place[:, None] + np.arange(6)
        by_row[np.arange(len(rows))[:, None], :, own] = by_pose[rows].transpose(0, 2, 1)
        by_row[:, :, -len(free) :] = by_shared[rows]
        jacobian, wrong = by_row.reshape(-1, len(touched)), residual[rows].reshape(-1)
        # What the point's own freedom explains is projected out: the Schur complement.
        basis, strength, _ = np.linalg.svd(by_point[rows].reshape(-1, 3), full_matrices=False)
        basis = basis[:, strength > 1e-9 * strength[0]]
        jacobian -= basis @ (basis.T @ jacobian)
        information[np.ix_(touched, touched)] += jacobian.T @ jacobian
        gradients.append((touched, jacobian.T @ (wrong - basis @ (basis.T @ wrong))))
    columns = _without_gauge(camera_from_world, size)
    information = information[np.ix_(columns, columns)]
    # Scaled to a unit diagonal, so that pixels and radians can be compared.
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    information /= scale[:, None]
    information /= scale
    last_rows = _last_rows_of_inverse(information, len(free))
    if last_rows is None:
        return IntrinsicsCovariance(free, unbounded, unbounded, float(np.sqrt(variance)), len(frame))
    inverse = np.zeros((len(free), size))
    inverse[:, columns] = last_rows / scale[-len(free) :, None] / scale
    spread = np.stack([inverse[:, touched] @ gradient for touched, gradient in gradients])
    return IntrinsicsCovariance(
        parameters=free,
        model=variance * inverse[:, -len(free) :],
        clustered=spread.T @ spread * len(kept) / max(1, len(kept) - 1),
        residual_px=float(np.sqrt(variance)),
        n_observations=len(frame),
    )


def _last_rows_of_inverse(matrix: Float[np.ndarray, "n n"], count: int) -> Float[np.ndarray, "p n"] | None:
    """The last rows of the inverse of a symmetric matrix with unit diagonal; None where it is singular.

    Singular is a matrix without a Cholesky factor, or with an eigenvalue below `_SINGULAR`. The time grows
    with the cube of the size: a factor and a few solutions take a fifth of what all eigenvalues and the whole
    inverse take.

    Args:
        matrix: overwritten.
        count: of rows.
    """
    from scipy.linalg import LinAlgError, cho_factor, cho_solve
    from scipy.sparse.linalg import LinearOperator, eigsh

    size = len(matrix)
    try:
        # Of a symmetric matrix the transposed one is the same, in the order that is overwritten in place.
        factor = cho_factor(matrix.T, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return None
    inverse = LinearOperator((size, size), matvec=lambda right: cho_solve(factor, right), dtype=np.float64)
    # A start of its own makes the iteration the same each time.
    start = np.random.default_rng(0).standard_normal(size)
    (largest,) = eigsh(
        inverse, k=1, which="LA", v0=start, tol=_EIGENVALUE_TOLERANCE, return_eigenvectors=False
    )
    if not largest > 0 or 1 / largest < _SINGULAR:
        return None
    units = np.zeros((size, count))
    units[size - count :] = np.eye(count)
    return np.asarray(cho_solve(factor, units).T)


def _project(lens: Lens, moved: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 2"]:
    return np.stack(lens.project(moved[:, 0] / moved[:, 2], moved[:, 1] / moved[:, 2]), axis=1)


def _by_position(lens: Lens, moved: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 2 3"]:
    step = _STEP * np.abs(moved[:, 2:])
    found = []
    for axis in np.eye(3):
        forth, back = _project(lens, moved + step * axis), _project(lens, moved - step * axis)
        found.append((forth - back) / (2 * step))
    return np.stack(found, axis=2)


def _by_intrinsics(
    lens: Lens, free: tuple[str, ...], moved: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o 2 p"]:
    names = LENS_PARAMETERS[lens.model]
    found = []
    for name in free:
        step = _STEP * max(1.0, abs(lens.value(name)))
        at = np.array(lens.parameters)
        sides = []
        for sign in (1, -1):
            at[names.index(name)] = lens.value(name) + sign * step
            sides.append(_project(replace(lens, parameters=tuple(at.tolist())), moved))
        found.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(found, axis=2)


def _cross(vectors: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3 3"]:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _without_gauge(camera_from_world: Float[np.ndarray, "f 4 4"], size: int) -> Int[np.ndarray, "n"]:
    """Columns left when the first frame is held, and the farthest one's distance from it."""
    turn, shift = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    centres = -np.einsum("fji,fj->fi", turn, shift)
    away = np.einsum("fij,fj->fi", turn, centres - centres[0])
    farthest, axis = np.unravel_index(np.argmax(np.abs(away)), away.shape)
    held = {*range(6), 6 * int(farthest) + 3 + int(axis)}
    return np.array([column for column in range(size) if column not in held], dtype=np.int64)
