"""The surface that comes with each video: what ties recordings together, and what was seen.

`coverage_mesh.obj` holds the model in the video's own world. Faces carry texture coordinate 1 where any ray
of any of the video's frames met them, 2 where none did. The meshes of a scene's videos have the same vertices
in the same order, so the motion between two worlds follows from them exactly (Procrustes).

The flags speak of the whole video and of all the fisheye sees. What a *training frame* saw of a held-out
frame's surface is another question, answered here by casting rays: it is what
`EndoscopicSequence.observed` holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, compose, pixel_rays
from extrags.errors import SourceError, SourceNotFoundError
from extrags.frame_stacks import empty_stack, frames_of

__all__ = ["Alignment", "CoverageMesh", "Surface", "align", "read_coverage_mesh"]

# Vertices are written with three decimals; a residual beyond this is another mesh or another order.
_LARGEST_RESIDUAL_MM = 0.2
_OBSERVED, _UNOBSERVED = 1, 2


@dataclass(frozen=True)
class CoverageMesh:
    """A surface and what a video saw of it.

    Args:
        vertices: in mm, in the video's world, [V, 3].
        triangles: vertex indices, [T, 3].
        observed: true where the video saw the face, [T].
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    observed: Bool[np.ndarray, "t"]

    @property
    def observed_share(self) -> float:
        """Share of the faces that the video saw."""
        return float(self.observed.mean())


@dataclass(frozen=True)
class Alignment:
    """The rigid motion from one video's world to another's.

    Args:
        target_from_source: [4, 4].
        residual_mm: root mean square distance of the vertices after it.
        largest_residual_mm: the largest of these distances.
    """

    target_from_source: Float[np.ndarray, "4 4"]
    residual_mm: float
    largest_residual_mm: float


