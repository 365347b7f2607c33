"""Free space against the truth: `python -m tests.benchmarks.bench_freespace [--what cost colon phantom ...]`.

`colon`: stretches of a real colon from CT, whose wall is closed: every voxel is known to lie inside or
outside. `sequences`: catalogue sequences with Gaussians put on their true surface. `withheld`: a sequence
whose depth is withheld and estimated, reconstructed. `cost`: time and memory against grid size, Gaussians
and training views. The truth of a voxel is that its centre lies inside the wall and in front of it in a
training view.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from data_catalog import read
from data_catalog.ray_casting import RayCaster
from data_catalog.true_surface import true_surface
from extrags.cameras import Cameras, pixel_rays
from extrags.config import ExploreConfig, FreespaceConfig
from extrags.data_directories import data_roots
from extrags.exploration import explore
from extrags.freespace import FREE, FreeSpace, carve
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh, fuse_surface
from extrags.surface_error import surface_error_mm
from tests.colon_ct import ColonCT, seen_scene

STRETCHES_MM = ((20.0, 60.0), (300.0, 340.0), (620.0, 680.0), (900.0, 930.0), (1200.0, 1250.0))
TRUTH_WIDTH = 320
POSES = ExploreConfig(trajectories=6, length=8, max_expansions=24)


class Truth:
    """The true wall: what lies inside, how far, and what views see of it."""

    def __init__(self, wall: Mesh) -> None:
        import open3d as o3d

        triangles = o3d.utility.Vector3iVector(wall.triangles)
        points = o3d.utility.Vector3dVector(wall.vertices.astype(np.float64))
        self.closed = o3d.geometry.TriangleMesh(points, triangles).is_edge_manifold(
            allow_boundary_edges=False
        )
        self.caster = RayCaster(wall.vertices, wall.triangles)
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(wall.vertices.astype(np.float32)), self._tensor(wall.triangles.astype(np.uint32))
        )

    def inside_mm(self, points: np.ndarray) -> np.ndarray:
        """Distance from the wall, negative outside of a closed one."""
        tensor = self._tensor(points.astype(np.float32))
        if not self.closed:
            return np.asarray(self._scene.compute_distance(tensor).numpy())
        return -np.asarray(self._scene.compute_signed_distance(tensor).numpy())

    def seen(self, points: np.ndarray, cameras: Cameras) -> np.ndarray:
        """Whether a point lies in front of the wall in some view."""
        cameras = cameras.resized(TRUTH_WIDTH, round(cameras.height * TRUTH_WIDTH / cameras.width))
        seen = np.zeros(len(points), dtype=bool)
        for index in range(len(cameras)):
            camera = cameras[index]
            (pixels,), (z,) = camera.project(points)
            inside = camera.contains(pixels) & ~seen
            column, row = pixels[inside].astype(np.int64).T
            depth = self.caster.cast(camera.centers[0], pixel_rays(camera)[0]).distance
            hit = depth[row, column]
            seen[np.flatnonzero(inside)[(z[inside] < hit) & np.isfinite(hit)]] = True
        return seen


def measured(
    space: FreeSpace, truth: Truth, cameras: Cameras, everyone: Cameras | None = None
) -> dict[str, Any]:
    """Agreement of the free voxels with the truth."""
    centers = space.voxel_centers()
    free = space.occupancy.ravel() == FREE
    inside_mm = truth.inside_mm(centers)
    true = truth.seen(centers, cameras)
    if truth.closed:
        true &= inside_mm > 0
        outside = free & (inside_mm <= 0)
        deepest = float(-inside_mm[outside].min()) if outside.any() else 0.0
    else:
        # An open wall has no inside: what no view of the whole recording sees in front of it is told.
        known = true if everyone is None else truth.seen(centers, everyone)
        outside = free & ~known
        deepest = float(inside_mm[outside].max()) if outside.any() else 0.0
    # A voxel that the wall passes through is occupied whichever side its centre is on.
    clear = true & (inside_mm > 0.87 * space.voxel_mm)
    over = space.clearance.ravel()[free] - np.maximum(inside_mm[free], 0)
    return {
        "voxel_mm": round(space.voxel_mm, 3),
        "free": int(free.sum()),
        "iou": round(float((free & true).sum() / max(1, (free | true).sum())), 4),
        "recall": round(float((free & true).sum() / max(1, true.sum())), 4),
        "recall_off_the_wall": round(float((free & clear).sum() / max(1, clear.sum())), 4),
        ("outside" if truth.closed else "seen_by_none"): int(outside.sum()),
        ("deepest_outside_mm" if truth.closed else "farthest_from_the_wall_mm"): round(deepest, 3),
        "clearance_over_mm": round(float(over.max()), 3) if free.any() else None,
    }


def poses_measured(
    space: FreeSpace, truth: Truth, scene: Scene, sequence: EndoscopicSequence, config: ExploreConfig
) -> dict[str, Any]:
    """Poses of an exploration from there: how many lie outside, or nearer to the wall than said."""
    found = explore(scene, sequence, config, freespace=space)
    # The first view of each trajectory is a real one.
    virtual = np.concatenate([np.zeros(1, bool), found.trajectory[1:] == found.trajectory[:-1]])[
        : len(found.trajectory)
    ]
    centers = found.cameras.centers[virtual]
    if not len(centers):
        return {"poses": 0}
    true = truth.inside_mm(centers)
    said = space.clearance_at(centers)
    return {
        "poses": len(centers),
        "gain": int(found.gains.sum()),
        "value": round(float(found.values.sum())),
        "poses_outside": int((true <= 0).sum()),
        "poses_nearer_than_said": int((true < said - 1e-3).sum()),
        "worst_mm": round(float((said - true).max()), 3),
        "least_clearance_mm": round(float(true.min()), 3),
    }


def peak_mib() -> float:
    """Peak memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def cost(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Seconds of one carving, the mesh given."""
    colon = ColonCT.read(data_roots()[0])
    rows = []
    for n in options.gaussians:
        for views in options.views:
            scene, sequence = colon.stretch(620.0, 680.0, views=views, n_gaussians=n)
            mesh = fuse_surface(scene, sequence.training_cameras[:: max(1, views // 40)])
            for size in options.sizes:
                before, begun = peak_mib(), time.perf_counter()
                space = carve(scene, mesh, sequence.training_cameras, FreespaceConfig(grid_size=size))
                seconds = time.perf_counter() - begun
                rows.append(
                    {
                        "gaussians": n,
                        "views": views,
                        "size": size,
                        "seconds": round(seconds, 2),
                        "peak_mib": round(peak_mib()),
                        "grew_mib": round(peak_mib() - before),
                        "free_share": round(space.free_share, 5),
                    }
                )
                print(rows[-1], flush=True)
    return rows


def colon(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Stretches of the CT colon."""
    ct = ColonCT.read(data_roots()[0], triangles="100k")
    truth = Truth(ct.wall)
    rows = []
    for begin, end in STRETCHES_MM[: options.stretches]:
        scene, sequence = ct.stretch(begin, end, n_gaussians=options.gaussians[0], noise_mm=options.noise_mm)
        rows += _carved(f"colon_ct {begin:.0f}-{end:.0f} mm", scene, sequence, truth, options)
    return rows


def sequences(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Catalogue sequences, with Gaussians on the true surface."""
    rows = []
    for name in options.sequences:
        sequence = read(name)
        surface = true_surface(sequence)
        assert surface is not None
        truth = Truth(surface.mesh)
        scene = seen_scene(
            surface.mesh, sequence.training_cameras, options.gaussians[0], noise_mm=options.noise_mm
        )
        rows += _carved(name, scene, sequence, truth, options)
    return rows


def withheld(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Reconstructed without measured depth; clearance knows the depth's uncertainty."""
    from extrags.config import PROFILES
    from extrags.depth.training_depth import with_training_depth
    from extrags.in_memory_pipeline import run_pipeline

    rows = []
    for name in options.sequences:
        sequence = read(name)
        surface = true_surface(sequence)
        assert surface is not None
        result = run_pipeline(sequence.without_training_depth(), PROFILES["quick"], until="surface")
        assert result.depth is not None
        estimated = with_training_depth(result.sequence.training_part(), result.depth)
        rows += _carved(f"{name}, depth withheld", result.coarse, estimated, Truth(surface.mesh), options)
    return rows


def _carved(
    name: str, scene: Scene, sequence: EndoscopicSequence, truth: Truth, options: argparse.Namespace
) -> list[dict[str, Any]]:
    cameras = sequence.training_cameras
    mesh = fuse_surface(scene, cameras)
    rows = []
    for size in options.sizes:
        begun = time.perf_counter()
        error_mm = surface_error_mm(mesh, sequence)
        space = carve(scene, mesh, cameras, FreespaceConfig(grid_size=size), surface_error_mm=error_mm)
        row: dict[str, Any] = {"name": name, "size": size, "seconds": round(time.perf_counter() - begun, 2)}
        if error_mm is not None:
            row["surface_error_mm"] = round(float(np.median(error_mm)), 3)
        row |= measured(space, truth, cameras, sequence.cameras)
        if options.poses:
            row |= poses_measured(space, truth, scene, sequence, POSES)
        print(row, flush=True)
        rows.append(row)
    return rows


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--what", nargs="+", default=["cost", "colon"], choices=list(JOBS))
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 128])
    parser.add_argument("--gaussians", nargs="+", type=int, default=[10_000])
    parser.add_argument("--views", nargs="+", type=int, default=[40])
    parser.add_argument("--stretches", type=int, default=len(STRETCHES_MM))
    parser.add_argument("--noise-mm", type=float, default=0.0)
    parser.add_argument("--sequences", nargs="+", default=["phantom/11@sparse"])
    parser.add_argument("--poses", action="store_true", help="explore from each free space, too")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = {job: JOBS[job](options) for job in options.what}
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1))


JOBS = {"cost": cost, "colon": colon, "sequences": sequences, "withheld": withheld}


if __name__ == "__main__":
    main()
