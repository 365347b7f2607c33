"""Colour, texture and provenance of a mesh: every point of the surface as the views see it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from extrags.cameras import Cameras, project_points, transform_points
from extrags.errors import CaptureError
from extrags.events import Progress, emit
from extrags.scene import Scene
from extrags.shown_pixels import chosen_masks, shown_pixels
from extrags.surface import Mesh

__all__ = ["ColoredMesh", "colored_mesh"]

_LARGEST_TEXTURE_PX = 4096
_MOST_TEXELS, _FEWEST_TEXELS = 12, 4
"""Texels along the edge of a triangle."""
_TEXELS_PER_PIXEL = 2
"""Of all views together: more would show nothing that the views hold."""
_DEPTH_TOLERANCE = 0.02
"""A view colours a point that lies at most so much behind the rendered surface, as a share of depth."""
_MIN_FACING = 0.1
"""And whose normal turns towards it: the cosine of incidence."""
_SEEN_EDGES = 2.0
"""For a point to count as seen it may lie so many edges of triangles deeper than that, and turn anywhere.

Fusion moves the surface by about a voxel and rounds rims off, whose normals then point aside. With the test
of the colours 7.6 % of a mesh fused from training views alone counted as invented, with this one 0.4 %; of
surface that virtual views alone had shown, 99.2 % instead of 99.8 %.
"""
_VIEWS_PER_BATCH = 8


@dataclass(frozen=True)
class ColoredMesh:
    """A mesh as files hold it.

    Args:
        mesh: positions and triangles.
        colors: of each vertex, [V, 3].
        invented: of each vertex: 0 where at least one training view sees it, or sees what lies behind it,
            up to two edges of triangles; 1 where none does, [V].
        texture: an image of the whole surface, or None.
        uv: where the corners of each triangle lie in it, from its lower left corner in [0, 1], [T, 3, 2].
    """

    mesh: Mesh
    colors: UInt8[np.ndarray, "v 3"]
    invented: Float[np.ndarray, "v"]
    texture: UInt8[np.ndarray, "h w 3"] | None = None
    uv: Float[np.ndarray, "t 3 2"] | None = None


def colored_mesh(
    mesh: Mesh,
    scene: Scene,
    train: Cameras,
    virtual: Cameras | None = None,
    *,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
    texture: bool = True,
) -> ColoredMesh:
    """Colour a mesh from renderings of a scene, and mark what no training view has seen.

    A point takes the mean of what the views show of it, weighted by the cosine of incidence and by the
    inverse square of the distance; a view counts where its rendered depth says that it sees the point.
    Points that no view colours take the colour of the nearest that one does.

    Args:
        mesh: the surface.
        scene: colours it; without light (`extrags.splat_files.bake_light`), or seams of brightness stay.
            It is rendered on the processor, wherever it is.
        train: the training views.
        virtual: further views, which colour what training views do not see; of any size, with or without a
            lens.
        masks: pixels of the training views that show tissue (`EndoscopicSequence.training_masks`): beyond
            the edge of a scope's picture they see nothing. None: all.
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
    parts = [train] if virtual is None or not len(virtual) else [train, virtual]
    atlas: _Atlas | None = None
    on_vertices, on_texels = _Seen(vertices, normals), _Seen(vertices[:0], normals[:0])
    owner = np.zeros(0, dtype=np.int64)
    if texture:
        pixels = sum(len(views) * views.width * views.height for views in parts)
        atlas = _Atlas.of(len(mesh.triangles), _TEXELS_PER_PIXEL * pixels)
        texels, owner = atlas.positions(corners)
        on_texels = _Seen(texels, faces[owner])
    slack = _SEEN_EDGES * float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    training = np.zeros(len(vertices), dtype=bool)
    # Vertices and texels are coloured together: every view is rendered once.
    for index, view in enumerate(_rendered(scene, parts, masks)):
        shown = on_vertices.add(view, slack)
        if index < len(train):
            training |= shown
        # A triangle is about as large as a pixel: where none of its corners is visible, little of it is.
        on_texels.add(view, slack, np.flatnonzero(shown[mesh.triangles].any(axis=1)[owner]))
    if not (on_vertices.weight > 0).any():
        raise CaptureError(f"none of the {sum(map(len, parts))} views sees any of the mesh")
    known = on_vertices.points[on_vertices.weight > 0], on_vertices.means()[on_vertices.weight > 0]
    colors = on_vertices.filled(*known)
    invented = np.where(training, 0, 1).astype(np.float32)
    if atlas is None:
        return ColoredMesh(mesh, colors, invented)
    return ColoredMesh(mesh, colors, invented, atlas.image(on_texels.filled(*known)), atlas.uv())


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
    def of(cls, triangles: int, texels: int) -> _Atlas:
        """The finest atlas with about so many texels, but with no fewer than interpolation needs."""
        pairs = -(-triangles // 2)
        for edge in range(_MOST_TEXELS, _FEWEST_TEXELS - 1, -1):
            if edge > _FEWEST_TEXELS and pairs * edge * (edge + 1) > texels:
                continue
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


@dataclass(frozen=True)
class _View:
    camera: Cameras
    image: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    alpha: Float[np.ndarray, "h w"]


def _rendered(
    scene: Scene, parts: Sequence[Cameras], masks: Sequence[Bool[np.ndarray, "h w"]] | None
) -> Iterator[_View]:
    """The views of all parts; those of the first show nothing outside of their masks."""
    # The median depth comes from the native kernels.
    scene = scene.to("cpu")
    done, total = 0, sum(map(len, parts))
    for views, shown in zip(parts, (masks, None), strict=False):
        for begun in range(0, len(views), _VIEWS_PER_BATCH):
            batch = views[begun : begun + _VIEWS_PER_BATCH]
            with torch.no_grad():
                rendering = scene.render(batch, median_depth=True)
            inside = chosen_masks(shown, views, range(begun, begun + len(batch)))
            depths = np.asarray(rendering.median_depth)
            alphas = np.where(shown_pixels(inside, batch, batch), rendering.alpha.numpy(), 0)
            for index, image in enumerate(rendering.rgb.numpy()):
                yield _View(batch[index], image, depths[index], alphas[index])
            done += len(batch)
            emit(Progress("export", done, total))


class _Seen:
    """What views show of points, summed up.

    Args:
        points: of the surface, [P, 3].
        normals: of any length; they point into free space, where the cameras are, [P, 3].
    """

    def __init__(self, points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]) -> None:
        self.points = points
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        self.weight = np.zeros(len(points))
        self._sums = np.zeros((len(points), 3))

    def add(
        self, view: _View, slack: float, rows: Int[np.ndarray, "r"] | None = None
    ) -> Bool[np.ndarray, "p"]:
        """Add what a view shows, of some of the points or of all.

        Returns:
            Which of the points it sees, so far as `slack` behind its surface.
        """
        shown = np.zeros(len(self.points), dtype=bool)
        rows = np.arange(len(self.points)) if rows is None else rows
        camera = view.camera
        local = transform_points(camera.viewmats[0], self.points[rows])
        pixels = project_points(local, camera.K[0], camera.lens)
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero(camera.contains(pixels))
        rows, pixels = rows[inside], pixels[inside]
        u, v = np.floor(pixels).astype(np.int64).T
        depth = view.depth[v, u]
        surface = (depth > 0) & (view.alpha[v, u] > 0.5)
        behind = local[inside, 2] - depth * (1 + _DEPTH_TOLERANCE)
        shown[rows[surface & (behind <= slack)]] = True
        toward = camera.centers[0] - self.points[rows]
        distance = np.linalg.norm(toward, axis=1)
        cosine = (toward * self.normals[rows]).sum(axis=1) / np.maximum(distance, 1e-30)
        good = surface & (behind <= 0) & (cosine > _MIN_FACING)
        share = cosine[good] / distance[good] ** 2
        self.weight[rows[good]] += share
        self._sums[rows[good]] += share[:, None] * _bilinear(view.image, pixels[good])
        return shown

    def means(self) -> Float[np.ndarray, "p 3"]:
        """Mean colour of each point, black where there is none."""
        return np.asarray(self._sums / np.maximum(self.weight, 1e-30)[:, None])

    def filled(
        self, points: Float[np.ndarray, "k 3"], colors: Float[np.ndarray, "k 3"]
    ) -> UInt8[np.ndarray, "p 3"]:
        """Mean colour of each point; that of the nearest of some known points where there is none."""
        from scipy.spatial import cKDTree

        means, unknown = self.means(), self.weight <= 0
        if unknown.any():
            means[unknown] = colors[cKDTree(points).query(self.points[unknown])[1]]
        return np.asarray(np.rint(means.clip(0, 1) * 255).astype(np.uint8))


def _bilinear(image: Float[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "p 2"]) -> np.ndarray:
    height, width = image.shape[:2]
    at = (pixels - 0.5).clip(0, [width - 1.0, height - 1.0])
    low = np.minimum(np.floor(at).astype(np.int64), [width - 2, height - 2]).clip(0)
    (a, b), (x, y) = (at - low).T, low.T
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = image[y, x] * (1 - a)[:, None] + image[y, right] * a[:, None]
    lower = image[below, x] * (1 - a)[:, None] + image[below, right] * a[:, None]
    return np.asarray(upper * (1 - b)[:, None] + lower * b[:, None])