def read_coverage_mesh(file: Path) -> CoverageMesh:
    """Vertices, faces and flags of a coverage mesh.

    Raises:
        SourceNotFoundError: no such file.
        SourceError: no vertices or faces, a face that is no triangle, names a vertex that is not there, or
            has a texture coordinate other than 1 and 2.
    """
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file, field="coverage")
    vertices: list[str] = []
    corners: list[list[str]] = []
    for line in file.read_text().splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append(" ".join(rest.split()[:3]))
        elif kind == "f":
            corners.append(rest.split())
    if not vertices or not corners:
        raise SourceError(
            f"{len(vertices)} vertices and {len(corners)} faces; expected a mesh", file=file, field="coverage"
        )
    try:
        points = np.array(" ".join(vertices).split(), dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise SourceError(f"a vertex is not three numbers: {error}", file=file, field="v") from error
    if not np.isfinite(points).all():
        raise SourceError("a vertex holds NaN or infinity", file=file, field="v")
    for index, face in enumerate(corners):
        # Written out: a generator for each of a hundred thousand faces takes four times as long.
        if len(face) != 3 or "/" not in face[0] or "/" not in face[1] or "/" not in face[2]:
            raise SourceError(
                f"face {index} is {' '.join(face)!r}; expected three corners as vertex/texture",
                file=file,
                field="f",
            )
    try:
        # Of one flat list, for the same reason.
        named = [number for face in corners for corner in face for number in corner.split("/", 2)[:2]]
        numbers = np.array(named, dtype=np.int64).reshape(-1, 3, 2)
    except ValueError as error:
        raise SourceError(f"a face is not made of whole numbers: {error}", file=file, field="f") from error
    triangles, flags = numbers[..., 0] - 1, numbers[:, 0, 1]
    outside = np.flatnonzero((triangles < 0).any(axis=1) | (triangles >= len(points)).any(axis=1))
    if outside.size:
        raise SourceError(
            f"face {int(outside[0])} names vertex {int(numbers[outside[0], :, 0].max())} of {len(points)}",
            file=file,
            field="f",
        )
    odd = np.flatnonzero(~np.isin(flags, (_OBSERVED, _UNOBSERVED)))
    if odd.size:
        raise SourceError(
            f"face {int(odd[0])} has texture coordinate {int(flags[odd[0]])}; "
            "expected 1 (observed) or 2 (unobserved)",
            file=file,
            field="vt",
        )
    return CoverageMesh(points, triangles, flags == _OBSERVED)


def align(
    source: CoverageMesh, target: CoverageMesh, *, source_file: object = None, target_file: object = None
) -> Alignment:
    """The motion that carries one video's world onto another's, from their meshes' vertices.

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A 1976.

    Raises:
        SourceError: the meshes differ in their vertices, in number or in shape.
    """
    if len(source.vertices) != len(target.vertices):
        raise SourceError(
            f"{len(source.vertices)} vertices, but {len(target.vertices)} in {target_file}; expected the "
            "same model in both videos of a scene, to align them by it",
            file=source_file,
            field="v",
        )
    source_mean, target_mean = source.vertices.mean(axis=0), target.vertices.mean(axis=0)
    left, _, right = np.linalg.svd((target.vertices - target_mean).T @ (source.vertices - source_mean))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ flip @ right
    motion = compose(rotation, target_mean - rotation @ source_mean)
    distance = np.linalg.norm(source.vertices @ rotation.T + motion[:3, 3] - target.vertices, axis=1)
    residual = float(np.sqrt(np.mean(distance**2)))
    if residual > _LARGEST_RESIDUAL_MM:
        raise SourceError(
            f"after the best rigid motion its vertices are {residual:.3g} mm (rms) from those of "
            f"{target_file}; expected the same vertices in the same order, within "
            f"{_LARGEST_RESIDUAL_MM:g} mm",
            file=source_file,
            field="v",
        )
    return Alignment(motion, residual, float(distance.max()))


class Surface:
    """A coverage mesh as a target for rays.

    Args:
        mesh: in the world of the cameras asked about.
    """

    def __init__(self, mesh: CoverageMesh) -> None:
        self._rays = RayCaster(mesh.vertices, mesh.triangles)

    def cast(
        self, origin: Float[np.ndarray, "3"], rays: Float[np.ndarray, "*s 3"]
    ) -> tuple[Float[np.ndarray, "*s"], Int[np.ndarray, "*s"]]:
        """First hits: the distance in lengths of each ray, infinite for a miss, and the face."""
        hits = self._rays.cast(origin, rays)
        return hits.distance, hits.triangle

    def z_depth(self, camera: Cameras) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
        """z-depth at a pinhole's pixel centres, infinite for a miss, and the face."""
        return self.cast(camera.centers[0], pixel_rays(camera)[0])

    def observed(
        self,
        cameras: Cameras,
        mask: Bool[np.ndarray, "f h w"],
        train: Int[np.ndarray, "n_train"],
        test: Int[np.ndarray, "n_test"],
    ) -> Bool[np.ndarray, "f h w"]:
        """Which pixels of held-out frames show surface that a training frame saw, by exact visibility.

        Seen is what falls on a valid pixel of a training frame with nothing before it. Points and
        obstacles come from the same mesh, so that no depth has to be compared with another.

        Args:
            cameras: all frames.
            mask: valid pixels of all frames, [F, H, W].
            train: indices of training frames.
            test: indices of held-out frames.

        Returns:
            False in training frames, and where a pixel's ray meets no surface.
        """
        observed = empty_stack(mask.shape, bool)
        # Once: masks of a long recording are gigabytes.
        seeing, valid = cameras[train], frames_of(mask, train)
        for index in test:
            depth, _ = self.z_depth(cameras[int(index)])
            met = np.isfinite(depth)
            rays = pixel_rays(cameras[int(index)])[0][met]
            points = cameras.centers[index] + rays * depth[met][:, None].astype(np.float64)
            observed[index][met] = self._rays.seen_by(points, seeing, valid)
        return observed
