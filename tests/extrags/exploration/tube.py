"""A made-up colon for the tests of exploration: Gaussians on the inner wall of a bent tube."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from extrags.cameras import Cameras, look_at
from extrags.config import ExploreConfig, FreespaceConfig, SurfaceConfig
from extrags.freespace import FreeSpace, carve
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.surface import Mesh, fuse_surface

BEND_RADIUS_MM = 60.0
TUBE_RADIUS_MM = 20.0
ARC_RAD = 2.0
SEEN = {"visible_weight": 0.02, "n_directions": 32}
"""The settings of `ExploreConfig`, for calls that take them apart."""


@dataclass(frozen=True)
class Tube:
    """The scene, the recording that looks along it, and what is known about its shape."""

    scene: Scene
    sequence: EndoscopicSequence

    @property
    def cameras(self) -> Cameras:
        return self.sequence.cameras[self.sequence.train]

    @staticmethod
    def distance_from_wall(points: np.ndarray) -> np.ndarray:
        """Exact distance to the ideal wall, positive inside the lumen (ends are open)."""
        ring = np.hypot(points[..., 0], points[..., 1]) - BEND_RADIUS_MM
        return TUBE_RADIUS_MM - np.hypot(ring, points[..., 2])


def centre_line(arc: np.ndarray | float) -> np.ndarray:
    arc = np.asarray(arc)
    return np.stack([BEND_RADIUS_MM * np.cos(arc), BEND_RADIUS_MM * np.sin(arc), np.zeros_like(arc)], axis=-1)


def make_tube(
    *,
    n_gaussians: int = 3000,
    n_views: int = 10,
    width: int = 64,
    height: int = 48,
    field_of_view_deg: float = 90.0,
    light: bool = True,
    view_arc: tuple[float, float] = (0.25, 1.1),
    seed: int = 0,
) -> Tube:
    """A quarter bend of a tube, closed at the far end, with a camera path on its centre line."""
    rng = np.random.default_rng(seed)
    # A jittered lattice covers the wall evenly: random points would leave pinholes.
    around = round(np.sqrt(n_gaussians * TUBE_RADIUS_MM * 2 * np.pi / (BEND_RADIUS_MM * ARC_RAD)))
    along = n_gaussians // around
    arc, turn = np.meshgrid(
        (np.arange(along) + 0.5) / along * ARC_RAD, np.arange(around) / around * 2 * np.pi, indexing="ij"
    )
    arc = arc + rng.uniform(-0.3, 0.3, arc.shape) * ARC_RAD / along
    turn = turn + rng.uniform(-0.3, 0.3, arc.shape) * 2 * np.pi / around
    outward = np.stack([np.cos(arc), np.sin(arc), np.zeros_like(arc)], axis=-1)
    wall = (
        centre_line(arc)
        + TUBE_RADIUS_MM * np.cos(turn)[..., None] * outward
        + TUBE_RADIUS_MM * np.sin(turn)[..., None] * np.array([0.0, 0.0, 1.0])
    ).reshape(-1, 3)
    radius = np.sqrt(rng.uniform(0, 1, around * 6)) * TUBE_RADIUS_MM
    spin = rng.uniform(0, 2 * np.pi, around * 6)
    end_outward = np.array([np.cos(ARC_RAD), np.sin(ARC_RAD), 0.0])
    end = (
        centre_line(ARC_RAD)
        + (radius * np.cos(spin))[:, None] * end_outward
        + (radius * np.sin(spin))[:, None] * np.array([0.0, 0.0, 1.0])
    )
    points = np.concatenate([wall, end])
    rgb = np.clip(np.array([0.75, 0.4, 0.35]) + rng.normal(0, 0.05, (len(points), 3)), 0.05, 1)
    spacing = BEND_RADIUS_MM * ARC_RAD / along
    gaussians = Gaussians.from_points(points, rgb, np.full(len(points), 0.6 * spacing), opacity=0.95)
    # Steeper than what a display image shows, so that views near to the wall do white out.
    steep = NearFieldLight(torch.tensor(-3.0), torch.zeros(()), torch.zeros(n_views), 30.0)
    scene = Scene(gaussians, steep if light else None)

    arcs = np.linspace(*view_arc, n_views) if n_views > 1 else np.array([view_arc[0]])
    poses = np.stack([look_at(centre_line(a), centre_line(a + 0.4), np.array([0.0, 0.0, 1.0])) for a in arcs])
    focal = 0.5 * width / np.tan(np.radians(field_of_view_deg) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Tube(scene, _sequence(poses, K, width, height))


def make_ball(n_views: int = 80) -> Tube:
    """The inside of a ball, seen from everywhere in all directions: nothing is left to explore."""
    rng = np.random.default_rng(0)
    n, radius = 3000, 30.0
    # A Fibonacci lattice: even, and closed.
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    points = radius * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    scene = scene_of_points(points, radius=1.0)
    poses = []
    for _ in range(n_views):
        center = rng.normal(size=3)
        center *= 18 * rng.uniform(0.5, 1) / np.linalg.norm(center)
        poses.append(look_at(center, center + rng.normal(size=3), rng.normal(size=3)))
    K = np.array([[20.0, 0, 24], [0, 20.0, 20], [0, 0, 1]])
    return Tube(scene, _sequence(np.stack(poses), K, 48, 40))


def _sequence(poses: np.ndarray, K: np.ndarray, width: int, height: int) -> EndoscopicSequence:
    n = len(poses)
    return EndoscopicSequence(
        name="tube",
        rgb=np.zeros((n, height, width, 3), np.uint8),
        K=np.broadcast_to(K, (n, 3, 3)).copy(),
        mask=np.ones((n, height, width), bool),
        split=Split("all", np.arange(n), np.zeros(0, np.int64)),
        world_from_camera=poses,
    )


def scene_of_points(points: np.ndarray, radius: float = 0.5) -> Scene:
    """Grey Gaussians at points, without light."""
    grey = np.full(points.shape, 0.5)
    return Scene(Gaussians.from_points(points, grey, np.full(len(points), radius), opacity=0.95))


def square_camera(pose: np.ndarray | None = None) -> Cameras:
    """32 x 32 pixels, 90 degrees wide, at the origin unless told otherwise."""
    K = np.array([[[16.0, 0, 16], [0, 16.0, 16], [0, 0, 1]]])
    return Cameras(K, (np.eye(4) if pose is None else pose)[None], 32, 32)


@cache
def small_tube() -> Tube:
    """The tube most tests look at."""
    return make_tube(n_gaussians=1500, n_views=8, width=48, height=36)


@cache
def small_mesh() -> Mesh:
    tube = small_tube()
    return fuse_surface(tube.scene, tube.cameras, SurfaceConfig(voxel_share=1 / 32))


@cache
def small_freespace() -> FreeSpace:
    tube = small_tube()
    return carve(tube.scene, small_mesh(), tube.cameras, FreespaceConfig(grid_size=32, render_width=48))


def small_config(**changes: object) -> ExploreConfig:
    """Small budgets, and the score by pairs with the paper's two weights unless told otherwise."""
    settings = {
        "score": "pairs",
        "trajectories": 4,
        "length": 5,
        "render_width": 32,
        "max_expansions": 12,
        "wave": 3,
        "wave_kept_share": 0.0,
        "probe_views": 64,
        "darkness_weight": 0.5,
        "fold_penalty": 0.6,
    }
    return ExploreConfig.model_validate(settings | changes)
