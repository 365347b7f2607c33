"""The occupancy grid: states of voxels, distances, and straight segments through it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from extrags.errors import ShapeError
from extrags.store.storable import Storable
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["FREE", "OCCUPIED", "UNKNOWN", "FreeSpace", "rotated", "to_grid", "voxel_centers"]

FREE = 0
"""The voxel is empty: training views see a surface behind it."""
OCCUPIED = 1
"""The voxel holds the tissue surface or lies directly behind it."""
UNKNOWN = 2
"""Not observed by any training view; also everything outside the bounding volume."""


@dataclass(frozen=True)
class FreeSpace(Storable):
    """Occupancy grid of S x S x S cubic voxels, and the signed distance to the boundary of free space.

    Voxel (i, j, k) has its centre at `origin_mm + ((i, j, k) + 0.5) * voxel_mm @ axes`.

    Args:
        occupancy: `FREE`, `OCCUPIED` or `UNKNOWN`, uint8, [S, S, S].
        origin_mm: corner of voxel (0, 0, 0) in world units.
        axes: rows are the grid's unit axes in world coordinates, det +1.
        voxel_mm: edge of a voxel in world units.
        clearance: distance of the voxel's centre from the nearest cube that is not free, occupied or unknown,
            in world units, less what the surface there may be off. In voxels that are not free it is minus
            the distance to the nearest free one, up to some voxels. float32, [S, S, S].

    Raises:
        ShapeError: when the arrays do not fit each other.
    """

    stored_as: ClassVar[str] = "freespace"

    occupancy: UInt8[np.ndarray, "s _ _"]
    origin_mm: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    voxel_mm: float
    clearance: Float[np.ndarray, "_ _ _"] = field(repr=False)

    def __post_init__(self) -> None:
        size = self.occupancy.shape[0]
        if self.occupancy.shape != (size, size, size) or self.clearance.shape != self.occupancy.shape:
            raise ShapeError(
                f"occupancy {self.occupancy.shape} and clearance {self.clearance.shape} "
                "must both be S x S x S"
            )

    @property
    def grid_size(self) -> int:
        """S: voxels per axis."""
        return int(self.occupancy.shape[0])

    @property
    def free_share(self) -> float:
        """Share of voxels that are free."""
        return float((self.occupancy == FREE).mean())

    def to_grid(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """World positions in continuous voxel coordinates: voxel i covers [i, i + 1)."""
        return to_grid(points, self.origin_mm, self.axes, self.voxel_mm)

    def from_grid(self, grid: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """World positions of continuous voxel coordinates; the inverse of `to_grid`."""
        return np.asarray(self.origin_mm + rotated(grid * self.voxel_mm, self.axes.T))

    def voxel_centers(self) -> Float[np.ndarray, "v 3"]:
        """World positions of all voxel centres, last axis fastest."""
        return voxel_centers(self.grid_size, self.origin_mm, self.axes, self.voxel_mm)

    def lookup(self, points: Float[np.ndarray, "*b 3"]) -> UInt8[np.ndarray, "*b"]:
        """State of the voxel each point lies in; O(1) per point.

        Args:
            points: world positions.

        Returns:
            `FREE`, `OCCUPIED` or `UNKNOWN`; outside the volume `UNKNOWN`.
        """
        return self._lookup_grid(self.to_grid(points))

    def clearance_at(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
        """Distance to the nearest voxel that is not free, interpolated between centres; 0 outside."""
        from scipy.ndimage import map_coordinates

        grid = self.to_grid(points)
        inside = ((grid >= 0) & (grid < self.grid_size)).all(-1)
        between = map_coordinates(
            self.clearance, np.moveaxis(grid - 0.5, -1, 0).reshape(3, -1), order=1, mode="nearest"
        ).reshape(inside.shape)
        return np.where(inside, np.maximum(between, 0.0), 0.0)

    def segment_is_free(
        self, a: Float[np.ndarray, "*b 3"], b: Float[np.ndarray, "*b 3"]
    ) -> Bool[np.ndarray, "*b"]:
        """True where all voxels that the straight segment from `a` to `b` traverses are free.

        Exact voxel traversal: the segment is split at every plane between voxels, and each piece is looked
        up (after Amanatides and Woo 1987, vectorised over all segments).
        """
        start, end = np.broadcast_arrays(self.to_grid(a), self.to_grid(b))
        shape = start.shape[:-1]
        start, end = start.reshape(-1, 3), end.reshape(-1, 3)
        if len(start) == 0:
            return np.ones(shape, dtype=bool)
        delta = end - start
        low = np.floor(np.minimum(start, end)).astype(np.int64) + 1
        planes = int(np.ceil(np.abs(delta)).max()) + 1
        position = low[:, :, None] + np.arange(planes)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (position - start[:, :, None]) / delta[:, :, None]
        # Planes that are not crossed are clamped to the end of the segment.
        t = np.where(np.isfinite(t), np.clip(t, 0.0, 1.0), 1.0).reshape(len(start), -1)
        ends = np.zeros((len(start), 1)), np.ones((len(start), 1))
        t = np.sort(np.concatenate([ends[0], t, ends[1]], axis=1), axis=1)
        middle = (t[:, 1:] + t[:, :-1]) / 2
        pieces = start[:, None] + middle[:, :, None] * delta[:, None]
        free = self._lookup_grid(pieces) == FREE
        return np.asarray(free.all(axis=1).reshape(shape))

    def save(self, path: Path) -> None:
        """Write a zarr v3 group; origin, axes and voxel size are its attributes."""
        with new_group(path) as group:
            write_array(group, "occupancy", self.occupancy)
            write_array(group, "clearance", self.clearance)
            group.attrs.update(
                {
                    "origin_mm": [float(x) for x in self.origin_mm],
                    "axes": [[float(x) for x in row] for row in self.axes],
                    "voxel_mm": float(self.voxel_mm),
                    "labels": {"free": FREE, "occupied": OCCUPIED, "unknown": UNKNOWN},
                }
            )

    @classmethod
    def load(cls, path: Path) -> FreeSpace:
        """Read what `save` wrote."""
        group = open_group(path)
        attributes: dict[str, Any] = dict(group.attrs)
        return cls(
            occupancy=read_array(group, "occupancy"),
            origin_mm=np.asarray(attributes["origin_mm"], dtype=np.float64),
            axes=np.asarray(attributes["axes"], dtype=np.float64),
            voxel_mm=float(attributes["voxel_mm"]),
            clearance=read_array(group, "clearance"),
        )

    def _lookup_grid(self, grid: Float[np.ndarray, "*b 3"]) -> UInt8[np.ndarray, "*b"]:
        index = np.floor(grid).astype(np.int64)
        inside = ((index >= 0) & (index < self.grid_size)).all(-1)
        index = np.clip(index, 0, self.grid_size - 1)
        state = self.occupancy[index[..., 0], index[..., 1], index[..., 2]]
        return np.where(inside, state, UNKNOWN).astype(np.uint8)


def to_grid(
    points: Float[np.ndarray, "*b 3"],
    origin_mm: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    voxel_mm: float,
) -> Float[np.ndarray, "*b 3"]:
    """Continuous voxel coordinates of world positions: voxel i covers [i, i + 1)."""
    return np.asarray(rotated(points - origin_mm, axes) / voxel_mm)


def rotated(points: Float[np.ndarray, "*b 3"], matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "*b 3"]:
    """`points @ matrix.T` without BLAS, whose rounding depends on the number of threads."""
    x, y, z = points[..., :1], points[..., 1:2], points[..., 2:]
    return np.asarray(x * matrix[:, 0] + y * matrix[:, 1] + z * matrix[:, 2])


def voxel_centers(
    size: int, origin_mm: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], voxel_mm: float
) -> Float[np.ndarray, "v 3"]:
    """World positions of all voxel centres of a grid, last axis fastest."""
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(origin_mm + rotated((index + 0.5) * voxel_mm, axes.T))
