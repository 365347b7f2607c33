"""Light and pictures of a cavity whose wall, skin and lamps are known."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.lamps import Lamps
from data_catalog.cavities.skin import SkinValues
from data_catalog.cavities.surface import Wall, unit
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, pixel_rays

__all__ = ["Painted", "pinhole", "radiance", "z_depth"]


@runtime_checkable
class Painted(Protocol):
    """What a wall looks like."""

    @property
    def at_vertices(self) -> Float[np.ndarray, "v c"]:
        """Values that are interpolated between vertices and handed to `at`."""

    def at(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        slow: Float[np.ndarray, "n c"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> SkinValues:
        """The skin at points of the wall."""


def pinhole(width: int, height: int, field_of_view_deg: float) -> Float[np.ndarray, "3 3"]:
    """A centred pinhole with square pixels; the field of view is the horizontal one."""
    focal = width / 2 / np.tan(np.radians(field_of_view_deg) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def z_depth(rays: RayCaster, camera: Cameras) -> Float[np.ndarray, "h w"]:
    """Exact z-depth at pixel centres, float32; infinite where a ray meets nothing."""
    return rays.cast(camera.centers[0], pixel_rays(camera)[0]).distance


def radiance(
    wall: Wall, skin: Painted, lamps: Lamps, rays: RayCaster, camera: Cameras, supersample: int
) -> Float[np.ndarray, "h w 3"]:
    """Linear light that reaches the sensor at unit exposure, mean over a pixel's rays.

    Args:
        wall: the mesh that `rays` was made of.
        skin: of the wall.
        lamps: beside the lens.
        rays: the wall as a target.
        camera: one.
        supersample: rays per pixel and axis.
    """
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    directions = pixel_rays(fine)[0]
    center = camera.centers[0]
    hits = rays.cast(center, directions)
    depth = hits.distance.ravel()
    found = np.isfinite(depth)
    depth = depth[found]
    directions = directions.reshape(-1, 3).astype(np.float32)[found]
    corners = wall.triangles[hits.triangle.ravel()[found]]
    u, v = hits.barycentric.reshape(-1, 2)[found].astype(np.float32).T
    weights = np.stack([1 - u - v, u, v], axis=1)
    normals = unit(_between(wall.normals, corners, weights))
    slow = _between(skin.at_vertices, corners, weights)
    length = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    to_camera = -directions / length[:, None]
    # Seen from behind, a smooth normal between coarse triangles would be black.
    normals = np.where(
        (np.einsum("ij,ij->i", normals, to_camera) < 0)[:, None], unit(normals + to_camera), normals
    )
    slant = np.clip(np.einsum("ij,ij->i", normals, to_camera), 0.1, 1)
    footprint = (depth * length / (fine.K[0, 0, 0] * np.sqrt(slant))).astype(np.float32)
    points = (center + directions * depth[:, None].astype(np.float64)).astype(np.float32)
    values = skin.at(points, normals, slow, footprint)
    rotation = camera.world_from_camera[0, :3, :3]
    to_lights, cosines, visible = [], [], []
    for offset in lamps.offsets_mm:
        position = rotation @ np.asarray(offset)
        # Relative to the camera: differences of world coordinates would lose digits in float32.
        from_lamp = directions * depth[:, None] - position.astype(np.float32)
        to_lights.append(-from_lamp)
        distance = np.sqrt(np.einsum("ij,ij->i", from_lamp, from_lamp))
        axis = rotation[:, 2].astype(np.float32)
        cosines.append(np.einsum("ij,j->i", from_lamp, axis) / np.maximum(distance, 1e-6))
        visible.append(rays.reaches(center + position, from_lamp))
    light = lamps.radiance(to_camera, to_lights, cosines, visible, normals, values)
    image = np.zeros((found.size, 3), dtype=np.float32)
    image[found] = light
    blocks = image.reshape(camera.height, supersample, camera.width, supersample, 3)
    # A glint may be thousands of times brighter than the tissue: a sensor is full long before.
    level = 40 * float(np.median(image.mean(axis=1))) + 1e-9
    return np.asarray(np.minimum(blocks, level).mean(axis=(1, 3)), dtype=np.float32)


def _between(
    at_vertices: Float[np.ndarray, "v c"], corners: np.ndarray, weights: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n c"]:
    total = weights[:, :1] * at_vertices[corners[:, 0]]
    total += weights[:, 1:2] * at_vertices[corners[:, 1]]
    total += weights[:, 2:] * at_vertices[corners[:, 2]]
    return np.asarray(total, dtype=np.float32)
