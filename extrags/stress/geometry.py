"""Rows of the geometry: fusion of depth, carving of free space, lenses, poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from extrags.cameras import Cameras, compose, invert_poses
from extrags.config import FreespaceConfig, SurfaceConfig
from extrags.freespace.carving import carve
from extrags.freespace.grid import FreeSpace
from extrags.lens import LENS_PARAMETERS, Lens, Undistortion, sample_depth
from extrags.metrics.pose import absolute_trajectory_error, relative_pose_error, umeyama
from extrags.poses.scale import depth_scale
from extrags.scene import Scene
from extrags.stress.inputs import FARTHEST_OFFSET_MM, SCALES, TURN, UPRIGHT, plane_views
from extrags.stress.rows import (
    EPS,
    EXACT,
    FINITE,
    Effort,
    Row,
    Trial,
    differs,
    finite_or_refused,
    only_refused,
    with_threads,
)
from extrags.stress.tube import tube
from extrags.surface import Mesh, fuse_depth

__all__ = ["ROWS"]

SURFACE = SurfaceConfig(min_cluster_triangles=1)
CARVING = FreespaceConfig(grid_size=24, render_width=48)


def _off_plane(unit: float, offset_mm: float, turn: np.ndarray = UPRIGHT) -> float:
    """Largest distance of the mesh from the plane that was seen, in half pixels and voxels."""
    cameras, depth, normal, point = plane_views(4, 48, 40, unit=unit, offset_mm=offset_mm, turn=turn)
    mesh = fuse_depth(cameras, depth, SURFACE)
    distance = np.abs((mesh.vertices.astype(np.float64) - point) @ normal)
    voxel = float(np.quantile(depth, 0.95)) * SURFACE.voxel_share
    # Vertices are float32: far from the origin they have no more digits.
    return float(distance.max()) / (_half_pixel(depth) + 0.1 * voxel + 4 * EPS * (abs(offset_mm) + 3 * unit))


def _half_pixel(depth: np.ndarray) -> float:
    """How much depth changes over half a pixel: fusion takes it from the nearest pixel."""
    return 0.5 * sum(float(np.abs(np.diff(depth, axis=axis)).max()) for axis in (1, 2))


def _fused_scales(effort: Effort) -> Iterator[Trial]:
    for unit in SCALES:
        yield f"times {unit:g}", _off_plane(unit, 0.0)
    for unit in (1.0, 50.0):
        for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
            yield f"times {unit:g}, {offset:g} from the origin", _off_plane(unit, offset)
    for unit in SCALES:
        yield f"times {unit:g}, turned", _off_plane(unit, 0.0, TURN)


def _spoilt_depth(effort: Effort) -> Iterator[Trial]:
    cameras, depth, _, _ = plane_views(4, 32, 24)
    generator = np.random.default_rng(0)
    step = np.where(np.arange(32) < 16, 1.0, 1e3).astype(np.float32)
    spoilt = {
        "all zero": np.zeros_like(depth),
        "one pixel": np.where(np.arange(depth.size).reshape(depth.shape) == 5, depth, 0),
        "half zero": np.where(generator.random(depth.shape) < 0.5, depth, 0),
        "outliers": np.where(generator.random(depth.shape) < 0.01, 1e6, depth),
        "tiny outliers": np.where(generator.random(depth.shape) < 0.01, 1e-6, depth),
        "a step": np.broadcast_to(step, depth.shape),
        "constant": np.full_like(depth, 2.0),
        "noise": generator.uniform(1e-3, 10, depth.shape),
        "one view of four": np.where(np.arange(4)[:, None, None] == 0, depth, 0),
    }
    for name, values in spoilt.items():
        given = np.ascontiguousarray(values, dtype=np.float32)
        yield name, finite_or_refused(partial(fuse_depth, cameras, given, SURFACE))
    for name, value in (("NaN", math.nan), ("infinity", math.inf), ("negative", -1.0)):
        given = depth.copy()
        given[0, 0, 0] = value
        yield name, finite_or_refused(partial(fuse_depth, cameras, given, SURFACE))
    for width, height in ((1, 1), (1, 8), (8, 1), (2, 2)):
        small, seen, _, _ = plane_views(2, width, height)
        yield f"{width}x{height} pixels", finite_or_refused(partial(fuse_depth, small, seen, SURFACE))


def _frames(effort: Effort) -> Iterator[Trial]:
    for count in (1, 2, 10, 100, 1000):
        cameras, depth, normal, point = plane_views(count, 24, 20)
        mesh = fuse_depth(cameras, depth, SURFACE)
        distance = np.abs((mesh.vertices.astype(np.float64) - point) @ normal)
        voxel = float(np.quantile(depth, 0.95)) * SURFACE.voxel_share
        yield f"{count} frames", float(distance.max()) / (_half_pixel(depth) + 0.1 * voxel)


def _fused_repeat(effort: Effort) -> Iterator[Trial]:
    cameras, depth, _, _ = plane_views(6, 48, 40)

    def run() -> Mesh:
        return fuse_depth(cameras, depth, SURFACE)

    first = with_threads(1, run)
    for threads in (1, 2, 4):
        yield f"{threads} threads", differs(with_threads(threads, run), first)


def _carved(unit: float, offset_mm: float, turn: np.ndarray) -> FreeSpace:
    room = tube(unit=unit, offset_mm=offset_mm, turn=turn)
    return carve(room.scene, room.mesh, room.cameras, CARVING)


def _carving_invariance(effort: Effort) -> Iterator[Trial]:
    """Free volume in the cube of the unit; where the grid's axes turn, its voxels cut the wall elsewhere."""
    here = _carved(1.0, 0.0, UPRIGHT)
    volume = here.free_share * (here.grid_size * here.voxel_mm) ** 3
    turns = {"": UPRIGHT, ", turned": TURN}
    for name, turn in turns.items():
        for unit in SCALES:
            found = _carved(unit, 0.0, turn)
            yield (
                f"times {unit:g}{name}",
                abs(found.free_share * (found.grid_size * found.voxel_mm / unit) ** 3 / volume - 1),
            )
        for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
            unit = 20.0
            found = _carved(unit, offset, turn)
            share = found.free_share * (found.grid_size * found.voxel_mm / unit) ** 3 / volume
            yield f"times 20, {offset:g} from the origin{name}", abs(share - 1)


