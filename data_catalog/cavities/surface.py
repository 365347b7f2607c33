"""A cavity's wall: a clearance on a regular lattice, contoured into triangles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from extrags.errors import CaptureError

__all__ = ["Clearance", "Lattice", "Wall", "contour", "unit"]

Clearance = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]
"""In mm: positive in free space, negative behind the wall; near the wall about the distance to it."""
_CHUNK = 1 << 17


@dataclass(frozen=True)
class Lattice:
    """A regular lattice over a box, with a clearance at its nodes.

    Args:
        low_mm: the first node.
        step_mm: from node to node.
        values: clearance in mm; the outermost nodes are behind the wall, so that the wall is closed.
    """

    low_mm: Float[np.ndarray, "3"]
    step_mm: float
    values: Float[np.ndarray, "x y z"]

    @classmethod
    def of(
        cls,
        clearance: Clearance,
        low_mm: Float[np.ndarray, "3"],
        high_mm: Float[np.ndarray, "3"],
        nodes: int,
    ) -> Lattice:
        """Evaluate a clearance on about so many nodes; the box itself is a wall too."""
        extent = high_mm - low_mm
        step = float((extent.prod() / nodes) ** (1 / 3))
        shape = np.maximum(np.round(extent / step).astype(int), 8) + 1
        values = np.empty(int(shape.prod()), dtype=np.float32)
        lattice = cls(low_mm, step, values.reshape(shape))
        for start in range(0, values.size, _CHUNK):
            index = np.unravel_index(np.arange(start, min(start + _CHUNK, values.size)), shape)
            values[start : start + _CHUNK] = clearance(lattice.positions(np.stack(index, axis=1)))
        for axis in range(3):
            index_along = np.arange(shape[axis])
            from_end = step * (np.minimum(index_along, shape[axis] - 1 - index_along) - 1.01)
            form = [1, 1, 1]
            form[axis] = -1
            np.minimum(lattice.values, from_end.reshape(form).astype(np.float32), out=lattice.values)
        return lattice

    def without_islands(self) -> Lattice:
        """The lattice without solids that float in free space: all that is solid hangs together."""
        from scipy.ndimage import label

        parts, _ = label(self.values <= 0)
        values = self.values.copy()
        values[(parts > 0) & (parts != parts[0, 0, 0])] = 0.5 * self.step_mm
        return Lattice(self.low_mm, self.step_mm, values)

    def smoothed(self, nodes: float) -> Lattice:
        """The clearance without what is finer than so many nodes (standard deviation of the blur)."""
        from scipy.ndimage import gaussian_filter

        return Lattice(self.low_mm, self.step_mm, gaussian_filter(self.values, nodes, truncate=3.0))

    def positions(self, index: Float[np.ndarray, "n 3"] | Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Where nodes lie, in mm, float32."""
        return np.asarray(self.low_mm + self.step_mm * index, dtype=np.float32)

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """The clearance between nodes."""
        from scipy.ndimage import map_coordinates

        index = (points - self.low_mm) / self.step_mm
        return np.asarray(map_coordinates(self.values, index.T, order=1, mode="nearest"), dtype=np.float32)

    def normals(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions of growing clearance: on the wall, its normals into free space."""
        slopes = [
            self.at(points + self.step_mm * axis) - self.at(points - self.step_mm * axis)
            for axis in np.eye(3)
        ]
        return unit(np.stack(slopes, axis=1))


@dataclass(frozen=True)
class Wall:
    """The wall of a cavity.

    Args:
        vertices: in mm.
        triangles: indices of vertices, counter-clockwise seen from free space.
        normals: unit normals of the vertices, into free space.
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    normals: Float[np.ndarray, "v 3"]


def contour(lattice: Lattice) -> Wall:
    """The wall where the clearance is zero.

    Raises:
        CaptureError: when it is nowhere zero.
    """
    import open3d as o3d

    volume = np.ascontiguousarray(lattice.values)
    if not (volume.min() < 0 < volume.max()):
        raise CaptureError("the clearance is nowhere zero: there is no wall")
    mesh = o3d.t.geometry.TriangleMesh.create_isosurfaces(o3d.core.Tensor.from_numpy(volume), [0.0])
    # The volume's last axis is the mesh's first.
    index = mesh.vertex.positions.numpy()[:, ::-1].astype(np.float64)
    vertices = lattice.positions(index)
    triangles = mesh.triangle.indices.numpy().astype(np.int64)
    normals = lattice.normals(vertices)
    corner = vertices[triangles]
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    if np.einsum("ij,ij->", facing.astype(np.float64), normals[triangles[:, 0]].astype(np.float64)) < 0:
        triangles = triangles[:, ::-1]
    return Wall(vertices, np.ascontiguousarray(triangles), normals)


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Vectors of length one, float32; of no length where they had none."""
    length = np.sqrt(np.square(vectors).sum(axis=-1, keepdims=True))
    return np.asarray(vectors / np.maximum(length, 1e-9), dtype=np.float32)
