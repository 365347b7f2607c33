"""Free space for virtual cameras: bounding volume, occupancy grid and clearance."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from extrags.cameras import Cameras
from extrags.config import FreespaceConfig
from extrags.errors import CaptureError, ShapeError
from extrags.events import Progress, emit
from extrags.scene import Scene
from extrags.store.storable import Storable
from extrags.surface import Mesh
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["FREE", "OCCUPIED", "UNKNOWN", "FreeSpace", "carve", "voxel_visibility"]

_log = logging.getLogger(__name__)

FREE = 0
"""The voxel is empty: training views see a surface behind it."""
OCCUPIED = 1
"""The voxel holds the tissue surface or lies directly behind it."""
UNKNOWN = 2
"""Not observed by any training view; also everything outside the bounding volume."""

LENS_VOXELS = 1.5
"""Radius, in voxels, of the ball around each training camera that is free: the endoscope was there."""


@dataclass(frozen=True)
class FreeSpace(Storable):
    """Occupancy grid of S x S x S cubic voxels, and the distance to the nearest occupied voxel.

    Voxel (i, j, k) has its centre at `origin_mm + ((i, j, k) + 0.5) * voxel_mm @ axes`.

    Args:
        occupancy: `FREE`, `OCCUPIED` or `UNKNOWN`, uint8, [S, S, S].
        origin_mm: corner of voxel (0, 0, 0) in world units.
        axes: rows are the grid's unit axes in world coordinates, det +1.
        voxel_mm: edge of a voxel in world units.
        clearance: distance of the voxel's centre from the nearest occupied voxel in world units, less what
            the surface there may be off; zero inside those, float32, [S, S, S].

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
        return _to_grid(points, self.origin_mm, self.axes, self.voxel_mm)

    def from_grid(self, grid: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """World positions of continuous voxel coordinates; the inverse of `to_grid`."""
        return np.asarray(self.origin_mm + _rotated(grid * self.voxel_mm, self.axes.T))

    def voxel_centers(self) -> Float[np.ndarray, "v 3"]:
        """World positions of all voxel centres, last axis fastest."""
        return _voxel_centers(self.grid_size, self.origin_mm, self.axes, self.voxel_mm)

    def lookup(self, points: Float[np.ndarray, "*b 3"]) -> UInt8[np.ndarray, "*b"]:
        """State of the voxel each point lies in; O(1) per point.

        Args:
            points: world positions.

        Returns:
            `FREE`, `OCCUPIED` or `UNKNOWN`; outside the volume `UNKNOWN`.
        """
        return self._lookup_grid(self.to_grid(points))

    def clearance_at(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
        """Distance to the nearest occupied voxel, interpolated between voxel centres; 0 outside."""
        from scipy.ndimage import map_coordinates

        grid = self.to_grid(points)
        inside = ((grid >= 0) & (grid < self.grid_size)).all(-1)
        between = map_coordinates(
            self.clearance, np.moveaxis(grid - 0.5, -1, 0).reshape(3, -1), order=1, mode="nearest"
        ).reshape(inside.shape)
        return np.where(inside, between, 0.0)

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


def carve(
    scene: Scene,
    mesh: Mesh,
    cameras: Cameras,
    config: FreespaceConfig | None = None,
    *,
    surface_error_mm: Float[np.ndarray, "v"] | None = None,
) -> FreeSpace:
    """Occupancy and clearance by space carving with rendered transmittance.

    The visibility of a voxel is the mean of its `top_views` largest transmittances over the training
    views that observe it: those with the voxel in the image, on a ray that ends on a surface. From
    `occupied_below` on the voxel is free. Below, it is occupied within `wall_voxels` of the mesh and unknown
    farther away (an occluded voxel need not be solid). Voxels that the mesh intersects are occupied, those
    at a training camera free.

    Args:
        scene: the reconstructed scene.
        mesh: its surface.
        cameras: the training views.
        config: settings.
        surface_error_mm: expected distance of each vertex from the true surface, by which clearance is
            reduced (`extrags.surface_error`); None for a surface from measured depth.

    Returns:
        The grid, aligned with the principal axes of mesh and cameras.

    Raises:
        CaptureError: when no voxel is free.

    Source: [ExtraGS, section "Scene Initialization and Feasible Region Estimation"], see docs/references.md.
    """
    config = FreespaceConfig() if config is None else config
    from scipy.ndimage import distance_transform_edt

    size = config.grid_size
    origin_mm, axes, voxel_mm, extent_voxels = _bounding_volume(mesh, cameras, config)
    visibility = voxel_visibility(
        scene, cameras, _voxel_centers(size, origin_mm, axes, voxel_mm), config
    ).reshape(size, size, size)

    surface = _voxels_of_mesh(mesh, origin_mm, axes, voxel_mm, size)
    from_surface = (
        np.asarray(distance_transform_edt(~surface)) if surface.any() else np.full(surface.shape, np.inf)
    )
    occupancy = np.full((size, size, size), UNKNOWN, dtype=np.uint8)
    occupancy[visibility >= config.occupied_below] = FREE
    hidden = np.isnan(visibility) | (visibility < config.occupied_below)
    occupancy[hidden & (from_surface <= config.wall_voxels)] = OCCUPIED
    # The grid is a cube with the longest side of the bounding volume; along the other axes the volume ends
    # before the cube does.
    index = np.arange(size) + 0.5
    inside = [np.abs(index - size / 2) <= extent / 2 for extent in extent_voxels]
    outside = ~(inside[0][:, None, None] & inside[1][None, :, None] & inside[2][None, None, :])
    occupancy[outside & (occupancy == FREE)] = UNKNOWN

    lens = _to_grid(cameras.centers, origin_mm, axes, voxel_mm)
    occupancy[_ball_mask(lens, size, LENS_VOXELS)] = FREE
    occupancy[surface] = OCCUPIED
    # Without padding a camera may lie exactly on a face of the volume.
    at_lens = np.clip(np.floor(lens).astype(np.int64), 0, size - 1)
    occupancy[at_lens[:, 0], at_lens[:, 1], at_lens[:, 2]] = FREE

    if not (occupancy == FREE).any():
        raise CaptureError("no voxel of the scene is free; the views see no surface at a distance")
    occupied = occupancy == OCCUPIED
    if occupied.any():
        # The transform measures between voxel centres; the face of the occupied voxel is half a voxel nearer.
        distance = np.maximum(np.asarray(distance_transform_edt(~occupied)) - 0.5, 0.0) * voxel_mm
    else:
        distance = np.full(occupancy.shape, size * voxel_mm)
    if surface_error_mm is not None and len(surface_error_mm):
        vertices = _to_grid(mesh.vertices.astype(np.float64), origin_mm, axes, voxel_mm)
        distance = np.maximum(distance - _nearest_error(vertices, surface_error_mm, size), 0.0)
    space = FreeSpace(occupancy, origin_mm, axes, voxel_mm, distance.astype(np.float32))
    _log.info("freespace: %.1f %% of %d^3 voxels of %.3g are free", 100 * space.free_share, size, voxel_mm)
    return space


def voxel_visibility(
    scene: Scene, cameras: Cameras, points: Float[np.ndarray, "q 3"], config: FreespaceConfig
) -> Float[np.ndarray, "q"]:
    """Mean of the `top_views` largest transmittances between each point and the views.

    Args:
        scene: the reconstructed scene.
        cameras: the views.
        points: world positions.
        config: `top_views`, `min_alpha`, `render_width`.

    Returns:
        A value in [0, 1]; NaN where no view observes the point. With fewer than `top_views` such views the
        mean is over those there are, so that the ends of a recording do not count as occupied.
    """
    cameras = cameras.at_most_width(config.render_width)
    # Running top-k over the views; -1 marks ranks that no view fills.
    best = np.full((config.top_views, len(points)), -1.0, dtype=np.float32)
    with torch.no_grad():
        for index in range(len(cameras)):
            view = cameras[index]
            (pixels,), _ = view.project(points)
            inside = view.contains(pixels)
            column, row = pixels[inside].astype(np.int64).T
            queries = torch.from_numpy(points[inside].astype(np.float32))
            rendering = scene.render(view, query_points=queries)
            transmittance = cast("torch.Tensor", rendering.transmittance)[0].numpy()
            ends = rendering.alpha[0].numpy()[row, column] >= config.min_alpha
            value = np.full(len(points), -1.0, dtype=np.float32)
            value[inside] = np.where(np.isfinite(transmittance) & ends, transmittance, -1.0)
            for rank in range(config.top_views):
                smaller = np.minimum(best[rank], value)
                best[rank] = np.maximum(best[rank], value)
                value = smaller
            emit(Progress("freespace", index + 1, len(cameras)))
    count = (best >= 0).sum(axis=0)
    total = np.where(best >= 0, best, 0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _bounding_volume(
    mesh: Mesh, cameras: Cameras, config: FreespaceConfig
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], float, Float[np.ndarray, "3"]]:
    """Origin, axes, voxel size and extent in voxels of the padded bounding box of mesh and cameras."""
    points = np.concatenate([mesh.vertices.astype(np.float64), cameras.centers])
    centered = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(np.einsum("ni,nj->ij", centered, centered))
    axes = axes.T[::-1]
    # The sign of an eigenvector is arbitrary: make its largest component positive.
    largest = np.abs(axes).argmax(axis=1)
    axes = axes * np.sign(axes[np.arange(3), largest])[:, None]
    axes[2] = np.cross(axes[0], axes[1])
    along = _rotated(points, axes)
    low, high = along.min(axis=0), along.max(axis=0)
    side = float((high - low).max()) * (1 + 2 * config.margin_share)
    if side <= 0:
        raise CaptureError("mesh and cameras lie in one point; there is no volume to explore")
    voxel_mm = side / config.grid_size
    origin_mm = ((low + high) / 2 - side / 2) @ axes
    extent_voxels = (high - low) / voxel_mm + 2 * config.margin_share * config.grid_size
    return origin_mm, axes, voxel_mm, extent_voxels


def _to_grid(
    points: Float[np.ndarray, "*b 3"],
    origin_mm: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    voxel_mm: float,
) -> Float[np.ndarray, "*b 3"]:
    return np.asarray(_rotated(points - origin_mm, axes) / voxel_mm)


def _rotated(
    points: Float[np.ndarray, "*b 3"], matrix: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*b 3"]:
    """`points @ matrix.T` without BLAS, whose rounding depends on the number of threads."""
    x, y, z = points[..., :1], points[..., 1:2], points[..., 2:]
    return np.asarray(x * matrix[:, 0] + y * matrix[:, 1] + z * matrix[:, 2])


def _voxel_centers(
    size: int, origin_mm: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], voxel_mm: float
) -> Float[np.ndarray, "v 3"]:
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(origin_mm + _rotated((index + 0.5) * voxel_mm, axes.T))


def _voxels_of_mesh(
    mesh: Mesh,
    origin_mm: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    voxel_mm: float,
    size: int,
) -> Bool[np.ndarray, "s s s"]:
    """Voxels that a triangle intersects, from samples at most half a voxel apart."""
    corners = _to_grid(mesh.vertices.astype(np.float64), origin_mm, axes, voxel_mm)[mesh.triangles]
    marked = np.zeros((size, size, size), dtype=bool)
    if len(corners) == 0:
        return marked
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    cuts = np.maximum(1, np.ceil(longest / 0.5)).astype(np.int64)
    for n in np.unique(cuts):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], axis=1) / n
        samples = np.einsum("wc,tcx->twx", weights, corners[cuts == n]).reshape(-1, 3)
        _mark(marked, np.floor(samples).astype(np.int64))
    return marked


