"""One branch: the best-first search for a single virtual trajectory."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import zarr
from jaxtyping import Bool, Float, Int, UInt32

from extrags.cameras import Cameras, rotation_angle_deg
from extrags.config import ExploreConfig
from extrags.errors import CaptureError, ShapeError
from extrags.events import Progress, emit
from extrags.exploration.coverage import PairValue, coverage_gain, rendered_pairs
from extrags.exploration.darkness import dark_direction, luminance
from extrags.exploration.frontier import Frontier, find_frontier
from extrags.exploration.primitives import PRIMITIVES, apply_primitives, primitive_motions
from extrags.exploration.score import Candidates, net_turn_deg, score
from extrags.freespace import FREE, FreeSpace
from extrags.raster import Rendering
from extrags.scene import Scene
from extrags.store.storable import Storable
from extrags.thresholds import HOLE_ALPHA
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["Branch", "SearchContext", "grow_branch", "known_coverage", "prepare_search"]

NEAR_SHARE = 0.5
"""A candidate is too near when more than this share of its surface pixels is inside the safety margin."""
SAME_POSE_SHARE = 0.25
"""Poses nearer than this share of a step and of a turn are the same pose."""
VIEWS_PER_BATCH = 16


@dataclass(frozen=True)
class SearchContext:
    """Read-only inputs shared by all branches.

    Args:
        scene: the reconstructed scene.
        freespace: where cameras may go.
        K: intrinsics of the virtual cameras at full size, [3, 3].
        width: full image width in pixels.
        height: full image height in pixels.
        depth_unit_mm: median rendered depth of the training views: the unit of step and margin.
        config: settings of the search.
        frontier: where missing surface begins; empty with `explore.hole_weight=0`.
    """

    scene: Scene
    freespace: FreeSpace
    K: Float[np.ndarray, "3 3"]
    width: int
    height: int
    depth_unit_mm: float
    config: ExploreConfig
    frontier: Frontier

    @property
    def value(self) -> PairValue:
        """What newly covered pairs are worth."""
        return PairValue(len(self.scene.gaussians), self.frontier.pair_value)

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
        K = np.broadcast_to(self.K, (len(poses), 3, 3)).copy()
        return Cameras(K, poses, self.width, self.height)


@dataclass(frozen=True)
class Branch(Storable):
    """Result of one search.

    Args:
        anchor: index of the training view it starts from (its position among the training views).
        poses: `world_from_camera` of the views, the start first, [L', 4, 4]; L' <= L.
        moves: name of the move that led to each further view, L' - 1 of them.
        gains: newly covered (Gaussian, direction) pairs of each further view against the snapshot, [L' - 1].
        values: worth of all newly covered pairs of each further view, [L' - 1].
        pairs: all pairs the views add to the snapshot, packed: N Gaussians, then F frontier voxels, [N + F].
        expansions: states expanded.
        renders: images rendered.
        reason: why the search ended.
    """

    stored_as: ClassVar[str] = "branch"

    anchor: int
    poses: Float[np.ndarray, "l 4 4"]
    moves: tuple[str, ...]
    gains: tuple[int, ...]
    values: tuple[float, ...]
    pairs: UInt32[np.ndarray, "r"]
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
        write_array(group, "pairs", self.pairs)
        group.attrs.update(
            {
                "anchor": self.anchor,
                "moves": list(self.moves),
                "gains": list(self.gains),
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
            gains=tuple(attributes["gains"]),
            values=tuple(attributes["values"]),
            pairs=read_array(group, "pairs"),
            expansions=attributes["expansions"],
            renders=attributes["renders"],
            reason=attributes["reason"],
        )


@dataclass(frozen=True, slots=True)
class _State:
    """A view on a path, with the measurements of its scoring render."""

    pose: Float[np.ndarray, "4 4"]
    pairs: UInt32[np.ndarray, "m"]
    """Words of the pairs this view adds to its path, for the rows in `index` alone."""
    index: Int[np.ndarray, "m"]
    look_at_mm: float
    dark: Float[np.ndarray, "3"]
    clearance_mm: float
    gain: int = 0
    value: float = 0.0
    move: str = ""
    parent: _State | None = None
    length: int = 1
    path_value: float = 0.0
    saturated_share: float = 0.0
    rejected: bool = False

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
    scene: Scene, cameras: Cameras, freespace: FreeSpace, config: ExploreConfig
) -> SearchContext:
    """Measure the scene's depth unit and collect the inputs that all branches share.

    Args:
        scene: the reconstructed scene.
        cameras: the training views.
        freespace: where cameras may go.
        config: settings.

    Raises:
        CaptureError: when there is no training view, or none sees a surface.
    """
    if len(cameras) == 0:
        raise CaptureError("there is no training view to explore from")
    small = cameras.at_most_width(config.render_width)
    depths = []
    with torch.no_grad():
        for start in range(0, len(small), VIEWS_PER_BATCH):
            rendering = scene.render(small[start : start + VIEWS_PER_BATCH], sh_degree=0)
            depths.append(rendering.depth[rendering.alpha >= HOLE_ALPHA].numpy())
    depth = np.concatenate(depths)
    if depth.size == 0:
        raise CaptureError(f"none of the {len(cameras)} training views sees a surface of the scene")
    return SearchContext(
        scene.detached(),
        freespace,
        np.median(cameras.K, axis=0),
        cameras.width,
        cameras.height,
        float(np.median(depth)),
        config,
        find_frontier(scene, freespace, config.hole_weight),
    )


def known_coverage(context: SearchContext, cameras: Cameras) -> UInt32[np.ndarray, "r"]:
    """Coverage by the training views: of the Gaussians, then of the frontier voxels, packed, [N + F].

    Args:
        context: from `prepare_search`.
        cameras: the training views.
    """
    small = cameras.at_most_width(context.config.render_width)
    covered = np.zeros(len(context.scene.gaussians) + len(context.frontier), dtype=np.uint32)
    for start in range(0, len(small), VIEWS_PER_BATCH):
        _, pairs = _rendered_pairs(context, small[start : start + VIEWS_PER_BATCH])
        covered |= np.bitwise_or.reduce(pairs, axis=0)
    return covered


def _rendered_pairs(context: SearchContext, cameras: Cameras) -> tuple[Rendering, UInt32[np.ndarray, "c r"]]:
    """Images of views, and the pairs each of them covers: of Gaussians, then of frontier voxels."""
    config = context.config
    with torch.no_grad():
        rendering, pairs = rendered_pairs(context.scene, cameras, **config.coverage.options)
    holes = rendering.alpha.numpy() < HOLE_ALPHA
    frontier = [
        context.frontier.pairs(cameras[index], holes[index], config.directions)
        for index in range(len(cameras))
    ]
    return rendering, np.concatenate([pairs, np.stack(frontier)], axis=1)


def grow_branch(
    context: SearchContext,
    start: Float[np.ndarray, "4 4"],
    coverage: UInt32[np.ndarray, "r"],
    anchor: int = 0,
) -> Branch:
    """Search one trajectory alone from a snapshot of the shared coverage.

    The best candidate of each expansion becomes the next state; the next `top_candidates` - 1 wait in a
    priority queue. Where no candidate is left, the search goes on from the best of the queue. It ends with L
    views, with an empty queue, or when the budget of expansions is spent; in the last two cases the path
    whose new pairs are worth most is kept. A pure function: same inputs, same branch.

    Args:
        context: what all branches share.
        start: `world_from_camera` of the training view it starts from.
        coverage: packed coverage that counts as known (`known_coverage`), [N + F].
        anchor: index of that view, kept in the result.

    Raises:
        ShapeError: when the coverage belongs to another scene.
    """
    config = context.config
    rows = len(context.scene.gaussians) + len(context.frontier)
    if len(coverage) != rows:
        raise ShapeError(
            f"coverage of {len(coverage)} rows, but the scene has {len(context.scene.gaussians)} Gaussians "
            f"and {len(context.frontier)} frontier voxels"
        )
    root = _observe(context, start[None], coverage, context.freespace.clearance_at(start[None, :3, 3]))[0]
    visited = _VisitedPoses(context.step_mm, min(config.rotation_deg, config.orbit_deg), [start])
    queue: list[tuple[float, int, _State]] = []
    order, expansions, renders = 0, 0, 1
    best = current = root
    reason = ""
    while not reason:
        scored, rendered = _expand(context, current, coverage, visited)
        expansions += 1
        renders += rendered
        if scored:
            # The best of this expansion is appended even when an older entry scores higher: the queue
            # is for the case that the path ends.
            following, *others = (state for _, state in scored)
            for (score, _), state in zip(scored[1:], others, strict=True):
                order += 1
                # Ties go to the older entry, so that the order never depends on anything else.
                heapq.heappush(queue, (-score, order, state))
        elif queue:
            following = heapq.heappop(queue)[2]
        else:
            reason = f"no further move is possible after {best.length} views"
            break
        current = following
        emit(Progress("explore-branch", current.length, config.length, {"value": current.path_value}))
        if (current.path_value, current.length) > (best.path_value, best.length):
            best = current
        if current.length >= config.length:
            best = current
            reason = f"reached {config.length} views"
        elif expansions >= config.max_expansions:
            reason = f"budget of {config.max_expansions} expansions spent, {best.length} views"
    return _branch_of(best, anchor, np.zeros_like(coverage), expansions, renders, reason)


def _branch_of(
    last: _State, anchor: int, pairs: UInt32[np.ndarray, "r"], expansions: int, renders: int, reason: str
) -> Branch:
    """The path to a state; `pairs` comes empty and is filled with what the path adds."""
    path = last.path()
    for state in path:
        pairs[state.index] |= state.pairs
    return Branch(
        anchor=anchor,
        poses=np.stack([state.pose for state in path]),
        moves=tuple(state.move for state in path[1:]),
        gains=tuple(state.gain for state in path[1:]),
        values=tuple(state.value for state in path[1:]),
        pairs=pairs,
        expansions=expansions,
        renders=renders,
        reason=reason,
    )


def _expand(
    context: SearchContext, state: _State, coverage: UInt32[np.ndarray, "r"], visited: _VisitedPoses
) -> tuple[list[tuple[float, _State]], int]:
    """The best valid candidates of a state, best score first, and how many images that took."""
    config = context.config
    motions = primitive_motions(context.step_mm, config.rotation_deg, config.orbit_deg, state.look_at_mm)
    poses = apply_primitives(state.pose, motions)
    centers = poses[:, :3, 3]
    clearance = context.freespace.clearance_at(centers)
    # A recording may itself go nearer to the wall than the margin; from there every move that does
    # not go nearer still is allowed.
    needed = min(context.margin_mm, state.clearance_mm)
    feasible = (
        ~visited.contains(poses)
        & (context.freespace.lookup(centers) == FREE)
        & (clearance >= needed)
        & context.freespace.segment_is_free(np.broadcast_to(state.pose[:3, 3], centers.shape), centers)
    )
    kept = np.flatnonzero(feasible)
    if len(kept) == 0:
        return [], 0
    known = coverage.copy()
    path = state.path()
    for earlier in path:
        known[earlier.index] |= earlier.pairs
    candidates = _observe(context, poses[kept], known, clearance[kept], state, [PRIMITIVES[i] for i in kept])
    scores = score(
        Candidates(
            value=np.array([candidate.value for candidate in candidates]),
            poses=poses[kept],
            start=state.pose,
            dark=state.dark,
            turned_deg=net_turn_deg(
                np.stack([earlier.pose for earlier in path]), poses[kept], config.fold_steps
            ),
        ),
        config,
    )
    scored = [
        (value, candidate)
        for value, candidate in zip(scores.tolist(), candidates, strict=True)
        if not candidate.rejected
    ]
    # Stable: equal scores keep the order of the primitives.
    scored = sorted(scored, key=lambda item: -item[0])[: config.top_candidates]
    visited.poses += [candidate.pose for _, candidate in scored]
    return scored, len(kept)


def _observe(
    context: SearchContext,
    poses: Float[np.ndarray, "a 4 4"],
    known: UInt32[np.ndarray, "r"],
    clearance_mm: Float[np.ndarray, "a"],
    parent: _State | None = None,
    moves: list[str] | None = None,
) -> list[_State]:
    """Render poses in one batch; reject those with too many holes, overexposure or too little clearance."""
    config = context.config
    cameras = context.scoring_cameras(poses)
    rendering, pairs = _rendered_pairs(context, cameras)
    n = context.value.n_gaussians
    gains = coverage_gain(known[:n], pairs[:, :n])
    alpha, depth, rgb = rendering.alpha.numpy(), rendering.depth.numpy(), rendering.rgb.numpy()
    states = []
    for index in range(len(poses)):
        surface = (alpha[index] >= HOLE_ALPHA) & (depth[index] > 0)
        near = depth[index][surface] < context.margin_mm
        # Near to the wall the camera's own light whites the image out: nothing could be learned from
        # it. A recording may itself be overexposed; from there the share must not grow.
        saturated = float((luminance(rgb[index]) >= 1.0).mean())
        glare = saturated > max(config.max_saturated_share, 0.0 if parent is None else parent.saturated_share)
        # A view of no surface at all shows nothing that a restorer could continue.
        rejected = bool(
            glare
            or not surface.any()
            or 1 - surface.mean() > config.max_hole_share
            or near.mean() > NEAR_SHARE
        )
        new = pairs[index] & ~known
        touched = np.flatnonzero(new).astype(np.int32)
        value = context.value.gain(known, pairs[index])
        states.append(
            _State(
                pose=poses[index],
                pairs=new[touched],
                index=touched,
                look_at_mm=_look_at_distance(depth[index], surface, context),
                dark=dark_direction(
                    cameras[index], rgb[index], alpha[index], depth[index], context.scene.light
                ),
                clearance_mm=float(clearance_mm[index]),
                gain=int(gains[index]),
                value=value,
                move="" if moves is None else moves[index],
                parent=parent,
                length=1 if parent is None else parent.length + 1,
                path_value=value + (0.0 if parent is None else parent.path_value),
                saturated_share=saturated,
                rejected=rejected,
            )
        )
    return states


def _look_at_distance(
    depth_mm: Float[np.ndarray, "h w"], surface: Bool[np.ndarray, "h w"], context: SearchContext
) -> float:
    """Median depth of the surface in the central half of the view, held near the scene's own unit.

    Looking down the lumen the centre may be far away or empty; an orbit about so
    distant a point would be a large jump.
    """
    height, width = depth_mm.shape
    centre = (slice(height // 4, height - height // 4), slice(width // 4, width - width // 4))
    seen = depth_mm[centre][surface[centre]]
    unit = context.depth_unit_mm
    return float(np.clip(np.median(seen), 0.25 * unit, 2.0 * unit)) if seen.size else unit
