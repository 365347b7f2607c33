"""Rays against a known surface, by Open3D's ray-casting scene (embree)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.cameras import Cameras

__all__ = ["Hits", "RayCaster"]

# A surface point counts as seen when the first hit on the way to it is no nearer than this.
_SEEN_TOLERANCE_MM = 0.05
# Shadow rays stop short of the wall they are aimed at, by this share of the way.
_NEARLY_THERE = 0.995


@dataclass(frozen=True)
class Hits:
    """First hits of a bundle of rays.

    Args:
        distance: in lengths of the ray's direction, infinite where nothing is hit, [*S].
        triangle: index into the wall's triangles, [*S].
        barycentric: embree's (u, v), [*S, 2].
    """

    distance: Float[np.ndarray, "*s"]
    triangle: Int[np.ndarray, "*s"]
    barycentric: Float[np.ndarray, "*s 2"]


class RayCaster:
    """A triangle mesh as a target for rays.

    Args:
        vertices: in world units.
        triangles: indices of vertices.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
        import open3d as o3d

        self._tensor = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(vertices.astype(np.float32)), self._tensor(triangles.astype(np.uint32))
        )

    def cast(self, origin: Float[np.ndarray, "3"], rays: Float[np.ndarray, "*s 3"]) -> Hits:
        """First hits of rays from one point; distances count in lengths of each ray."""
        found = self._scene.cast_rays(self._tensor(_packed(origin, rays)))
        return Hits(
            found["t_hit"].numpy(),
            found["primitive_ids"].numpy().astype(np.int64),
            found["primitive_uvs"].numpy(),
        )

    def reaches(
        self, origin: Float[np.ndarray, "3"], offsets: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, "n"]:
        """Which points of the surface, given as offsets from the origin, have nothing before them."""
        blocked = self._scene.test_occlusions(
            self._tensor(_packed(origin, offsets)), tnear=0.0, tfar=_NEARLY_THERE
        )
        return np.asarray(~blocked.numpy())

    def clearance_mm(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance to the surface."""
        distance = self._scene.compute_distance(self._tensor(points.astype(np.float32)))
        return np.asarray(distance.numpy())

    def seen_by(
        self,
        points: Float[np.ndarray, "p 3"],
        cameras: Cameras,
        mask: Bool[np.ndarray, "c h w"] | None = None,
    ) -> Bool[np.ndarray, "p"]:
        """Which points of the surface at least one camera sees, with nothing before them.

        Args:
            points: on the surface.
            cameras: who looks.
            mask: their valid pixels; None is all of the image.
        """
        seen = np.zeros(len(points), dtype=bool)
        if not len(points):
            return seen
        # The nearest cameras see most; only what they leave is cast again.
        distance = np.linalg.norm(cameras.centers - np.median(points, axis=0), axis=1)
        for index in np.argsort(distance, kind="stable"):
            left = np.flatnonzero(~seen)
            (pixels,), _ = cameras[int(index)].project(points[left])
            inside = cameras.contains(pixels)
            if mask is not None:
                column, row = pixels[inside].astype(np.int64).T
                inside[inside] = mask[index][row, column]
            candidates = left[inside]
            if candidates.size:
                toward = points[candidates] - cameras.centers[index]
                length = np.linalg.norm(toward, axis=1)
                hits = self.cast(cameras.centers[index], toward / length[:, None])
                seen[candidates[hits.distance >= length - _SEEN_TOLERANCE_MM]] = True
        return seen


def _packed(origin: Float[np.ndarray, "3"], rays: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 6"]:
    packed = np.empty((*rays.shape[:-1], 6), dtype=np.float32)
    packed[..., :3] = origin
    packed[..., 3:] = rays
    return packed