def _carving_extremes(effort: Effort) -> Iterator[Trial]:
    room = tube()
    scene, mesh, cameras = room.scene, room.mesh, room.cameras
    yield "one view", finite_or_refused(partial(carve, scene, mesh, cameras[0], CARVING))
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    yield "no surface", finite_or_refused(partial(carve, scene, empty, cameras, CARVING))
    nothing = Scene(scene.gaussians.subset(torch.zeros(len(scene.gaussians), dtype=torch.bool)))
    yield "no Gaussians", finite_or_refused(partial(carve, nothing, mesh, cameras, CARVING))
    flat = Mesh(mesh.vertices * np.array([1, 1, 0], np.float32), mesh.triangles)
    yield "a flat surface", finite_or_refused(partial(carve, scene, flat, cameras, CARVING))
    point = Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    yield "a surface that is a point", finite_or_refused(partial(carve, scene, point, cameras, CARVING))
    same = Cameras(cameras.K, np.repeat(cameras.world_from_camera[:1], 6, axis=0), 48, 40)
    yield "six views of one place", finite_or_refused(partial(carve, scene, mesh, same, CARVING))
    away = Cameras(cameras.K, cameras.world_from_camera @ np.diag([1.0, -1, -1, 1]), 48, 40)
    yield "views out of the tube", finite_or_refused(partial(carve, scene, mesh, away, CARVING))
    one = Cameras(np.array([[[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]]] * 6), cameras.world_from_camera, 1, 1)
    yield "images of one pixel", finite_or_refused(partial(carve, scene, mesh, one, CARVING))


def _carving_repeat(effort: Effort) -> Iterator[Trial]:
    run = partial(_carved, 1.0, 0.0, UPRIGHT)
    first = with_threads(1, run)
    for threads in (1, 2, 4):
        found = with_threads(threads, run)
        yield (
            f"{threads} threads",
            differs([found.occupancy, found.clearance], [first.occupancy, first.clearance]),
        )


