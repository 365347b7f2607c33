"""How far a reconstructed surface may be from the true one, where its depth was estimated."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh

__all__ = ["HIDDEN_SHARE", "surface_error_mm"]

HIDDEN_SHARE = 0.25
"""A vertex behind a view's depth by more than this share is hidden there; that depth says nothing of it."""


def surface_error_mm(mesh: Mesh, sequence: EndoscopicSequence) -> Float[np.ndarray, "v"] | None:
    """Expected distance of each vertex of a mesh from the true surface, in world units.

    A training view vouches for a vertex by its expected error there, or by the distance of its own estimate
    from the vertex where that is more; the view that vouches best counts. A vertex that no view sees takes
    the median of the others; where none sees any, all errors are infinite.

    Args:
        mesh: surface of the scene.
        sequence: posed frames whose training frames have estimated depth.

    Returns:
        [V]; None where the depth was measured, or none is known.
    """
    if sequence.depth_error is None or sequence.depth_mm is None:
        return None
    vertices = mesh.vertices.astype(np.float64)
    error = np.full(len(vertices), np.inf)
    cameras = sequence.training_cameras
    for view, frame in enumerate(sequence.train):
        (pixels,), (z,) = cameras[view].project(vertices)
        inside = cameras[view].contains(pixels)
        column, row = pixels[inside].astype(np.int64).T
        depth = np.where(sequence.mask[frame], sequence.depth_mm[frame], 0)[row, column].astype(np.float64)
        expected = sequence.depth_error[frame][row, column] * depth
        away = np.abs(z[inside] - depth)
        speaks = (depth > 0) & (z[inside] <= (1 + HIDDEN_SHARE) * depth)
        error[inside] = np.where(speaks, np.minimum(error[inside], np.maximum(expected, away)), error[inside])
    known = np.isfinite(error)
    return np.where(known, error, np.median(error[known]) if known.any() else np.inf)
