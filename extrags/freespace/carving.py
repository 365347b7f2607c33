"""Space carving: which voxels the training views prove free, and how much room there is."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.cameras import Cameras, pose_distances
from extrags.config import DEFAULT_PROFILE, PROFILES, FreespaceConfig
from extrags.errors import CaptureError
from extrags.freespace.distances import box_around, distance_to_cubes, signed_distance
from extrags.freespace.grid import FREE, OCCUPIED, UNKNOWN, FreeSpace, rotated, to_grid
from extrags.freespace.passages import ball_mask, mark, reachable
from extrags.freespace.visibility import ViewDepths, seen_through
from extrags.freespace.walls import voxels_of_triangles
from extrags.scene import Scene
from extrags.shown_pixels import chosen_masks
from extrags.surface import Mesh
from extrags.threads import one_torch_thread

__all__ = ["carve", "carving_views"]

_log = logging.getLogger(__name__)

LENS_VOXELS = 1.5
"""Radius, in voxels, of the ball around each training camera that is free: the endoscope was there."""
VIEWS_FOR_THE_UNIT = 8
"""Views that tell a typical depth before the views that carve are chosen."""
WALL_DEPTH = 4.0
"""Distances inside occupied space are told apart up to this, in voxels."""


@one_torch_thread()
def carve(
    scene: Scene,
    mesh: Mesh,
    cameras: Cameras,
    config: FreespaceConfig | None = None,
    *,
    surface_error_mm: Float[np.ndarray, "v"] | None = None,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> FreeSpace:
    """Occupancy and clearance by space carving with rendered transmittance.

    The visibility of a voxel is the mean of its `top_views` largest transmittances over the views that
    observe it: those with the voxel in the image, on a ray that ends on a surface. From `occupied_below` on
    the voxel is free. Below, it is occupied within `wall_voxels` of the mesh and unknown farther away (an
    occluded voxel need not be solid). Voxels that the mesh intersects are occupied, those at a training
    camera free. Free space that a ball of `passage_share` median depths cannot reach from the cameras is
    unknown: it lies behind a hole in the wall, or the wall itself is in doubt.

    Args:
        scene: the reconstructed scene.
        mesh: its surface.
        cameras: the training views; of more than `max_views` the most different are rendered.
        config: settings; None takes those of the profile `balanced`.
        surface_error_mm: expected distance of each vertex from the true surface, by which clearance is
            reduced (`extrags.surface_error`); None for a surface from measured depth.
        masks: pixels of each view that show tissue (`EndoscopicSequence.training_masks`), at the size of
            `cameras`: beyond the edge of a scope's picture no view looks through anything. None: all.

    Returns:
        The grid, aligned with the principal axes of mesh and cameras.

    Raises:
        CaptureError: when no voxel is free, or there is no view to carve from.
        ShapeError: for masks of other views.
        PoseError: for poses or intrinsics that are not finite.

    Source: [ExtraGS, section "Scene Initialization and Feasible Region Estimation"], see docs/references.md.
    """
    config = PROFILES[DEFAULT_PROFILE].freespace if config is None else config
    if not len(cameras):
        raise CaptureError("no views to carve free space from")
    cameras.check_finite()
    # Transmittance at points comes from the native kernels, and the grid is on the processor.
    scene = scene.to("cpu")
    size = config.grid_size
    origin_mm, axes, voxel_mm, extent_voxels = _bounding_volume(mesh, cameras, config)
    # The grid is a cube with the longest side of the bounding volume; along the other axes the volume ends
    # before the cube does.
    index = np.arange(size) + 0.5
    inside = [np.abs(index - size / 2) <= extent / 2 for extent in extent_voxels]
    within = inside[0][:, None, None] & inside[1][None, :, None] & inside[2][None, None, :]

    corners = to_grid(mesh.vertices.astype(np.float64), origin_mm, axes, voxel_mm)
    surface = voxels_of_triangles(corners[mesh.triangles], size)
    carving = carving_views(scene, cameras, config, masks)
    views = ViewDepths.rendered(scene, cameras[carving], config, chosen_masks(masks, cameras, carving))
    free = seen_through(scene, views, origin_mm, axes, voxel_mm, within & ~surface, config)
    at_cameras, lens = _around_cameras(to_grid(cameras.centers, origin_mm, axes, voxel_mm), surface)
    free |= lens
    # The distance is that of faces: a voxel's own half does not count.
    near = distance_to_cubes(surface, config.wall_voxels) <= config.wall_voxels - 0.5
    occupied = (surface | near) & ~free
    radius = config.passage_share * views.unit_mm / voxel_mm
    free = lens | reachable(free, _clearance(free, occupied), at_cameras, radius)
    if not free.any():
        raise CaptureError("no voxel of the scene is free; the views see no surface at a distance")
    occupancy = np.select([free, occupied], [np.uint8(FREE), np.uint8(OCCUPIED)], np.uint8(UNKNOWN))

    # Unknown space may hold the wall: only what is known to be free gives room.
    distance = _clearance(free, ~free) * voxel_mm
    if surface_error_mm is not None and len(surface_error_mm):
        less = distance - _nearest_error(corners, surface_error_mm, size)
        distance = np.where(distance > 0, np.maximum(less, 0.0), distance)
    space = FreeSpace(occupancy, origin_mm, axes, voxel_mm, distance.astype(np.float32))
    _log.info(
        "freespace: %.1f %% of %d^3 voxels, %.3g units of the poses wide, are free",
        100 * space.free_share,
        size,
        voxel_mm,
    )
    return space


def carving_views(
    scene: Scene,
    cameras: Cameras,
    config: FreespaceConfig,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> Int[np.ndarray, "m"]:
    """Which views carve: all, or the `max_views` that differ most by place and direction, in their order.

    Farthest point sampling from the view nearest to the middle of all, by `extrags.cameras.pose_distances`
    in units of the depth that eight views spread over the recording see, inside their masks.

    Source: [Gonzalez1985], see docs/references.md.
    """
    if len(cameras) <= config.max_views:
        return np.arange(len(cameras))
    some = np.linspace(0, len(cameras) - 1, VIEWS_FOR_THE_UNIT).round().astype(np.int64)
    unit_mm = ViewDepths.rendered(scene, cameras[some], config, chosen_masks(masks, cameras, some)).unit_mm
    if unit_mm <= 0:
        raise CaptureError(f"none of {len(some)} views spread over the recording sees a surface")
    chosen = [int(np.argmin(np.linalg.norm(cameras.centers - cameras.centers.mean(axis=0), axis=1)))]
    nearest = np.full(len(cameras), np.inf)
    while len(chosen) < config.max_views:
        nearest = np.minimum(nearest, pose_distances(cameras, cameras[chosen[-1]], unit_mm)[:, 0])
        nearest[chosen] = -1.0
        chosen.append(int(np.argmax(nearest)))
    return np.sort(chosen)


def _around_cameras(
    centers: Float[np.ndarray, "c 3"], surface: Bool[np.ndarray, "s s s"]
) -> tuple[Int[np.ndarray, "c 3"], Bool[np.ndarray, "s s s"]]:
    """Voxels of the cameras, and those free because a camera was there; centres in grid coordinates.

    A wall ends the ball around a camera: what is nearby may still be behind it.
    """
    from scipy.ndimage import binary_propagation

    size = len(surface)
    # Without padding a camera may lie exactly on a face of the volume.
    index = np.clip(np.floor(centers).astype(np.int64), 0, size - 1)
    at = np.zeros_like(surface)
    mark(at, index)
    ball = ball_mask(centers, size, LENS_VOXELS) & ~surface
    low, high = np.maximum(index.min(axis=0) - 3, 0), index.max(axis=0) + 4
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    lens = at.copy()
    lens[box] |= binary_propagation(at[box] & ~surface[box], mask=ball[box])
    return index, lens


def _clearance(
    free: Bool[np.ndarray, "s s s"], blocked: Bool[np.ndarray, "s s s"]
) -> Float[np.ndarray, "s s s"]:
    """Distance of centres from the nearest blocked cube, in voxels, negative inside.

    It is told apart up to the largest of a free voxel, and inside up to `WALL_DEPTH`.
    """
    from scipy.ndimage import distance_transform_edt

    size = len(free)
    if not blocked.any() or not free.any():
        return np.full(free.shape, np.float32(size))
    # From a free voxel the nearest blocked one is no farther by cubes than by centres.
    near = box_around(free, 1.0)
    held = near if blocked[near].mean() > 0.5 else box_around(free | blocked, 0.0)
    limit = float(np.asarray(distance_transform_edt(~blocked[held]))[free[held]].max())
    box = box_around(free, limit + 2.0)
    distance = np.where(blocked, np.float32(-WALL_DEPTH), np.float32(limit))
    distance[box] = signed_distance(blocked[box], limit, WALL_DEPTH)
    return distance


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
    along = rotated(points, axes)
    low, high = along.min(axis=0), along.max(axis=0)
    side = float((high - low).max()) * (1 + 2 * config.margin_share)
    if side <= 0:
        raise CaptureError("mesh and cameras lie in one point; there is no volume to explore")
    voxel_mm = side / config.grid_size
    origin_mm = ((low + high) / 2 - side / 2) @ axes
    extent_voxels = (high - low) / voxel_mm + 2 * config.margin_share * config.grid_size
    return origin_mm, axes, voxel_mm, extent_voxels


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
