"""A real colon from CT, its wall closed and its centre line known, as a scene with training cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_catalog.ct_colon.model import FOLDER, ColonModel
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, look_at
from extrags.gaussians import Gaussians
from extrags.metrics.surface import sample_surface
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.surface import Mesh

FIELD_OF_VIEW_DEG = 100.0
LOOK_AHEAD_MM = 12.0


@dataclass(frozen=True)
class ColonCT:
    """The wall, watertight, and points on the centre line about one millimetre apart."""

    wall: Mesh
    centre_line_mm: np.ndarray

    @classmethod
    def read(cls, data: Path, *, triangles: str = "20k") -> ColonCT:
        """Read the surface of 20k or 100k triangles from the folder of shared data."""
        model = ColonModel.read(data / FOLDER, triangles)
        return cls(Mesh(model.vertices, model.triangles.astype(np.int32)), model.centre_line_mm)

    def stretch(
        self,
        from_mm: float,
        to_mm: float,
        *,
        views: int = 30,
        n_gaussians: int = 10_000,
        width: int = 160,
        height: int = 128,
        noise_mm: float = 0.0,
        seed: int = 0,
    ) -> tuple[Scene, EndoscopicSequence]:
        """Gaussians on the wall that cameras along a stretch of the centre line see, and these cameras.

        Args:
            from_mm: where the stretch begins, along the centre line.
            to_mm: where it ends.
            views: training cameras; they look ahead, as an endoscope does.
            n_gaussians: on all of the seen wall together.
            width: of the images in pixels.
            height: of the images in pixels.
            noise_mm: standard deviation of the Gaussians' distance from the wall.
            seed: of the samples on the wall.
        """
        line = ColonModel(self.wall.vertices, self.wall.triangles, self.centre_line_mm)
        poses = np.stack(
            [
                look_at(line.at(np.asarray(s)), line.at(np.asarray(s + LOOK_AHEAD_MM)), np.array([0.0, 0, 1]))
                for s in np.linspace(from_mm, to_mm, views)
            ]
        )
        focal = 0.5 * width / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        sequence = sequence_of(poses, K, width, height)
        return seen_scene(self.wall, sequence.cameras, n_gaussians, noise_mm=noise_mm, seed=seed), sequence


def sequence_of(poses: np.ndarray, K: np.ndarray, width: int, height: int) -> EndoscopicSequence:
    """Frames without content, all of them training frames."""
    n = len(poses)
    return EndoscopicSequence(
        name="colon_ct",
        rgb=np.zeros((n, height, width, 3), np.uint8),
        K=np.broadcast_to(K, (n, 3, 3)).copy(),
        mask=np.ones((n, height, width), bool),
        split=Split("all", np.arange(n), np.zeros(0, np.int64)),
        world_from_camera=poses,
    )


def seen_scene(
    wall: Mesh, cameras: Cameras, n_gaussians: int, *, noise_mm: float = 0.0, seed: int = 0
) -> Scene:
    """Opaque Gaussians on the part of a wall that cameras see."""
    caster = RayCaster(wall.vertices, wall.triangles)
    rng = np.random.default_rng(seed)
    corners = wall.vertices[wall.triangles].astype(np.float64)
    # The whole colon is metres of wall: only what is near to seen triangles is sampled.
    part = Mesh(
        wall.vertices, wall.triangles[_grown(wall.triangles, caster.seen_by(corners.mean(axis=1), cameras))]
    )
    samples = sample_surface(part, 4 * n_gaussians, seed=seed)
    seen = samples[caster.seen_by(samples, cameras)]
    edges = part.vertices[part.triangles[:, 1:]] - part.vertices[part.triangles[:, :1]]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() * len(seen) / len(samples)
    points = rng.permutation(seen)[:n_gaussians]
    spacing = np.sqrt(area / len(points))
    points = points + rng.normal(size=points.shape) * noise_mm
    rgb = np.clip(np.array([0.75, 0.4, 0.35]) + rng.normal(0, 0.05, points.shape), 0.05, 1)
    return Scene(Gaussians.from_points(points, rgb, np.full(len(points), 0.8 * spacing), opacity=0.95))


def _grown(triangles: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The chosen triangles and all that share a vertex with one of them, twice over."""
    for _ in range(2):
        touched = np.zeros(int(triangles.max()) + 1, dtype=bool)
        touched[triangles[chosen].ravel()] = True
        chosen = touched[triangles].any(axis=1)
    return chosen
