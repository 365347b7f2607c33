"""One branch: the best-first search for a single virtual trajectory."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import zarr
from jaxtyping import Bool, Float, UInt32

from extrags.cameras import Cameras, rotation_angle_deg
from extrags.config import ExploreConfig
from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.exploration.approach import Approaches
from extrags.exploration.expected_error import CLEARANCE_ROUNDING
from extrags.exploration.frontier import Frontier
from extrags.exploration.measurements import SceneMeasurements, frontier_of, measure_scene
from extrags.exploration.observation import Observation, gaussian_words, observe, seen_pairs
from extrags.exploration.primitives import PRIMITIVES, apply_primitives, primitive_motions
from extrags.exploration.score import Candidates, net_turn_deg, score
from extrags.exploration.seen import Seen, Value, union
from extrags.freespace import FREE, FreeSpace
from extrags.scene import Scene
from extrags.store.storable import Storable
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["Branch", "SearchContext", "grow_branch", "prepare_search"]

APPROACH = "approach"
"""Name of the moves on a straight way to a destination."""
SAME_POSE_SHARE = 0.25
"""Poses nearer than this share of a step and of a turn are the same pose."""


@dataclass(frozen=True)
class SearchContext:
    """Read-only inputs shared by all branches.

    Args:
        scene: the reconstructed scene.
        freespace: where cameras may go.
        measured: what was measured of the scene once.
        config: settings of the search.
        frontier: where missing surface begins; empty with pairs and `explore.hole_weight=0`.
    """

    scene: Scene
    freespace: FreeSpace
    measured: SceneMeasurements
    config: ExploreConfig
    frontier: Frontier

    @property
    def value(self) -> Value:
        """What a view newly shows is worth."""
        return self.measured.value

    @property
    def depth_unit_mm(self) -> float:
        """Median rendered depth of the training views: the unit of step and margin."""
        return self.measured.depth_unit_mm

    @property
    def step_mm(self) -> float:
        """Length of a translation."""
        return self.config.step_share * self.depth_unit_mm

    @property
    def margin_mm(self) -> float:
        """Smallest clearance."""
        return self.config.safety_share * self.depth_unit_mm

    def scoring_cameras(self, poses: Float[np.ndarray, "c 4 4"]) -> Cameras:
        """Cameras at the small size candidates are scored at."""
        return self.full_cameras(poses).at_most_width(self.config.render_width)

    def full_cameras(self, poses: Float[np.ndarray, "c 4 4"]) -> Cameras:
        """Cameras at the size the sequence has."""
        return self.measured.cameras(poses)

    def observe(self, poses: Float[np.ndarray, "c 4 4"]) -> list[Observation]:
        """Render views at the small size and measure each of them."""
        cameras = self.scoring_cameras(poses)
        return observe(self.scene, cameras, self.frontier, self.config, depth_unit_mm=self.depth_unit_mm)

    def seen(self, observation: Observation) -> Seen:
        """What a view shows, in the terms of `value`."""
        if self.measured.sizes is not None:
            return self.measured.sizes.seen(observation.sizes)
        camera = self.scoring_cameras(observation.pose[None])
        return seen_pairs(self.scene, camera, observation, self.frontier, self.config.directions)

    def is_allowed(
        self, start: Float[np.ndarray, "3"], ends: Float[np.ndarray, "a 3"], clearance_mm: float
    ) -> Bool[np.ndarray, "a"]:
        """Which camera centres may be reached straight from another.

        Args:
            start: centre to start from.
            ends: centres to reach.
            clearance_mm: at the start. A recording may itself go nearer to the wall than the margin; from
                there every move that does not go nearer still is allowed.
        """
        # A hair less: a camera that keeps its distance does so in any unit and any frame of the world.
        needed = min(self.margin_mm, clearance_mm) * (1 - CLEARANCE_ROUNDING)
        return np.asarray(
            (self.freespace.lookup(ends) == FREE)
            & (self.freespace.clearance_at(ends) >= needed)
            & self.freespace.segment_is_free(np.broadcast_to(start, ends.shape), ends)
        )


@dataclass(frozen=True)
class Branch(Storable):
    """Result of one search.

    Args:
        anchor: index of the training view it starts from (its position among the training views).
        poses: `world_from_camera` of the views, the start first, [L', 4, 4]; L' <= L.
        moves: name of the move that led to each further view, L' - 1 of them.
        values: worth of what each further view shows beyond the snapshot and the views before, [L' - 1].
        seen: rows that the further views show beyond the snapshot: N Gaussians, then F frontier voxels.
        pairs: all (Gaussian, direction) pairs the further views cover, packed, [N].
        expansions: states expanded.
        renders: images rendered.
        reason: why the search ended.
    """

    stored_as: ClassVar[str] = "branch"

    anchor: int
    poses: Float[np.ndarray, "l 4 4"]
    moves: tuple[str, ...]
    values: tuple[float, ...]
    seen: Seen
    pairs: UInt32[np.ndarray, "n"]
    expansions: int
    renders: int
    reason: str

    def __len__(self) -> int:
        return len(self.poses)

    def save(self, path: Path) -> None:
        """Write a zarr v3 group."""
        with new_group(path) as group:
            self.write(group)

    def write(self, group: zarr.Group) -> None:
        """Write into a group."""
        write_array(group, "poses", self.poses)
        write_array(group, "seen_rows", self.seen.row)
        write_array(group, "seen_values", self.seen.value)
        write_array(group, "pairs", self.pairs)
        group.attrs.update(
            {
                "anchor": self.anchor,
                "moves": list(self.moves),
                "values": list(self.values),
                "expansions": self.expansions,
                "renders": self.renders,
                "reason": self.reason,
            }
        )

    @classmethod
    def load(cls, path: Path) -> Branch:
        """Read what `save` wrote."""
        return cls.read(open_group(path))

    @classmethod
    def read(cls, group: zarr.Group) -> Branch:
        """Read what `write` wrote."""
        attributes: dict[str, Any] = dict(group.attrs)
        return cls(
            anchor=attributes["anchor"],
            poses=read_array(group, "poses"),
            moves=tuple(attributes["moves"]),
            values=tuple(attributes["values"]),
            seen=Seen(read_array(group, "seen_rows"), read_array(group, "seen_values")),
            pairs=read_array(group, "pairs"),
            expansions=attributes["expansions"],
            renders=attributes["renders"],
            reason=attributes["reason"],
        )


@dataclass(frozen=True, slots=True)
class _State:
    """A view on a path, with the measurements of its scoring render."""

    observation: Observation
    seen: Seen
    """What the view shows beyond what was known when it was reached."""
    clearance_mm: float
    value: float = 0.0
    move: str = ""
    parent: _State | None = None
    length: int = 1
    path_value: float = 0.0

    @property
    def pose(self) -> Float[np.ndarray, "4 4"]:
        return self.observation.pose

    def path(self) -> list[_State]:
        """The states from the start to this one."""
        states: list[_State] = [self]
        while states[-1].parent is not None:
            states.append(states[-1].parent)
        return states[::-1]


@dataclass
class _VisitedPoses:
    """Poses a branch has generated; the same place reached by another way is not searched again."""

    step_mm: float
    turn_deg: float
    poses: list[Float[np.ndarray, "4 4"]] = field(default_factory=list)

    def contains(self, candidates: Float[np.ndarray, "a 4 4"]) -> Bool[np.ndarray, "a"]:
        # Compared by distance, not by a rounded key: going there and back ends within rounding of the
        # start, and a key may change exactly there. A branch generates a few hundred poses at most.
        known = np.stack(self.poses)
        apart = np.linalg.norm(candidates[:, None, :3, 3] - known[None, :, :3, 3], axis=-1)
        turned = rotation_angle_deg(
            np.broadcast_to(candidates[:, None, :3, :3], (len(candidates), len(known), 3, 3)),
            np.broadcast_to(known[None, :, :3, :3], (len(candidates), len(known), 3, 3)),
        )
        same = (apart < SAME_POSE_SHARE * self.step_mm) & (turned < SAME_POSE_SHARE * self.turn_deg)
        return np.asarray(same.any(axis=1))


def prepare_search(
    scene: Scene,
    cameras: Cameras,
    freespace: FreeSpace,
    config: ExploreConfig,
    measured: SceneMeasurements | None = None,
    *,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> SearchContext:
    """Collect the inputs that all branches share.

    Args:
        scene: the reconstructed scene; it is searched on the processor.
        cameras: the training views; not looked at where `measured` is given.
        freespace: where cameras may go.
        config: settings.
        measured: from an earlier call with the same inputs (`SearchContext.measured`); None measures now.
        masks: pixels of each training view that show tissue (`EndoscopicSequence.training_masks`), at the
            size of `cameras`; None: all. Not looked at where `measured` is given.

    Raises:
        CaptureError: when there is no training view, or none sees a surface.
        ShapeError: when there are not as many masks as cameras.
    """
    # What a view sees is told by blending weights, which the native kernels give and gsplat does not.
    scene = scene.detached().to("cpu")
    frontier = frontier_of(scene, freespace, config)
    if measured is None:
        measured = measure_scene(scene, cameras, freespace, config, frontier, masks)
    return SearchContext(scene, freespace, measured, config, frontier)


def grow_branch(
    context: SearchContext,
    start: Float[np.ndarray, "4 4"],
    coverage: np.ndarray,
    anchor: int = 0,
) -> Branch:
    """Search one trajectory alone from a snapshot of the shared coverage.

    The best candidate of each expansion becomes the next state; the next `top_candidates` - 1 wait in a
    priority queue. Where no candidate is left, the search goes on from the best of the queue. It ends with L
    views, with an empty queue, or when the budget of expansions is spent; in the last two cases the path
    that is worth most is kept. A pure function: same inputs, same branch.

    Args:
        context: what all branches share.
        start: `world_from_camera` of the training view it starts from.
        coverage: what counts as known of each row, like `SceneMeasurements.known`, [R].
        anchor: index of that view, kept in the result.

    Raises:
        ShapeError: when the coverage belongs to another scene.
    """
    rows = len(context.scene.gaussians) + len(context.frontier)
    if len(coverage) != rows:
        raise ShapeError(
            f"coverage of {len(coverage)} rows, but the scene has {len(context.scene.gaussians)} Gaussians "
            f"and {len(context.frontier)} frontier voxels"
        )
    return _Search(context, coverage).branch(start, anchor)


class _Search:
    """State of the search for one branch."""

    def __init__(self, context: SearchContext, coverage: np.ndarray) -> None:
        self.context = context
        self.coverage = coverage
        self.visited = _VisitedPoses(
            context.step_mm, min(context.config.rotation_deg, context.config.orbit_deg)
        )
        self.approaches = Approaches(
            context.measured.destinations,
            context.value,
            coverage,
            step_mm=context.step_mm,
            turn_deg=context.config.rotation_deg,
        )
        self.renders = 0

    def branch(self, start: Float[np.ndarray, "4 4"], anchor: int) -> Branch:
        """Search from a training view."""
        config = self.context.config
        clearance_mm = float(self.context.freespace.clearance_at(start[None, :3, 3])[0])
        (observation,) = self._observe(start[None])
        # What a training view has shown is in the coverage. Beyond its mask and in its holes nothing was, and
        # it is not restored: that is for the virtual views to show.
        nothing = Seen(np.zeros(0, np.int32), np.zeros(0, self.coverage.dtype))
        current = best = _State(observation, nothing, clearance_mm)
        self.visited.poses.append(start)
        queue: list[tuple[float, int, _State]] = []
        order, expansions = 0, 0
        reason = ""
        while not reason:
            scored = self._expand(current)
            expansions += 1
            if scored:
                # The best of this expansion is appended even when an older entry scores higher: the queue
                # is for the case that the path ends.
                following, *others = (state for _, state in scored)
                for (worth, _), state in zip(scored[1:], others, strict=True):
                    order += 1
                    # Ties go to the older entry, so that the order never depends on anything else.
                    heapq.heappush(queue, (-worth, order, state))
            elif queue:
                following = heapq.heappop(queue)[2]
            else:
                reason = f"no further move is possible after {_virtual_views(best.length)}"
                break
            current = following
            emit(Progress("explore-branch", current.length, config.length, {"value": current.path_value}))
            if (current.path_value, current.length) > (best.path_value, best.length):
                best = current
            if current.length >= config.length:
                best = current
                reason = f"reached {_virtual_views(config.length)}"
            elif expansions >= config.max_expansions:
                reason = f"budget of {config.max_expansions} expansions spent, {_virtual_views(best.length)}"
        return self._branch_of(best, anchor, expansions, reason)

    def _branch_of(self, last: _State, anchor: int, expansions: int, reason: str) -> Branch:
        context = self.context
        path = last.path()
        pairs = np.zeros(len(context.scene.gaussians), dtype=np.uint32)
        for state in path[1:]:
            observation = state.observation
            pairs[observation.visible] |= gaussian_words(
                context.scene, observation, context.config.directions
            )
        return Branch(
            anchor=anchor,
            poses=np.stack([state.pose for state in path]),
            moves=tuple(state.move for state in path[1:]),
            values=tuple(state.value for state in path[1:]),
            seen=union(context.value, [state.seen for state in path[1:]], self.coverage),
            pairs=pairs,
            expansions=expansions,
            renders=self.renders,
            reason=reason,
        )

    def _expand(self, state: _State) -> list[tuple[float, _State]]:
        """The best valid candidates of a state, best score first."""
        context, config = self.context, self.context.config
        known = self.coverage.copy()
        path = state.path()
        for earlier in path:
            context.value.add(known, earlier.seen)
        scored = self._moves(state, path, known)
        if config.score == "error":
            scored = self._with_approach(state, known, scored)
        # Stable: equal scores keep the order of the primitives.
        scored = sorted(scored, key=lambda item: -item[0])[: config.top_candidates]
        self.visited.poses += [candidate.pose for _, candidate in scored]
        return scored

    def _moves(self, state: _State, path: list[_State], known: np.ndarray) -> list[tuple[float, _State]]:
        """The moves of `PRIMITIVES` that are possible, with their scores."""
        context, config = self.context, self.context.config
        motions = primitive_motions(
            context.step_mm, config.rotation_deg, config.orbit_deg, state.observation.look_at_mm
        )
        poses = apply_primitives(state.pose, motions)
        allowed = context.is_allowed(state.pose[:3, 3], poses[:, :3, 3], state.clearance_mm)
        kept = np.flatnonzero(allowed & ~self.visited.contains(poses))
        if len(kept) == 0:
            return []
        clearance_mm = context.freespace.clearance_at(poses[kept, :3, 3])
        candidates = [
            self._state(observation, known, float(clearance), state, PRIMITIVES[move])
            for move, observation, clearance in zip(
                kept, self._observe(poses[kept]), clearance_mm, strict=True
            )
        ]
        scores = score(
            Candidates(
                value=np.array([candidate.value for candidate in candidates]),
                poses=poses[kept],
                start=state.pose,
                dark=state.observation.dark,
                turned_deg=net_turn_deg(
                    np.stack([earlier.pose for earlier in path]), poses[kept], config.fold_steps
                ),
            ),
            config,
        )
        return [
            (worth, candidate)
            for worth, candidate in zip(scores.tolist(), candidates, strict=True)
            if not self._is_rejected(candidate)
        ]

    def _with_approach(
        self, state: _State, known: np.ndarray, scored: list[tuple[float, _State]]
    ) -> list[tuple[float, _State]]:
        """Add the way to a destination that is worth more for each view than the best move."""
        context = self.context
        best = max((worth for worth, _ in scored), default=0.0)
        left = context.config.length - state.length
        for rate, poses in self.approaches.better(state.pose, known, left, best):
            starts = np.concatenate([state.pose[None], poses[:-1]])[:, :3, 3]
            centers = poses[:, :3, 3]
            if not all(
                context.is_allowed(start, center[None], state.clearance_mm)[0]
                for start, center in zip(starts, centers, strict=True)
            ):
                continue
            last, along = state, known.copy()
            clearance_mm = context.freespace.clearance_at(centers)
            for observation, clearance in zip(self._observe(poses), clearance_mm, strict=True):
                last = self._state(observation, along, float(clearance), last, APPROACH)
                context.value.add(along, last.seen)
                if self._is_rejected(last):
                    break
            else:
                return [(rate, last), *scored]
        return scored

    def _observe(self, poses: Float[np.ndarray, "a 4 4"]) -> list[Observation]:
        self.renders += len(poses)
        return self.context.observe(poses)

    def _state(
        self,
        observation: Observation,
        known: np.ndarray,
        clearance_mm: float,
        parent: _State | None = None,
        move: str = "",
    ) -> _State:
        value = self.context.value
        seen = self.context.seen(observation)
        worth = value.gain(known, seen)
        return _State(
            observation=observation,
            seen=value.beyond(known, seen),
            clearance_mm=clearance_mm,
            value=worth,
            move=move,
            parent=parent,
            length=1 if parent is None else parent.length + 1,
            path_value=worth + (0.0 if parent is None else parent.path_value),
        )

    def _is_rejected(self, state: _State) -> bool:
        """Too many holes, too near, or more overexposed than allowed.

        Near to the wall the camera's own light whites the image out: nothing could be learned from it. A
        recording may itself be overexposed; from there the share must not grow.
        """
        before = 0.0 if state.parent is None else state.parent.observation.saturated_share
        limit = max(self.context.config.max_saturated_share, before)
        return state.observation.rejected or state.observation.saturated_share > limit


def _virtual_views(length: int) -> str:
    """Views of a path in words: its first one is the real view that it starts from."""
    return f"{length - 1} virtual view{'' if length == 2 else 's'}"
