"""One stretch of the colon as a passage for cameras, and the tissue that lines it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from data_catalog.caverns.config import stream
from data_catalog.caverns.geometry import Passage
from data_catalog.cavities.real_textures import judging_files, photographed_tile
from data_catalog.cavities.skin import Skin, make_skin
from data_catalog.cavities.surface import Wall
from data_catalog.ct_colon.model import ColonModel
from extrags.errors import SourceError

__all__ = ["STRETCH_MM", "build_stretch", "make_lining"]

STRETCH_MM = 110.0
_END_MM = 40.0
"""Neither end of the colon is within so much of a stretch."""
_BEYOND_MM = 150.0
"""Wall that is kept before and behind a stretch: farther, no lamp shows it."""
_STEP_MM = 0.5
"""From point to point of the line that cameras follow."""
_LINE_SMOOTHED = 21
_ROUNDS, _SHRINK, _SWELL = 5, 0.5, -0.53
_TILES = 8


def build_stretch(scene: int, folder: Path) -> Passage:
    """The stretch of a number; consecutive ones lie far apart.

    The voxels of the CT show in its surface as steps, which no colon has: each triangle is divided in four,
    and the mesh smoothed (Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995).

    Args:
        scene: which one.
        folder: of the model (`data_catalog.ct_colon.model`).

    Raises:
        SourceError: a file is missing or wrong, the colon is shorter than a stretch, or none of the wall lies
            around the line.
    """
    model = ColonModel.read(folder)
    along = model.along_mm
    room = along[-1] - STRETCH_MM - 2 * _END_MM
    if room <= 0:
        raise SourceError(f"the line is {along[-1]:.0f} mm long; a stretch takes {STRETCH_MM:g}", file=folder)
    begin = _END_MM + room * ((0.25 + scene * (np.sqrt(5) - 1) / 2) % 1)
    middle = model.at(np.arange(begin, begin + STRETCH_MM, _STEP_MM))
    return Passage(_wall(model, begin - _BEYOND_MM, begin + STRETCH_MM + _BEYOND_MM), _smoothed_line(middle))


def make_lining(seed: int, wall: Wall, folder: Path | None = None) -> Skin:
    """Real tissue on a wall.

    Args:
        seed: of everything random (`CtColonConfig.seed`).
        wall: to line.
        folder: that holds the frames; None looks below the data roots.

    Raises:
        SourceNotFoundError: when there is no such folder.
        SourceError: when none of the frames drawn shows tissue alone.
    """
    files, rng = judging_files(folder), stream(seed, "texture")
    tiles = (photographed_tile(files, rng) for _ in range(_TILES))
    tile = next((tile for tile in tiles if tile is not None), None)
    if tile is None:
        raise SourceError(f"no patch of tissue in {_TILES} frames", file=files[0].parent)
    return make_skin("colon", wall, [], _STEP_MM, rng, 12.0, tile, patches=False)


def _wall(model: ColonModel, begin_mm: float, end_mm: float) -> Wall:
    """The wall whose nearest point of the line lies between two places.

    Neighbouring bowel, which lies as near, belongs to other parts of the line.
    """
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(model.centre_line_mm).query(model.vertices)
    place = model.along_mm[nearest]
    kept = ((place >= begin_mm) & (place <= end_mm))[model.triangles].all(axis=1)
    if not kept.any():
        raise SourceError(
            "no wall lies around the line between its ends; are both of one colon?", field="points"
        )
    used, triangles = np.unique(model.triangles[kept], return_inverse=True)
    vertices = model.vertices[used].astype(np.float64)
    vertices, triangles = _divided(vertices, triangles.reshape(-1, 3))
    vertices = _faired(vertices, triangles)
    normals = _normals(vertices, triangles)
    middle = model.centre_line_mm[cKDTree(model.centre_line_mm).query(vertices)[1]]
    if np.median(np.einsum("ij,ij->i", middle - vertices, normals)) < 0:
        normals, triangles = -normals, triangles[:, ::-1]
    return Wall(vertices.astype(np.float32), np.ascontiguousarray(triangles), normals.astype(np.float32))


def _smoothed_line(points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    weights = np.hanning(_LINE_SMOOTHED + 2)[1:-1]
    weights /= weights.sum()
    half = _LINE_SMOOTHED // 2
    padded = np.pad(points, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(axis, weights, "valid") for axis in padded.T], axis=1)


def _divided(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "u 3"]]:
    """Each triangle in four, at the middles of its sides."""
    sides = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1
    )
    unique, index = np.unique(sides, axis=0, return_inverse=True)
    a, b, c = triangles.T
    ab, bc, ca = index.reshape(3, -1) + len(vertices)
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return (
        np.concatenate([vertices, vertices[unique].mean(axis=1)]),
        np.concatenate([np.stack(corners, axis=1) for corners in quarters]),
    )


def _faired(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, "v 3"]:
    from scipy.sparse import coo_matrix

    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    rows, columns = np.concatenate([sides, sides[:, ::-1]]).T
    neighbours = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(vertices),) * 2).tocsr()
    count = np.maximum(np.asarray(neighbours.sum(axis=1)), 1)
    for factor in (_SHRINK, _SWELL) * _ROUNDS:
        vertices = vertices + factor * (neighbours @ vertices / count - vertices)
    return vertices


def _normals(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, "v 3"]:
    corner = vertices[triangles]
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, triangles[:, k], facing)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