def _poses(count: int, seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    turns = Rotation.random(count, random_state=seed).as_matrix()
    return np.stack(
        [compose(turn, center) for turn, center in zip(turns, generator.normal(size=(count, 3)), strict=True)]
    )


def _moved(poses: np.ndarray, scale: float, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    found = poses.copy()
    found[:, :3, :3] = turn @ poses[:, :3, :3]
    found[:, :3, 3] = scale * poses[:, :3, 3] @ turn.T + shift
    return found


def _trajectories(effort: Effort) -> Iterator[Trial]:
    """Errors of a trajectory that differs from the truth by a similarity alone; they should be rounding."""
    for seed in range(min(effort.scenes, 50)):
        truth = _poses(20, seed)
        turn = Rotation.random(random_state=seed + 1).as_matrix()
        for scale in SCALES:
            for offset in (0.0, FARTHEST_OFFSET_MM):
                found = _moved(truth, scale, turn, np.full(3, offset))
                errors = absolute_trajectory_error(found, truth)
                # Coordinates are rounded to the offset, which the alignment brings back to the unit.
                allowed = 64 * np.finfo(np.float64).eps * (1 + offset / scale)
                place = f"seed {seed}, times {scale:g}, {offset:g} from the origin"
                yield place, errors.rmse / allowed
                yield place, math.radians(errors.rotation_mean_deg) / (1e-7 + allowed)


def _degenerate_trajectories(effort: Effort) -> Iterator[Trial]:
    line = _poses(10, 0)
    line[:, :3, 3] = np.arange(10)[:, None] * np.array([1.0, 2.0, 3.0])
    still = _poses(10, 1)
    still[:, :3, 3] = 5.0
    nearly = line.copy()
    nearly[:, :3, 3] += 1e-12 * np.random.default_rng(0).normal(size=(10, 3))
    tiny = _poses(10, 2)
    tiny[:, :3, 3] *= 1e-100
    huge = _poses(10, 2)
    huge[:, :3, 3] *= 1e100
    repeated = np.repeat(_poses(1, 3), 10, axis=0)
    given = {
        "on a line": line,
        "standing still": still,
        "nearly on a line": nearly,
        "1e-100 wide": tiny,
        "1e100 wide": huge,
        "one pose": repeated,
    }
    for name, poses in given.items():
        for other_name, other in given.items():
            place = f"{name} against {other_name}"
            yield place, finite_or_refused(partial(absolute_trajectory_error, poses, other))
            yield place, finite_or_refused(partial(relative_pose_error, poses, other))
    for count in (0, 1, 2):
        yield (
            f"{count} poses",
            finite_or_refused(partial(absolute_trajectory_error, line[:count], line[:count])),
        )
    for value in (math.nan, math.inf):
        spoilt = line.copy()
        spoilt[3, 0, 3] = value
        yield f"{value}", only_refused(partial(absolute_trajectory_error, spoilt, line))
        yield f"points with {value}", only_refused(partial(umeyama, spoilt[:, :3, 3], line[:, :3, 3]))


def _inverted(effort: Effort) -> Iterator[Trial]:
    for seed in range(min(effort.scenes, 50)):
        for offset in (1.0, FARTHEST_OFFSET_MM):
            poses = _poses(10, seed)
            poses[:, :3, 3] *= offset
            identity = invert_poses(poses) @ poses - np.eye(4)
            yield (
                f"seed {seed}, {offset:g}",
                float(np.abs(identity).max()) / (32 * np.finfo(np.float64).eps * max(offset, 1)),
            )


def _observations(unit: float, outliers: float, seed: int) -> dict[str, Any]:
    generator = np.random.default_rng(seed)
    cameras, depth, _, _ = plane_views(3, 32, 24)
    frame, row, column = (
        generator.integers(3, size=90),
        generator.integers(24, size=90),
        generator.integers(32, size=90),
    )
    seen = depth[frame, row, column].astype(np.float64)
    K = cameras.K[0]
    local = (
        np.stack([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], np.ones(90)], 1)
        * seen[:, None]
    )
    pose = cameras.world_from_camera[frame]
    points = np.einsum("oij,oj->oi", pose[:, :3, :3], local) + pose[:, :3, 3]
    points = np.where(generator.random((90, 1)) < outliers, 1e6 * generator.normal(size=(90, 3)), points)
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] *= unit
    return {
        "world_from_camera": poses,
        "points": points * unit,
        "observed_frame": frame,
        "observed_point": np.arange(90),
        "observed_px": np.stack([column + 0.5, row + 0.5], 1),
        "depth_mm": depth,
        "mask": np.ones(depth.shape, dtype=bool),
    }


