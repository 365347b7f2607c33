"""Colour, texture and provenance of a mesh: every point of the surface as the views see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from extrags.cameras import Cameras, project_points, transform_points
from extrags.errors import CaptureError
from extrags.events import Progress, emit
from extrags.scene import Scene
from extrags.surface import Mesh

__all__ = ["ColoredMesh", "colored_mesh"]

_LARGEST_TEXTURE_PX = 4096
_MOST_TEXELS, _FEWEST_TEXELS = 12, 4
"""Texels along the edge of a triangle: more would show nothing new at the size of the frames."""
_DEPTH_TOLERANCE = 0.02
"""A point counts as seen where it lies at most so much behind the rendered surface, as a share of depth."""
_MIN_FACING = 0.1
_VIEWS_PER_BATCH = 8


@dataclass(frozen=True)
class ColoredMesh:
    """A mesh as files hold it.

    Args:
        mesh: positions and triangles.
        colors: of each vertex, [V, 3].
        invented: of each vertex: 0 where at least one training view sees it, 1 where none does, [V].
        texture: an image of the whole surface, or None.
        uv: where the corners of each triangle lie in it, from its lower left corner in [0, 1], [T, 3, 2].
    """

    mesh: Mesh
    colors: UInt8[np.ndarray, "v 3"]
    invented: Float[np.ndarray, "v"]
    texture: UInt8[np.ndarray, "h w 3"] | None = None
    uv: Float[np.ndarray, "t 3 2"] | None = None


def colored_mesh(
    mesh: Mesh, scene: Scene, train: Cameras, virtual: Cameras | None = None, *, texture: bool = True
) -> ColoredMesh:
    """Colour a mesh from renderings of a scene, and mark what no training view has seen.

    A point takes the mean of what the views show of it, weighted by the cosine of incidence and by the
    inverse square of the distance; a view counts where its rendered depth says that it sees the point.
    Points that no view sees take the colour of the nearest that one does.

    Args:
        mesh: the surface.
        scene: colours it; without light (`extrags.splat_files.bake_light`), or seams of brightness stay.
        train: the training views.
        virtual: further views, which colour what training views do not see.
        texture: make an image of the surface as well, not only colours of vertices.

    Raises:
        CaptureError: when no view sees any of the mesh.
    """
    vertices = mesh.vertices.astype(np.float64)
    corners = vertices[mesh.triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, mesh.triangles[:, corner], faces)
    atlas = _Atlas.of(len(mesh.triangles)) if texture else None
    # Vertices and texels are coloured together: every view is rendered once.
    located, facing = [vertices], [normals]
    if atlas is not None:
        texels, owner = atlas.positions(corners)
        located.append(texels)
        facing.append(faces[owner])
    views = train if virtual is None or not len(virtual) else Cameras.concatenated([train, virtual])
    points, directions = np.concatenate(located), _unit(np.concatenate(facing))
    colors, weight, seen = _observed(points, directions, scene, views, len(train))
    if not (weight > 0).any():
        raise CaptureError(f"none of the {len(views)} views sees any of the mesh")
    colors = _filled(points, colors, weight)
    count = len(vertices)
    invented = np.where(seen[:count], 0, 1).astype(np.float32)
    as_bytes = np.rint(colors.clip(0, 1) * 255).astype(np.uint8)
    if atlas is None:
        return ColoredMesh(mesh, as_bytes, invented)
    return ColoredMesh(mesh, as_bytes[:count], invented, atlas.image(as_bytes[count:]), atlas.uv())


@dataclass(frozen=True)
class _Atlas:
    """Rectangles of an image, each for two triangles of a mesh, in their order.

    The first triangle of a pair has its right angle in the rectangle's upper left, the second in its lower
    right corner; one diagonal of texels between belongs to each, so that interpolation never mixes them.
    """

    triangles: int
    edge: int
    columns: int
    rows: int

    @classmethod
    def of(cls, triangles: int) -> _Atlas:
        pairs = -(-triangles // 2)
        for edge in range(_MOST_TEXELS, _FEWEST_TEXELS - 1, -1):
            columns = max(1, int(np.ceil(np.sqrt(pairs * edge / (edge + 1)))))
            rows = -(-pairs // columns)
            if max(columns * (edge + 1), rows * edge) <= _LARGEST_TEXTURE_PX:
                return cls(triangles, edge, columns, rows)
        raise CaptureError(
            f"{triangles} triangles do not fit into a texture of {_LARGEST_TEXTURE_PX} x "
            f"{_LARGEST_TEXTURE_PX} pixels; take a coarser surface (surface.voxel_share), or no texture"
        )

    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Texels (x, y) of the corners of a rectangle's two triangles."""
        n = self.edge
        return np.array([[0, 0], [n - 2, 0], [0, n - 2]]), np.array([[n, n - 1], [2, n - 1], [n, 1]])

    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Upper left texel (x, y) of each triangle's rectangle, and whether it is the second in it."""
        index = np.arange(self.triangles)
        pair = index // 2
        start = np.stack([pair % self.columns * (self.edge + 1), pair // self.columns * self.edge], axis=1)
        return start, index % 2 == 1

    def _texels(self) -> list[np.ndarray]:
        """Texels (x, y) in the rectangle that belong to the first and to the second triangle."""
        n = self.edge
        x, y = (part.reshape(-1) for part in np.meshgrid(np.arange(n + 1), np.arange(n)))
        first = x + y <= n - 1
        all_of = np.stack([x, y], axis=1)
        return [all_of[first], all_of[~first]]

    def positions(self, corners: Float[np.ndarray, "t 3 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Points of the surface at all texels, and the triangle each belongs to."""
        points, owners = [], []
        for which, (texels, at) in enumerate(zip(self._texels(), self._corners(), strict=True)):
            edges = np.stack([at[1] - at[0], at[2] - at[0]], axis=1).astype(np.float64)
            second, third = np.linalg.solve(edges, (texels - at[0]).T.astype(np.float64))
            shares = np.stack([1 - second - third, second, third], axis=1)
            owner = np.arange(which, self.triangles, 2)
            points.append(np.einsum("sk,tkc->tsc", shares, corners[owner]).reshape(-1, 3))
            owners.append(np.repeat(owner, len(texels)))
        return np.concatenate(points), np.concatenate(owners)

    def image(self, colors: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The texture from colours at `positions`."""
        picture = np.zeros((self.rows * self.edge, self.columns * (self.edge + 1), 3), dtype=np.uint8)
        start, second = self._places()
        begun = 0
        for texels, chosen in zip(self._texels(), (~second, second), strict=True):
            at = (start[chosen][:, None] + texels[None]).reshape(-1, 2)
            picture[at[:, 1], at[:, 0]] = colors[begun : begun + len(at)]
            begun += len(at)
        return picture

    def uv(self) -> Float[np.ndarray, "t 3 2"]:
        """Texture coordinates of all corners, from the lower left."""
        start, second = self._places()
        first_at, second_at = self._corners()
        at = start[:, None] + np.where(second[:, None, None], second_at, first_at) + 0.5
        size = np.array([self.columns * (self.edge + 1), self.rows * self.edge])
        shares = at / size
        shares[..., 1] = 1 - shares[..., 1]
        return np.asarray(shares, dtype=np.float32)


def _observed(
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"],
    scene: Scene,
    views: Cameras,
    n_train: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean colour of each point over the views, its weight, and whether one of the first views sees it."""
    colors = np.zeros((len(points), 3))
    weight = np.zeros(len(points))
    seen = np.zeros(len(points), dtype=bool)
    for begun in range(0, len(views), _VIEWS_PER_BATCH):
        batch = views[begun : begun + _VIEWS_PER_BATCH]
        with torch.no_grad():
            rendering = scene.render(batch, median_depth=True)
        depths = np.asarray(rendering.median_depth)
        images, alphas = rendering.rgb.numpy(), rendering.alpha.numpy()
        for index in range(len(batch)):
            camera = batch[index]
            local = transform_points(camera.viewmats[0], points)
            with np.errstate(invalid="ignore"):
                inside = camera.contains(project_points(local, camera.K[0])) & (local[:, 2] > 0)
            rows = np.flatnonzero(inside)
            pixels = project_points(local[rows], camera.K[0])
            u, v = np.floor(pixels).astype(np.int64).T
            depth = depths[index, v, u]
            near = local[rows, 2] <= depth * (1 + _DEPTH_TOLERANCE)
            toward = camera.centers[0] - points[rows]
            distance = np.linalg.norm(toward, axis=1)
            # The normals of the mesh point into free space, where the cameras are.
            cosine = (toward * normals[rows]).sum(axis=1) / np.maximum(distance, 1e-30)
            good = near & (depth > 0) & (alphas[index, v, u] > 0.5) & (cosine > _MIN_FACING)
            rows, u, v = rows[good], u[good], v[good]
            share = cosine[good] / distance[good] ** 2
            weight[rows] += share
            colors[rows] += share[:, None] * _bilinear(images[index], pixels[good])
            if begun + index < n_train:
                seen[rows] = True
        emit(Progress("export", min(begun + _VIEWS_PER_BATCH, len(views)), len(views)))
    return colors / np.maximum(weight, 1e-30)[:, None], weight, seen


def _bilinear(image: Float[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "p 2"]) -> np.ndarray:
    height, width = image.shape[:2]
    at = (pixels - 0.5).clip(0, [width - 1.0, height - 1.0])
    low = np.minimum(np.floor(at).astype(np.int64), [width - 2, height - 2]).clip(0)
    (a, b), (x, y) = (at - low).T, low.T
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = image[y, x] * (1 - a)[:, None] + image[y, right] * a[:, None]
    lower = image[below, x] * (1 - a)[:, None] + image[below, right] * a[:, None]
    return np.asarray(upper * (1 - b)[:, None] + lower * b[:, None])


def _filled(points: np.ndarray, colors: np.ndarray, weight: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    known = weight > 0
    if known.all():
        return colors
    nearest = cKDTree(points[known]).query(points[~known])[1]
    filled = colors.copy()
    filled[~known] = colors[known][nearest]
    return filled


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))
