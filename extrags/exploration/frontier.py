"""Frontier voxels: where views through a hole of the scene leave what is known to be free.

Missing surface has no Gaussians that could count as covered. The voxels that bound the free space take
their place in the coverage map: a view covers a (voxel, direction) pair where a ray that meets no surface
enters the voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from extrags.cameras import Cameras, pixel_rays
from extrags.errors import ShapeError
from extrags.exploration.coverage import direction_bin
from extrags.freespace import FREE, FreeSpace
from extrags.raster.native import compiled_kernels
from extrags.scene import Scene
from extrags.unique_rows import unique_rows

__all__ = ["Frontier", "find_frontier"]


@dataclass(frozen=True)
class Frontier:
    """The voxels, not known to be free, that touch a free one; the grid is padded by a voxel on each side.

    Args:
        space: free space.
        row: index of each frontier voxel in the coverage map's further rows, -1 for all other voxels,
            [S + 2, S + 2, S + 2].
        reach: distance to the nearest voxel that is not free, in voxels, 0 inside those, same shape.
        centers: of the frontier voxels in world units, [F, 3].
        pair_value: worth of a (frontier voxel, direction) pair in (Gaussian, direction) pairs.
    """

    space: FreeSpace
    row: Int[np.ndarray, "p p p"]
    reach: Float[np.ndarray, "p p p"]
    centers: Float[np.ndarray, "f 3"]
    pair_value: float

    def __len__(self) -> int:
        return len(self.centers)

    def pairs(
        self, camera: Cameras, holes: Bool[np.ndarray, "h w"], n_directions: int
    ) -> tuple[Int[np.ndarray, "m"], UInt32[np.ndarray, "m"]]:
        """(Frontier voxel, direction) pairs that a view covers: voxels, rising, and a word for each.

        The direction is that from the voxel to the camera.

        Args:
            camera: the view, a batch of one.
            holes: its pixels without a surface.
            n_directions: D.

        Raises:
            ShapeError: when the mask does not fit the camera.
        """
        seen, _ = self.counts(camera, holes)
        toward = camera.centers[0] - self.centers[seen]
        toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
        return seen, np.uint32(1) << direction_bin(toward, n_directions).astype(np.uint32)

    def counts(
        self, camera: Cameras, holes: Bool[np.ndarray, "h w"]
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Frontier voxels that a view looks into through its holes, rising, and in how many pixels.

        Each ray through a hole is followed to the first voxel that is not free: from face to face, and far
        from all such voxels in strides that cannot pass one ([Hart1996], with the distances in `reach`).

        Args:
            camera: the view, a batch of one.
            holes: its pixels without a surface.

        Raises:
            ShapeError: when the mask does not fit the camera.
        """
        if holes.shape != (camera.height, camera.width):
            raise ShapeError(f"holes {holes.shape} for an image of {camera.height} x {camera.width}")
        rays = pixel_rays(camera)[0][holes]
        if len(rays) == 0 or len(self) == 0:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        start = self.space.to_grid(camera.centers[0]) + 1
        step = self.space.to_grid(camera.centers[0] + rays) + 1 - start
        step /= np.linalg.norm(step, axis=1, keepdims=True)
        entered = np.empty(len(step), dtype=np.int64)
        compiled_kernels().march(self.reach, np.ascontiguousarray(start), np.ascontiguousarray(step), entered)
        rows = self.row.reshape(-1)[entered[entered >= 0]]
        count = np.bincount(rows[rows >= 0], minlength=len(self))
        seen = np.flatnonzero(count)
        return seen, count[seen]


def find_frontier(scene: Scene, space: FreeSpace, weight: float) -> Frontier:
    """The frontier of a scene's free space, and what a voxel of it is worth.

    A voxel of missing surface is worth `weight` voxels of known surface: as many pairs as Gaussians lie, on
    average, in a voxel that holds any.

    Args:
        scene: its Gaussians' centres are counted.
        space: where cameras may go.
        weight: `explore.hole_weight`; 0 gives a frontier without voxels.

    Source: [Yamauchi1997], see docs/references.md; the weight is our own.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt

    free = np.pad(space.occupancy == FREE, 1)
    touching = binary_dilation(free, np.ones((3, 3, 3), bool)) & ~free & (weight > 0)
    row = np.full(free.shape, -1, dtype=np.int32)
    row[touching] = np.arange(np.count_nonzero(touching), dtype=np.int32)
    centers = space.from_grid(np.argwhere(touching) - 0.5)
    voxels = np.floor(space.to_grid(scene.gaussians.means.detach().numpy().astype(np.float64)))
    held = len(unique_rows(voxels)[0])
    return Frontier(
        space=space,
        row=row,
        reach=np.asarray(distance_transform_edt(free), dtype=np.float32),
        centers=centers,
        pair_value=weight * len(voxels) / max(1, held),
    )