def _scale_of_poses(effort: Effort) -> Iterator[Trial]:
    for unit in SCALES:
        for outliers in (0.0, 0.3):
            found = depth_scale(**_observations(unit, outliers, 0))
            error = math.inf if found is None else abs(found.mm_per_unit * unit - 1)
            yield f"unit {unit:g}, {outliers:.0%} outliers", error
    spoilt = _observations(1.0, 0.0, 0)
    for name, values in {"no depth": 0.0, "NaN": math.nan, "infinity": math.inf}.items():
        given = {**spoilt, "depth_mm": np.full_like(spoilt["depth_mm"], values)}
        yield name, 0.0 if depth_scale(**given) is None else math.inf


def _lenses(effort: Effort) -> Iterator[Trial]:
    """What a planned undistortion says is valid must lie inside the image and be finite."""
    generator = np.random.default_rng(0)
    for model, names in LENS_PARAMETERS.items():
        for strength in (0.0, 1e-12, 0.1, 1.0, 10.0, 1e4):
            for focal in (0.01, 1.0, 40.0, 1e6):
                parameters = [
                    focal
                    if name.startswith("f")
                    else {"cx": 24.0, "cy": 20.0}.get(name, strength * generator.normal())
                    for name in names
                ]

                def planned(model: str = model, parameters: list[float] = parameters) -> list[np.ndarray]:
                    lens = Lens(model, tuple(map(float, parameters)), 48, 40)
                    plan = Undistortion.planned(lens)
                    depth = plan.depth(np.full((40, 48), 2.0, np.float32))
                    inside = np.where(plan.valid, plan.u, 1.0), np.where(plan.valid, plan.v, 1.0)
                    return [plan.K, depth, *inside]

                yield (
                    f"{model}, focal length {focal:g} px, distortion {strength:g}",
                    finite_or_refused(planned),
                )


def _depth_samples(effort: Effort) -> Iterator[Trial]:
    for size in ((1, 1), (1, 5), (5, 1), (4, 4)):
        for name, value in {"zero": 0.0, "tiny": 1e-30, "large": 1e30, "one": 1.0}.items():
            depth = np.full(size, value, np.float32)
            where = np.array([-1e9, -1.0, 0.0, 0.5, 2.3, 1e9])
            found = sample_depth(depth, where, where)
            good = np.allclose(found, value, rtol=1e-6, atol=0)
            yield f"{name}, {size[0]}x{size[1]}", 0.0 if good else math.inf


def _rows() -> Iterator[Row]:
    planar = "distance from the plane seen, over half a pixel and a tenth of a voxel"
    yield Row("TSDF", "scale 1e-3 to 1e4, offset to 1e5, rotation", planar, 1.0, _fused_scales)
    yield Row("TSDF", "1 to 1000 frames", planar, 1.0, _frames)
    yield Row("TSDF", "depth with zeros, outliers, steps", "meshes not finite", FINITE, _spoilt_depth)
    yield Row("TSDF", "repeat and threads", "results that differ", EXACT, _fused_repeat)
    yield Row(
        "carving",
        "scale, offset, rotation",
        "relative difference of the free volume",
        0.25,
        _carving_invariance,
    )
    yield Row("carving", "extreme views and surfaces", "grids not finite", FINITE, _carving_extremes)
    yield Row("carving", "repeat and threads", "results that differ", EXACT, _carving_repeat)
    yield Row("poses", "similar trajectories", "error over that of rounding", 1.0, _trajectories)
    yield Row("poses", "repeated, still, on a line", "errors not finite", FINITE, _degenerate_trajectories)
    yield Row("poses", "inverse", "error over that of rounding", 1.0, _inverted)
    yield Row("poses", "unit from depth", "relative error of the unit", 1e-5, _scale_of_poses)
    yield Row("lens", "all models, extreme distortion", "coordinates not finite", FINITE, _lenses)
    yield Row("lens", "depth at borders", "depth not that of a constant map", FINITE, _depth_samples)


ROWS = tuple(_rows())