def _nearest_error(
    vertices: Float[np.ndarray, "v 3"], error_mm: Float[np.ndarray, "v"], size: int
) -> Float[np.ndarray, "s s s"]:
    """Largest error in the nearest voxel that holds a vertex; vertices are in grid coordinates."""
    from scipy.ndimage import distance_transform_edt

    largest = np.full((size, size, size), -1.0)
    index = np.clip(np.floor(vertices).astype(np.int64), 0, size - 1)
    np.maximum.at(largest, tuple(index.T), error_mm)
    nearest = distance_transform_edt(largest < 0, return_distances=False, return_indices=True)
    return np.asarray(largest[tuple(nearest)])


def _ball_mask(centers: Float[np.ndarray, "n 3"], size: int, radius: float) -> Bool[np.ndarray, "s s s"]:
    """Voxels whose centre lies within `radius` voxels of one of the points (grid coordinates)."""
    marked = np.zeros((size, size, size), dtype=bool)
    reach = int(np.ceil(radius)) + 1
    offset = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.floor(centers).astype(np.int64)[:, None] + offset
    near = ((index + 0.5 - centers[:, None]) ** 2).sum(-1) <= radius**2
    _mark(marked, index[near])
    return marked


def _mark(marked: Bool[np.ndarray, "s s s"], index: Int[np.ndarray, "n 3"]) -> None:
    inside = ((index >= 0) & (index < marked.shape[0])).all(axis=1)
    index = index[inside]
    marked[index[:, 0], index[:, 1], index[:, 2]] = True
