"""Virtual views chosen by the true surface: upper references for a search that does not know it.

* `clairvoyant_clips`: the same starts, moves and free space as the search, but each clip chosen by what it
  truly shows of surface that training never saw or saw badly.
* `free_viewpoint_poses`: single poses anywhere in free space near the recording, of any direction, chosen
  greedily from a large pool: what neither starts nor moves limit.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from data_catalog.surface_views import Seen, SurfaceTruth, Visible, sight_of
from extrags.cameras import Cameras, look_at, pixel_rays, pose_distances
from extrags.events import Progress, emit
from extrags.exploration.ways import Clip, Moves, greedy_clips
from extrags.freespace import FREE

__all__ = ["LackingSurface", "clairvoyant_clips", "free_viewpoint_poses"]

BEAM = 6
MAX_PLANNING_SAMPLES = 8_000
POOL = 1_500
REACH_UNITS = 3.0
"""Poses of the pool lie at most so many depth units from a training camera."""


@dataclass(frozen=True)
class LackingSurface:
    """What views are worth by the true surface that training never saw or saw badly.

    Each never-seen sample counts once when a view sees it, and each lacking one, never or badly seen, once
    more when it is well seen (`WellSeen`), half of that with the first good view.

    Args:
        truth: the true surface.
        points: lacking samples, [I, 3].
        normals: their normals, [I, 3].
        seen: what the views chosen so far and the training views see of them.
        camera: intrinsics and size of the virtual views, a batch of one.
    """

    truth: SurfaceTruth
    points: Float[np.ndarray, "i 3"]
    normals: Float[np.ndarray, "i 3"]
    seen: Seen
    camera: Cameras

    @classmethod
    def of(cls, truth: SurfaceTruth, camera: Cameras, seed: int) -> LackingSurface:
        """All lacking samples, or `MAX_PLANNING_SAMPLES` of them drawn evenly."""
        index = np.flatnonzero(truth.never_seen | truth.badly_seen)
        if len(index) > MAX_PLANNING_SAMPLES:
            rng = np.random.default_rng([seed, 4])
            index = np.sort(rng.choice(index, MAX_PLANNING_SAMPLES, replace=False))
        before = truth.training
        seen = Seen(
            before.rule, before.unit_mm, before.seen[index], before.good_from[index], before.well[index]
        )
        return cls(truth, truth.points[index], truth.normals[index], seen, camera[0])

    def look(self, pose: Float[np.ndarray, "4 4"]) -> Visible:
        """The lacking samples that a view at this `world_from_camera` sees."""
        camera = Cameras(self.camera.K, pose[None], self.camera.width, self.camera.height)
        found = sight_of(self.truth.rays, self.points, self.normals, camera)
        # Thousands of these are remembered.
        return Visible(
            found.index.astype(np.int32),
            found.distance_mm.astype(np.float32),
            found.incidence_cos.astype(np.float32),
            found.toward.astype(np.float32),
        )

    def gain(self, sight: Visible) -> float:
        """How many samples a view serves that were not served before."""
        first, second = self.seen.news(sight)
        unseen = np.count_nonzero(~self.seen.seen[sight.index])
        return float(unseen + 0.5 * (np.count_nonzero(first) + np.count_nonzero(second)))

    def after(self, sight: Visible) -> LackingSurface:
        """With one more view."""
        seen = self.seen.copy()
        seen.add(sight)
        return replace(self, seen=seen)

    def look_at_mm(self, pose: Float[np.ndarray, "4 4"]) -> float:
        """Median true z-depth of the central half of a view, held near the unit as in the search."""
        unit = self.truth.unit_mm
        rays = pixel_rays(Cameras(self.camera.K, pose[None], self.camera.width, self.camera.height))[0]
        height, width = rays.shape[:2]
        rows = np.linspace(height // 4, height - height // 4 - 1, 8).astype(int)
        columns = np.linspace(width // 4, width - width // 4 - 1, 8).astype(int)
        depth = self.truth.rays.cast(pose[:3, 3], rays[np.ix_(rows, columns)]).distance
        depth = depth[np.isfinite(depth)]
        return float(np.clip(np.median(depth), 0.25 * unit, 2.0 * unit)) if depth.size else unit


def clairvoyant_clips(
    truth: SurfaceTruth, moves: Moves, cameras: Cameras, n_views: int, seed: int, *, beam: int = BEAM
) -> list[Clip]:
    """Clips from the starts of the search, by its moves, chosen by what they truly show.

    Args:
        truth: the true surface.
        moves: where a camera can go.
        cameras: the training views.
        n_views: virtual views wanted.
        seed: of the choice of samples.
        beam: paths kept.
    """
    lacking = LackingSurface.of(truth, cameras, seed)
    return greedy_clips(moves, cameras, n_views, lacking, beam=beam)


def free_viewpoint_poses(
    truth: SurfaceTruth, moves: Moves, cameras: Cameras, n_views: int, seed: int, *, pool: int = POOL
) -> list[Clip]:
    """Single poses of a pool, chosen by what they truly show; each is a clip of one view.

    The pool's centres are even over the free voxels with clearance within `REACH_UNITS` of a training
    camera, whether or not a straight way leads there; their directions even over the sphere. A clip's anchor
    is the nearest training view, and the clip jumps there.

    Args:
        truth: the true surface.
        moves: its free space and clearance.
        cameras: the training views.
        n_views: virtual views wanted.
        seed: of the pool and the choice of samples.
        pool: number of candidates.
    """
    lacking = LackingSurface.of(truth, cameras, seed)
    poses = _pool(moves, cameras, pool, seed)
    sights = []
    for number, pose in enumerate(poses):
        sights.append(lacking.look(pose))
        emit(Progress("explore", number + 1, len(poses)))
    queue = [(-lacking.gain(sight), number) for number, sight in enumerate(sights)]
    heapq.heapify(queue)
    chosen: list[int] = []
    while len(chosen) < n_views and queue:
        _, number = heapq.heappop(queue)
        gain = lacking.gain(sights[number])
        if gain == 0:
            continue
        if queue and gain < -queue[0][0]:
            heapq.heappush(queue, (-gain, number))
            continue
        lacking = lacking.after(sights[number])
        chosen.append(number)
    if not chosen:
        return []
    taken = Cameras(np.tile(cameras.K[:1], (len(chosen), 1, 1)), poses[chosen], cameras.width, cameras.height)
    nearest = pose_distances(taken, cameras, moves.unit_mm).argmin(axis=1)
    return [
        Clip(int(anchor), np.stack([cameras.world_from_camera[anchor], pose]))
        for anchor, pose in zip(nearest, poses[chosen], strict=True)
    ]


def _pool(moves: Moves, cameras: Cameras, count: int, seed: int) -> Float[np.ndarray, "p 4 4"]:
    from scipy.spatial import cKDTree

    rng = np.random.default_rng([seed, 5])
    centers = moves.space.from_grid(np.argwhere(moves.space.occupancy == FREE) + 0.5)
    distance, _ = cKDTree(cameras.centers).query(centers)
    near = distance <= REACH_UNITS * moves.unit_mm
    centers = centers[near & (moves.space.clearance_at(centers) >= moves.margin_mm)]
    if len(centers) == 0:
        return np.zeros((0, 4, 4))
    centers = centers[rng.integers(len(centers), size=count)]
    up = -cameras.world_from_camera[:, :3, 1].mean(axis=0)
    forward = rng.normal(size=(count, 3))
    return np.stack(
        [look_at(c, c + f / np.linalg.norm(f), up) for c, f in zip(centers, forward, strict=True)]
    )
