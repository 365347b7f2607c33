"""Rows of recordings whose poses are off, repeated or nearly parallel, or whose exposure is extreme."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from extrags.cameras import Cameras, pixel_rays
from extrags.config import EnhanceConfig, FreespaceConfig, SurfaceConfig
from extrags.depth.estimate import posed_frames
from extrags.depth.stereo import StereoSettings, multi_view_stereo
from extrags.evaluation import render
from extrags.freespace import FREE, carve
from extrags.restoration.backends import train_enhancer
from extrags.restoration.clips import render_clips
from extrags.sequence import EndoscopicSequence, saturated_mask
from extrags.stress.inputs import (
    GAINS,
    PLANE_UNIT_MM,
    depth_of_plane,
    painted,
    plane_recording,
    plane_views,
)
from extrags.stress.rows import (
    EPS,
    FINITE,
    Effort,
    Row,
    Trial,
    all_finite,
    finite_or_refused,
    only_refused,
)
from extrags.stress.training import CONFIG, LEVELS, quality
from extrags.stress.tube import tube
from extrags.surface import fuse_depth
from extrags.training import reconstruct
from extrags.view_synthesis.gather import gather_references

__all__ = ["ROWS", "displaced", "faulty_poses"]

ERRORS = (1e-6, 1e-4, 1e-3, 1e-2, 0.1)
"""By how much poses are off: radians about any axis, and units of length in any direction."""
FINE = 0.2
"""How coarse the painting is that stereo matches: its windows want something to see."""
STEREO = StereoSettings(hypotheses=24, refinement_hypotheses=5)
SURFACE = SurfaceConfig(min_cluster_triangles=1)
CARVING = FreespaceConfig(grid_size=24, render_width=48)


def displaced(poses: np.ndarray, error: float, unit: float, seed: int = 0) -> np.ndarray:
    """Poses that are off by an angle in radians, and by as many units of length.

    Args:
        poses: true ones, [F, 4, 4].
        error: of each pose, exactly; its axis and direction are random.
        unit: of length.
        seed: of these.
    """
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(2, len(poses), 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    found = poses.copy()
    found[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(error * directions[0]).as_matrix()
    found[:, :3, 3] += error * unit * directions[1]
    return found


def faulty_poses(poses: np.ndarray, unit: float) -> dict[str, np.ndarray]:
    """Poses that no recording has, by what is wrong with them.

    Args:
        poses: true ones, [F, 4, 4].
        unit: of length.
    """
    same = np.repeat(poses[:1], len(poses), axis=0)
    parallel = same.copy()
    # Along the optical axis, where frames tell least of depth.
    parallel[:, :3, 3] += 1e-3 * unit * np.arange(len(poses))[:, None] * poses[0, :3, 2]
    away = poses.copy()
    away[:, :3, 3] += 1e3 * unit
    back = poses.copy()
    back[1::2] = back[1::2] @ np.diag([1.0, -1.0, -1.0, 1.0])
    rolled = poses.copy()
    rolled[1::2] = rolled[1::2] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "one pose for all": same,
        "poses a rounding apart": displaced(same, EPS, unit),
        "nearly parallel": parallel,
        "every second repeated": np.repeat(poses[::2], 2, axis=0)[: len(poses)],
        "in the wrong order": np.roll(poses, 1, axis=0),
        "back to back": back,
        "every second upside down": rolled,
        "far off": away,
        "one far off": np.concatenate([away[:1], poses[1:]]),
    }


def _misfit(sequence: EndoscopicSequence, shown: Cameras) -> float:
    """Root mean square difference of the frames and the painting as other cameras see it, in levels."""
    _, _, normal, point = plane_views(1, 1, 1, unit=PLANE_UNIT_MM)
    seen = painted(shown, depth_of_plane(shown, normal, point), point, unit=PLANE_UNIT_MM)
    return LEVELS * float(np.sqrt(np.square(seen - sequence.rgb[: len(shown)] / LEVELS).mean()))


def _poses_off(effort: Effort) -> Iterator[Trial]:
    """Error of the training views over what they would have if the scene were exact, and the poses off."""
    true = plane_recording(6)
    base = quality(true)
    for error in ERRORS:
        said = displaced(true.cameras.world_from_camera, error, PLANE_UNIT_MM)
        wrong = replace(true, world_from_camera=said)
        allowed = math.hypot(base, _misfit(true, wrong.cameras[:4])) + 1
        yield f"off by {error:g}", quality(wrong) / allowed


def _faulty(effort: Effort) -> Iterator[Trial]:
    true = plane_recording(6)

    def trained(said: np.ndarray) -> list[Any]:
        config = CONFIG.model_copy(update={"iterations": 40})
        scene = reconstruct(replace(true, world_from_camera=said), config).scene
        return [scene.gaussians.parameters(), {} if scene.light is None else scene.light.parameters()]

    poses = true.cameras.world_from_camera
    for name, said in faulty_poses(poses, PLANE_UNIT_MM).items():
        yield name, finite_or_refused(partial(trained, said))
    for value in (math.nan, math.inf):
        spoilt = poses.copy()
        spoilt[2, 0, 3] = value
        yield f"{value}", only_refused(partial(trained, spoilt))


def _fused_off(effort: Effort) -> Iterator[Trial]:
    """Distance of the mesh from the plane over half a pixel, a tenth of a voxel and what poses are off."""
    cameras, depth, normal, point = plane_views(4, 48, 40)
    half_pixel = 0.5 * sum(float(np.abs(np.diff(depth, axis=axis)).max()) for axis in (1, 2))
    voxel = float(np.quantile(depth, 0.95)) * SURFACE.voxel_share
    given = {f"off by {error:g}": displaced(cameras.world_from_camera, error, 1.0) for error in ERRORS}
    near = faulty_poses(cameras.world_from_camera, 1.0)
    given |= {name: near[name] for name in ("one pose for all", "poses a rounding apart", "nearly parallel")}
    for name, said in given.items():
        wrong = Cameras(cameras.K, said, cameras.width, cameras.height)
        mesh = fuse_depth(wrong, depth, SURFACE)
        distance = np.abs((mesh.vertices.astype(np.float64) - point) @ normal)
        off = np.abs((_points(wrong, depth) - point) @ normal).max()
        yield name, float(distance.max()) / (half_pixel + 0.1 * voxel + float(off))


def _points(cameras: Cameras, depth: np.ndarray) -> np.ndarray:
    """World points of all pixels, [F, H, W, 3]."""
    return np.asarray(cameras.centers[:, None, None] + pixel_rays(cameras) * depth[..., None])


def _fused_faulty(effort: Effort) -> Iterator[Trial]:
    cameras, depth, _, _ = plane_views(6, 32, 24)
    for name, said in faulty_poses(cameras.world_from_camera, 1.0).items():
        wrong = Cameras(cameras.K, said, cameras.width, cameras.height)
        yield name, finite_or_refused(partial(fuse_depth, wrong, depth, SURFACE))
    for value in (math.nan, math.inf):
        spoilt = cameras.world_from_camera.copy()
        spoilt[2, 0, 3] = value
        wrong = Cameras(cameras.K, spoilt, cameras.width, cameras.height)
        yield f"{value}", only_refused(partial(fuse_depth, wrong, depth, SURFACE))


def _carved_off(effort: Effort) -> Iterator[Trial]:
    """Distance of free voxels from the axis, over the radius and half the diagonal of a voxel."""
    room = tube()
    for error in ERRORS:
        said = displaced(room.cameras.world_from_camera, error, 1.0)
        yield f"off by {error:g}", _beyond_wall(said)
    for name, said in faulty_poses(room.cameras.world_from_camera, 1.0).items():
        if "far off" not in name:
            yield name, _beyond_wall(said)


def _beyond_wall(said: np.ndarray) -> float:
    room = tube().with_poses(said)
    space = carve(room.scene, room.mesh, room.cameras, CARVING)
    free = space.voxel_centers()[space.occupancy.ravel() == FREE]
    if not all_finite(space) or not len(free):
        return math.inf
    return float(np.hypot(free[:, 0], free[:, 1]).max()) / (1 + math.sqrt(3) / 2 * space.voxel_mm)


def _carved_faulty(effort: Effort) -> Iterator[Trial]:
    room = tube()
    given = faulty_poses(room.cameras.world_from_camera, 1.0)
    for name in ("far off", "one far off"):
        wrong = room.with_poses(given[name])
        yield name, finite_or_refused(partial(carve, room.scene, room.mesh, wrong.cameras, CARVING))
    for value in (math.nan, math.inf):
        spoilt = room.cameras.world_from_camera.copy()
        spoilt[2, 0, 3] = value
        wrong = room.with_poses(spoilt)
        yield f"{value}", only_refused(partial(carve, room.scene, room.mesh, wrong.cameras, CARVING))


def _exposures(effort: Effort) -> Iterator[Trial]:
    """Error of the training views over that at usual exposure times the gain, and a level."""
    base = _unsaturated_error(plane_recording(6))
    for gain in (GAINS[0], 0.25, 2.0, 4.0):
        found = _unsaturated_error(plane_recording(6, gains=np.full(6, gain)))
        # An image that is scaled has its error scaled as well.
        yield f"times {gain:g}", found / (gain * base + 1)
    white = plane_recording(6, gains=np.full(6, GAINS[-1]))
    scene = reconstruct(white, CONFIG).scene
    yield f"times {GAINS[-1]:g}, white", 0.0 if all_finite(scene.gaussians.parameters()) else math.inf


def _unsaturated_error(sequence: EndoscopicSequence) -> float:
    """Root mean square error of the training views, in levels, where the radiance is known."""
    scene = reconstruct(sequence, CONFIG).scene
    views = render(scene, sequence, sequence.train)
    error = LEVELS * views.rgb.clip(0, 1) - sequence.rgb
    return float(np.sqrt(np.square(error[~saturated_mask(sequence.rgb)]).mean()))


def _restored_exposures(effort: Effort) -> Iterator[Trial]:
    config = EnhanceConfig(folds=1, fold_iterations=20, references=4, judge=False)
    for gains in ((1.0,), (GAINS[0],), (GAINS[-1],), (0.25, 1.0, 4.0)):
        room = tube(gains=np.resize(gains, 6))
        references = gather_references(room.scene, room.sequence, room.sequence.train)
        enhancer = train_enhancer(room.scene, room.sequence, config, CONFIG)
        ways = [way[1:] for way in room.trajectories]
        for gain in GAINS:
            exposure = [torch.full((len(way),), gain) for way in ways]
            clips = render_clips(room.scene, references, ways, count=4, exposure=exposure)
            for clip in clips:
                found = enhancer.restore(clip)
                inside = found.rgb.min() >= 0 and found.rgb.max() <= 1
                good = inside and all_finite([found.rgb, found.depth_mm, found.expected_error])
                place = f"frames times {', '.join(f'{g:g}' for g in gains)}, views times {gain:g}"
                yield place, 0.0 if good else math.inf


def _stereo_exposures(effort: Effort) -> Iterator[Trial]:
    """Median relative error of the depth where the radiance is known, over that at usual exposure and a step.

    Pixels of stereo are those of eight bits: a sixteenth of the usual exposure leaves ten of its levels.
    """
    sources = torch.tensor([[k for k in range(4) if k != f] for f in range(4)])
    near, far = (torch.full((4,), share * PLANE_UNIT_MM) for share in (0.7, 7.0))
    step = math.log(10) / (STEREO.hypotheses - 1)

    def error(gains: tuple[float, ...]) -> float:
        recording = plane_recording(4, size=(48, 40), gains=np.resize(gains, 4), grain=FINE)
        found = multi_view_stereo(posed_frames(recording), sources, near, far, STEREO).log_depth
        off = np.abs(found.numpy() - np.log(np.asarray(recording.depth_mm)))
        return float(np.median(off[~saturated_mask(recording.rgb)]))

    base = error((1.0,))
    for gains in ((GAINS[0],), (0.25,), (2.0,), (GAINS[0], 1.0), (0.25, 0.5, 1.0, 2.0)):
        place = f"frames times {', '.join(f'{gain:g}' for gain in gains)}"
        yield place, error(gains) / (base + step)


def _rows() -> Iterator[Row]:
    yield Row(
        "reconstruction",
        "poses off by 1e-6 to 0.1",
        "error over that of an exact scene seen with these poses, and a level",
        1.0,
        _poses_off,
    )
    yield Row("reconstruction", "poses repeated, parallel, wrong", "scenes not finite", FINITE, _faulty)
    yield Row(
        "reconstruction",
        "exposure x16 and /16",
        "error over that at usual exposure times the gain, and a level",
        1.0,
        _exposures,
    )
    yield Row(
        "TSDF",
        "poses off by 1e-6 to 0.1",
        "distance from the plane, over half a pixel, a tenth of a voxel and what its points are off",
        1.0,
        _fused_off,
    )
    yield Row("TSDF", "poses repeated, parallel, wrong", "meshes not finite", FINITE, _fused_faulty)
    yield Row(
        "carving",
        "poses off, repeated, parallel",
        "how far from the axis there is room, over the radius and half a voxel's diagonal",
        1.0,
        _carved_off,
    )
    yield Row("carving", "poses outside, not finite", "grids not finite", FINITE, _carved_faulty)
    yield Row(
        "restorer", "exposure x16 and /16", "results not finite or out of range", FINITE, _restored_exposures
    )
    yield Row(
        "depth",
        "exposure x16 and /16",
        "median error over that at usual exposure and a step of the search",
        1.0,
        _stereo_exposures,
    )


ROWS = tuple(_rows())
