"""Triangle mesh of a scene by TSDF fusion of rendered depth."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from extrags.cameras import Cameras
from extrags.config import DEFAULT_PROFILE, PROFILES, SurfaceConfig
from extrags.errors import CaptureError, ShapeError
from extrags.events import Progress, emit
from extrags.frame_quantiles import quantile_of_frames
from extrags.frame_stacks import FrameStack
from extrags.output_files import whole_file
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.scene import Scene
from extrags.shown_pixels import chosen_masks, shown_pixels
from extrags.store.storable import Storable
from extrags.threads import one_torch_thread
from extrags.unique_rows import unique_rows
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["Mesh", "fuse_depth", "fuse_surface", "rendered_depth", "write_triangle_ply"]

_log = logging.getLogger(__name__)

LARGEST_DEPTH = 1000.0
"""Beyond this depth is fused in a larger unit."""
VIEWS_PER_BATCH = 8
"""Views rendered in one call; limits the memory, does not affect the result."""


@dataclass(frozen=True, slots=True)
class Mesh(Storable):
    """A triangle mesh.

    Args:
        vertices: positions in world units, [V, 3], float32.
        triangles: vertex indices, counter-clockwise seen from free space, [T, 3], int32.

    Raises:
        ShapeError: when a triangle refers to a vertex that does not exist.
    """

    stored_as: ClassVar[str] = "mesh"

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]

    def __post_init__(self) -> None:
        if self.triangles.size and not 0 <= self.triangles.min() <= self.triangles.max() < len(self.vertices):
            raise ShapeError(
                f"triangles use vertices {self.triangles.min()} to {self.triangles.max()}, "
                f"but there are {len(self.vertices)}"
            )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group with `vertices` and `triangles`."""
        with new_group(path) as group:
            write_array(group, "vertices", self.vertices.astype(np.float32))
            write_array(group, "triangles", self.triangles.astype(np.int32))

    @classmethod
    def load(cls, path: Path) -> Mesh:
        """Read what `save` wrote."""
        group = open_group(path)
        return cls(read_array(group, "vertices"), read_array(group, "triangles"))

    def write_ply(self, path: Path) -> None:
        """Write a binary PLY, which every mesh viewer opens."""
        vertex = np.empty(len(self.vertices), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
        for axis, name in enumerate("xyz"):
            vertex[name] = self.vertices[:, axis]
        write_triangle_ply(path, vertex, self.triangles)


def write_triangle_ply(path: Path, vertex: np.ndarray, triangles: Int[np.ndarray, "t 3"]) -> None:
    """Write a binary PLY of triangles, as plyfile does, which would write one triangle after the other.

    Args:
        path: of the file.
        vertex: one row for each vertex; its fields are the properties.
        triangles: vertex indices.
    """
    from plyfile import PlyData, PlyElement

    described = np.empty(len(triangles), dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(described, "face")]
    # In the file a list begins with its length.
    face = np.empty(len(triangles), dtype=[("length", "u1"), ("vertex_indices", "<i4", (3,))])
    face["length"], face["vertex_indices"] = 3, triangles
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(PlyData(elements, byte_order="<").header.encode("ascii") + b"\n")
        file.write(vertex.astype(vertex.dtype.newbyteorder("<")).tobytes())
        file.write(face.tobytes())


@one_torch_thread()
def fuse_surface(
    scene: Scene,
    cameras: Cameras,
    config: SurfaceConfig | None = None,
    *,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> Mesh:
    """Mesh of the surface visible in the views, by TSDF fusion of the scene's median depth.

    Voxel size and truncation distance are set from depth quantiles over all views: in a tubular organ there
    is no central object whose distance could define the scale.

    Args:
        scene: the reconstructed scene.
        cameras: the training views.
        config: settings; None takes those of the profile `balanced`.
        masks: pixels of each view that show tissue (`EndoscopicSequence.training_masks`), at the size of
            `cameras`: beyond the edge of a scope's picture nothing was seen. None: all.

    Returns:
        The mesh in canonical order: the same inputs give the same bits.

    Raises:
        CaptureError: when the views see no surface.
        ShapeError: for masks of other views.
    """
    config = PROFILES[DEFAULT_PROFILE].surface if config is None else config
    if not len(cameras):
        raise CaptureError("no views to fuse the surface from")
    views, depth = rendered_depth(scene, cameras, config, masks=masks)
    mesh = fuse_depth(views, depth, config)
    _log.info("surface: %d vertices, %d triangles", len(mesh.vertices), len(mesh.triangles))
    return mesh


def rendered_depth(
    scene: Scene,
    cameras: Cameras,
    config: SurfaceConfig,
    *,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> tuple[Cameras, Float[np.ndarray, "c h w"]]:
    """Median z-depth of all views, 0 where alpha is too low and where they show no tissue.

    The median is fused, not the expected depth, because at occlusion edges the expected depth lies between
    the foreground and the background surface.

    Args:
        scene: the reconstructed scene.
        cameras: the views.
        config: settings; images wider than `max_width` are rendered smaller.
        masks: as `fuse_surface`.

    Returns:
        The cameras at the size rendered, wide pinholes in place of a lens, and their depth.
    """
    # The median depth comes from the native kernels, and Open3D fuses it there.
    scene = scene.to("cpu")
    views = cameras.as_pinholes(WIDE_FIELD_DEG).at_most_width(config.max_width)
    found = FrameStack(len(views))
    with torch.no_grad():
        for start in range(0, len(views), VIEWS_PER_BATCH):
            part = np.arange(start, min(start + VIEWS_PER_BATCH, len(views)))
            batch = scene.render(views[part], median_depth=True)
            depth = cast("torch.Tensor", batch.median_depth)
            shown = shown_pixels(chosen_masks(masks, cameras, part), cameras[part], views[part])
            solid = (batch.alpha >= config.min_alpha) & torch.from_numpy(shown)
            for view in torch.where(solid, depth, 0.0).numpy():
                found.append(view.astype(np.float32, copy=False))
            emit(Progress("surface", len(found), len(views)))
    return views, found.array


def fuse_depth(cameras: Cameras, depth_mm: Float[np.ndarray, "c h w"], config: SurfaceConfig) -> Mesh:
    """TSDF fusion of depth maps (Curless and Levoy 1996) with Open3D's sparse voxel blocks.

    Args:
        cameras: the views, at the size of the depth maps.
        depth_mm: z-depth in world units, 0 where unknown.
        config: settings; None takes those of the profile `balanced`.

    Returns:
        The mesh, small clusters removed, in canonical order.

    Raises:
        ShapeError: when depth maps and cameras do not fit each other, or the cameras have a lens.
        CaptureError: when there is no valid depth or no surface comes out of it.
        PoseError: for poses or intrinsics that are not finite.
    """
    cameras.check_finite()
    if cameras.lens is not None:
        raise ShapeError("depth is fused from pinholes; take `Cameras.as_pinholes`")
    if depth_mm.shape != (len(cameras), cameras.height, cameras.width):
        raise ShapeError(
            f"depth has shape {depth_mm.shape}, expected {(len(cameras), cameras.height, cameras.width)}"
        )

    def valid() -> Iterator[Float[np.ndarray, "n"]]:
        return (view[view > 0] for view in depth_mm)

    typical_far_mm = quantile_of_frames(valid, 0.95)
    far_mm = quantile_of_frames(valid, config.depth_quantile)
    if typical_far_mm is None or far_mm is None:
        raise CaptureError(
            f"none of the {len(cameras)} views sees a surface; the reconstruction is empty there"
        )
    unit = _fusing_unit(typical_far_mm)
    voxel_mm = typical_far_mm * config.voxel_share
    if not any(bool((depths < far_mm).any()) for depths in valid()):
        # A wall that faces the camera has one depth, which is to be fused and not cut off.
        far_mm = float(np.nextafter(np.float32(far_mm), np.float32(np.inf)))

    import open3d as o3d
    import open3d.core as o3c

    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3c.float32, o3c.float32),
        attr_channels=(o3c.SizeVector([1]), o3c.SizeVector([1])),
        voxel_size=voxel_mm / unit,
        block_resolution=8,
        block_count=20_000,
        device=o3c.Device("CPU:0"),
    )
    # Open3D's VoxelBlockGrid, unlike its legacy integration, has pixel centres at +0.5, as this project has.
    # It rejects arrays with an explicit byte order, which zarr returns; astype yields the native one.
    K = cameras.K.astype(np.float64)
    viewmats = cameras.viewmats.astype(np.float64)
    viewmats[:, :3, 3] /= unit
    for index in range(len(cameras)):
        # A view without depth below the limit activates no block, which Open3D reports as an error.
        if not ((depth_mm[index] > 0) & (depth_mm[index] < far_mm)).any():
            continue
        depth = (depth_mm[index] / np.float32(unit)).astype(np.float32, order="C")
        image = o3d.t.geometry.Image(o3c.Tensor(depth))
        intrinsic, extrinsic = o3c.Tensor(K[index]), o3c.Tensor(viewmats[index])
        view = (image, intrinsic, extrinsic, 1.0, far_mm / unit, config.truncation_voxels)
        try:
            blocks = grid.compute_unique_block_coordinates(*view)
        except RuntimeError as error:
            # It looks at every fourth pixel; the depth of this view lies between them.
            if "No block is touched" not in str(error):
                raise
            continue
        grid.integrate(blocks, *view)
    if grid.hashmap().size() == 0:
        raise CaptureError(f"the depth of {len(cameras)} views holds no surface that could be fused")
    extracted = grid.extract_triangle_mesh(weight_threshold=0.5)
    if len(extracted.vertex.positions) == 0 or len(extracted.triangle.indices) == 0:
        raise CaptureError(f"the fused depth of {len(cameras)} views holds no surface")
    vertices, triangles = _canonical(
        extracted.vertex.positions.numpy() * np.float32(unit),
        extracted.triangle.indices.numpy().astype(np.int64),
    )
    return _without_small_clusters(vertices, triangles, config.min_cluster_triangles)


def _fusing_unit(typical_far_mm: float) -> float:
    """A power of two, so that no digit is lost: Open3D loses surface where depths are large numbers."""
    return float(2.0 ** max(0, math.floor(math.log2(typical_far_mm / LARGEST_DEPTH))))


def _canonical(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "unique 3"], Int[np.ndarray, "distinct 3"]]:
    """Sort vertices and triangles: their order from Open3D varies between runs, the positions do not."""
    # Adding zero turns -0.0 into 0.0, so that it is the same in all of them.
    unique, index = unique_rows(vertices + np.float32(0))
    triangles = index[triangles]
    distinct = (
        (triangles[:, 0] != triangles[:, 1])
        & (triangles[:, 1] != triangles[:, 2])
        & (triangles[:, 2] != triangles[:, 0])
    )
    triangles = triangles[distinct]
    first = np.argmin(triangles, axis=1)
    turned = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
    return unique, turned[np.lexsort(turned.T[::-1])]


def _without_small_clusters(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], min_triangles: int
) -> Mesh:
    """Remove connected components with fewer triangles, and unused vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(len(vertices), len(vertices)))
    _, label = connected_components(graph, directed=False)
    cluster = label[triangles[:, 0]]
    size = np.bincount(cluster, minlength=int(label.max()) + 1)
    triangles = triangles[size[cluster] >= min_triangles]
    if len(triangles) == 0:
        raise CaptureError(
            f"the largest piece of the surface has {int(size.max())} triangles, fewer than "
            f"surface.min_cluster_triangles = {min_triangles}"
        )
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles] = True
    renumbered = np.cumsum(used) - 1
    return Mesh(vertices[used].astype(np.float32), renumbered[triangles].astype(np.int32))
