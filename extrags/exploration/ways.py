"""Other ways to choose virtual views, to compare the search with.

Each gives clips from the same starts, by the same moves (`extrags.exploration.primitives`) and under the same
rule of where a camera may go: its voxel is free, the clearance is kept, and so is the straight way there.

* `random_walk`: any of the moves that are possible, with equal chances.
* `perturbed_views`: training poses, shifted and turned at random: the fixed augmentation of many papers.
* `frontier_clips`: greedy by the border between free and unknown space alone; no image is rendered.
* `greedy_clips`: greedy by whatever views are worth; the clairvoyant way (`data_catalog.clairvoyant`) gives
  it the true surface.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.cameras import Cameras, rotation_about
from extrags.config import ExploreConfig
from extrags.events import Progress, emit
from extrags.exploration.expected_error import CLEARANCE_ROUNDING
from extrags.exploration.primitives import apply_primitives, orthonormalised, primitive_motions
from extrags.exploration.waves import search_starts
from extrags.freespace import FREE, UNKNOWN, FreeSpace

__all__ = [
    "Clip",
    "Moves",
    "Worth",
    "frontier_clips",
    "greedy_clips",
    "perturbed_views",
    "random_walk",
]

PERTURBED_SHIFT_STEPS = 2.0
"""Largest shift of a perturbed training pose, in steps of the search."""
PERTURBED_TURN_DEG = 20.0
"""Largest turn of a perturbed training pose."""
ATTEMPTS = 50
REMEMBERED_SIGHTS = 10_000
MAX_FRONTIER_VOXELS = 1500
FRONTIER_REACH_UNITS = 3.0
"""A frontier voxel farther from the camera than so many depth units does not count as seen."""


@runtime_checkable
class Worth(Protocol):
    """What views are worth, given those that were chosen already; a value, not changed by its methods."""

    def look(self, pose: Float[np.ndarray, "4 4"]) -> Any:
        """What a view at this `world_from_camera` sees; independent of other views."""
        ...

    def gain(self, sight: Any) -> float:
        """What a view that sees this adds."""
        ...

    def after(self, sight: Any) -> Worth:
        """What views are worth once this one is chosen."""
        ...

    def look_at_mm(self, pose: Float[np.ndarray, "4 4"]) -> float:
        """Distance of the point that an orbit from this view goes round."""
        ...


@dataclass(frozen=True)
class Clip:
    """A continuous virtual trajectory.

    Args:
        anchor: the training view it starts from (its position among the training views).
        poses: `world_from_camera`, the real start first, [L, 4, 4].
    """

    anchor: int
    poses: Float[np.ndarray, "l 4 4"]

    @property
    def views(self) -> Float[np.ndarray, "v 4 4"]:
        """The virtual views: all but the start."""
        return self.poses[1:]


@dataclass(frozen=True)
class Moves:
    """Where a virtual camera can go from a view, as in the search.

    Args:
        space: free, occupied and unknown voxels.
        unit_mm: median rendered depth of the training views.
        config: step, angles, clearance.
    """

    space: FreeSpace
    unit_mm: float
    config: ExploreConfig

    @property
    def margin_mm(self) -> float:
        """Smallest clearance."""
        return self.config.safety_share * self.unit_mm

    @property
    def step_mm(self) -> float:
        """Length of a translation."""
        return self.config.step_share * self.unit_mm

    def starts(self, cameras: Cameras) -> list[int]:
        """Training views to start from, those of the search."""
        return search_starts(cameras, self.config, self.unit_mm)

    def allowed(
        self, start: Float[np.ndarray, "4 4"], poses: Float[np.ndarray, "a 4 4"]
    ) -> Bool[np.ndarray, "a"]:
        """Which poses a camera at `start` can go to on a straight way."""
        centers = poses[:, :3, 3]
        # A recording may itself go nearer to the wall than the margin.
        needed = min(self.margin_mm, float(self.space.clearance_at(start[None, :3, 3])[0]))
        needed *= 1 - CLEARANCE_ROUNDING
        return np.asarray(
            (self.space.lookup(centers) == FREE)
            & (self.space.clearance_at(centers) >= needed)
            & self.space.segment_is_free(np.broadcast_to(start[:3, 3], centers.shape), centers)
        )

    def possible(
        self, pose: Float[np.ndarray, "4 4"], look_at_mm: float | None = None
    ) -> Float[np.ndarray, "a 4 4"]:
        """The poses that one move leads to.

        Args:
            pose: where the camera is.
            look_at_mm: z-depth of the point that an orbit goes round; None takes the depth unit.
        """
        config = self.config
        look_at = self.unit_mm if look_at_mm is None else look_at_mm
        motions = primitive_motions(self.step_mm, config.rotation_deg, config.orbit_deg, look_at)
        poses = apply_primitives(pose, motions)
        return np.asarray(poses[self.allowed(pose, poses)])


def random_walk(moves: Moves, cameras: Cameras, n_views: int, seed: int) -> list[Clip]:
    """Clips of random moves, from each start in turn.

    Args:
        moves: where a camera can go; `config.length` is the length of a clip.
        cameras: the training views.
        n_views: virtual views wanted; fewer where no start can be left.
        seed: of the moves.
    """
    rng = np.random.default_rng([seed, 1])
    clips: list[Clip] = []
    starts = moves.starts(cameras)
    # In a row: of some starts that can be left, others that cannot take their turn again and again.
    turn, failed, left = 0, 0, n_views
    while left > 0 and failed < len(starts):
        anchor = starts[turn % len(starts)]
        turn += 1
        poses = [cameras.world_from_camera[anchor]]
        while len(poses) < min(moves.config.length, left + 1):
            possible = moves.possible(poses[-1])
            if len(possible) == 0:
                break
            poses.append(possible[rng.integers(len(possible))])
        if len(poses) == 1:
            failed += 1
            continue
        failed = 0
        clips.append(Clip(anchor, np.stack(poses)))
        left -= len(poses) - 1
    return clips


def perturbed_views(moves: Moves, cameras: Cameras, n_views: int, seed: int) -> list[Clip]:
    """Training poses shifted and turned at random, each a clip of one view, from each start in turn.

    The shift is even over a ball of `PERTURBED_SHIFT_STEPS` steps, the turn even up to `PERTURBED_TURN_DEG`
    about an axis of any direction. Poses where a camera may not go are drawn again, `ATTEMPTS` times.

    Args:
        moves: where a camera can go.
        cameras: the training views.
        n_views: virtual views wanted.
        seed: of the perturbations.
    """
    rng = np.random.default_rng([seed, 2])
    starts = moves.starts(cameras)
    clips: list[Clip] = []
    for number in range(n_views):
        anchor = starts[number % len(starts)]
        start = cameras.world_from_camera[anchor]
        for _ in range(ATTEMPTS):
            pose = start.copy()
            direction = rng.normal(size=3)
            radius = PERTURBED_SHIFT_STEPS * moves.step_mm * np.cbrt(rng.random())
            pose[:3, 3] += radius * direction / np.linalg.norm(direction)
            turn = rotation_about(rng.normal(size=3), np.radians(PERTURBED_TURN_DEG) * float(rng.random()))
            pose[:3, :3] = orthonormalised(start[:3, :3] @ turn)
            if moves.allowed(start, pose[None])[0]:
                clips.append(Clip(anchor, np.stack([start, pose])))
                break
    return clips


def frontier_clips(moves: Moves, cameras: Cameras, n_views: int, seed: int) -> list[Clip]:
    """Clips chosen greedily by the frontier voxels they see: free ones with an unknown neighbour.

    A voxel is seen when it lies in the image, no farther away than `FRONTIER_REACH_UNITS`, and all voxels on
    the way are free. Voxels that training views see do count: a frontier is where their sight ended.

    Args:
        moves: where a camera can go.
        cameras: the training views; the first one's intrinsics are those of the virtual views.
        n_views: virtual views wanted.
        seed: of the choice of voxels where there are more than `MAX_FRONTIER_VOXELS`.

    Source: [Yamauchi1997], see docs/references.md.
    """
    from scipy.ndimage import binary_dilation

    space = moves.space
    voxels = np.argwhere((space.occupancy == FREE) & binary_dilation(space.occupancy == UNKNOWN))
    rng = np.random.default_rng([seed, 3])
    if len(voxels) > MAX_FRONTIER_VOXELS:
        voxels = voxels[np.sort(rng.choice(len(voxels), MAX_FRONTIER_VOXELS, replace=False))]
    points = space.from_grid(voxels + 0.5)
    return greedy_clips(
        moves, cameras, n_views, _FrontierWorth(moves, cameras[0], points, np.ones(len(points), bool)), beam=1
    )


@dataclass(frozen=True)
class _FrontierWorth:
    """The number of frontier voxels that a view is the first to see."""

    moves: Moves
    camera: Cameras
    points: Float[np.ndarray, "n 3"]
    left: Bool[np.ndarray, "n"]

    def look(self, pose: Float[np.ndarray, "4 4"]) -> Int[np.ndarray, "m"]:
        camera = Cameras(self.camera.K, pose[None], self.camera.width, self.camera.height)
        near = np.linalg.norm(self.points - pose[:3, 3], axis=1) <= FRONTIER_REACH_UNITS * self.moves.unit_mm
        index = np.flatnonzero(near)
        (pixels,), _ = camera.project(self.points[index])
        index = index[camera.contains(pixels)]
        eye = np.broadcast_to(pose[:3, 3], (len(index), 3))
        return np.asarray(index[self.moves.space.segment_is_free(eye, self.points[index])])

    def gain(self, sight: Int[np.ndarray, "m"]) -> float:
        return float(np.count_nonzero(self.left[sight]))

    def after(self, sight: Int[np.ndarray, "m"]) -> _FrontierWorth:
        left = self.left.copy()
        left[sight] = False
        return replace(self, left=left)

    def look_at_mm(self, pose: Float[np.ndarray, "4 4"]) -> float:
        return self.moves.unit_mm


def greedy_clips(
    moves: Moves, cameras: Cameras, n_views: int, worth: Worth, *, beam: int, min_gain: float = 0.0
) -> list[Clip]:
    """Clips chosen one after the other by what they add to those before.

    From each start the best clip is looked for with a beam: of all paths of equal length the best `beam` go
    on. The best of all starts is taken, then all are compared again. What a start was last worth is taken to
    bound what it is worth now (a view adds the less the more was seen before), so most need not be searched
    again.

    Args:
        moves: where a camera can go; `config.length` is the length of a clip.
        cameras: the training views.
        n_views: virtual views wanted; fewer where no clip adds more than `min_gain`.
        worth: what views are worth.
        beam: paths kept.
        min_gain: ends with the first clip that adds no more.

    Source: [Minoux1978], see docs/references.md.
    """
    grower = _Grower(moves, worth, beam)
    clips: list[Clip] = []
    left = n_views
    # (minus the bound, order of the start, anchor): all starts are searched before the first is taken.
    queue = [(-np.inf, order, anchor) for order, anchor in enumerate(moves.starts(cameras))]
    current: dict[int, _Path] = {}
    while left > 0 and queue:
        _, order, anchor = heapq.heappop(queue)
        if anchor not in current:
            start = cameras.world_from_camera[anchor]
            current[anchor] = grower.best(start, worth, min(moves.config.length, left + 1))
        best = current[anchor]
        if best.gain <= min_gain:
            continue
        if queue and best.gain < -queue[0][0]:
            heapq.heappush(queue, (-best.gain, order, anchor))
            continue
        clips.append(Clip(anchor, np.stack(best.poses)))
        worth = best.worth
        left -= len(best.poses) - 1
        current.clear()
        heapq.heappush(queue, (-best.gain, order, anchor))
        emit(Progress("explore", n_views - left, n_views, {"gain": best.gain}))
    return clips


@dataclass
class _Path:
    poses: list[Float[np.ndarray, "4 4"]]
    worth: Worth
    gain: float = 0.0


@dataclass
class _Grower:
    """Beam search for the clip that adds most; remembers what each pose sees and where it leads."""

    moves: Moves
    sights: Worth
    beam: int
    _seen: dict[bytes, Any] = field(default_factory=dict)
    _next: dict[bytes, Float[np.ndarray, "a 4 4"]] = field(default_factory=dict)

    def _sight(self, pose: Float[np.ndarray, "4 4"]) -> Any:
        key = pose.tobytes()
        if key not in self._seen:
            if len(self._seen) >= REMEMBERED_SIGHTS:
                self._seen.pop(next(iter(self._seen)))
            self._seen[key] = self.sights.look(pose)
        return self._seen[key]

    def _possible(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "a 4 4"]:
        key = pose.tobytes()
        if key not in self._next:
            self._next[key] = self.moves.possible(pose, self.sights.look_at_mm(pose))
        return self._next[key]

    def best(self, start: Float[np.ndarray, "4 4"], worth: Worth, length: int) -> _Path:
        """The best clip of at most so many views, the start included."""
        paths = [_Path([start], worth)]
        best = paths[0]
        for _ in range(length - 1):
            found: list[tuple[float, int, _Path, Float[np.ndarray, "4 4"]]] = []
            places: set[bytes] = set()
            for path in paths:
                for pose in self._possible(path.poses[-1]):
                    place = self._place(pose)
                    if place in places:
                        continue
                    places.add(place)
                    gain = path.gain + path.worth.gain(self._sight(pose))
                    found.append((gain, -len(found), path, pose))
            found.sort(key=lambda candidate: candidate[:2], reverse=True)
            paths = [
                _Path([*path.poses, pose], path.worth.after(self._sight(pose)), gain)
                for gain, _, path, pose in found[: self.beam]
            ]
            if not paths:
                break
            best = max([best, *paths], key=lambda path: path.gain)
        return best

    def _place(self, pose: Float[np.ndarray, "4 4"]) -> bytes:
        """The same for poses so near to each other that the beam needs one of them."""
        scaled = pose[:3].copy()
        scaled[:, 3] /= self.moves.step_mm
        # Adding zero turns -0.0 into 0.0.
        return (np.round(scaled, 1) + 0.0).tobytes()
