"""The virtual trajectories of a scene, and the driver that finds them."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int, UInt32

from extrags.cameras import Cameras
from extrags.config import DEFAULT_PROFILE, PROFILES, ExploreConfig
from extrags.errors import ShapeError
from extrags.events import MetricRecorded, Progress, emit
from extrags.exploration.coverage import count_pairs
from extrags.exploration.search import Branch, SearchContext, grow_branch, prepare_search
from extrags.exploration.waves import Least, WaveState, search_starts
from extrags.freespace import FreeSpace, carve
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.store.storable import Storable
from extrags.surface import fuse_surface
from extrags.threads import one_torch_thread
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["Exploration", "explore", "finish", "grow", "start_exploration"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Exploration(Storable):
    """Virtual trajectories and the coverage each of them adds.

    Trajectories have at most L views; one that met a dead end has fewer. All views stand one after the
    other, `trajectory` tells which belong together.

    Args:
        cameras: all views at the sequence's image size; the first of each trajectory is a real one, [V].
        trajectory: index of each view's trajectory, rising, [V].
        anchors: frame of the sequence each trajectory starts from, [T].
        gains: newly covered (Gaussian, direction) pairs of each trajectory, in order of acceptance, [T].
        values: worth of what each trajectory adds: error of views off the trajectory that it takes away, as
            a share of full error in all pixels; with `score=pairs` the pairs, holes included, [T].
        moves: names of the moves of each trajectory.
        reasons: why each search ended.
        rejected: why other branches were not accepted.
        coverage_before: packed coverage by the training views, [N].
        coverage_after: packed coverage with all trajectories, [N].
        directions: D.
        renders: images rendered to measure the scene and by the search.
        waves: waves it took.
        score: what `values` are, `explore.score`.
        removable_error: error that views could take away before the first trajectory; 0 with `score=pairs`.

    Raises:
        ShapeError: when the arrays do not fit each other.
    """

    stored_as: ClassVar[str] = "."

    cameras: Cameras
    trajectory: Int[np.ndarray, "v"]
    anchors: Int[np.ndarray, "t"]
    gains: Int[np.ndarray, "t"]
    values: Float[np.ndarray, "t"]
    moves: tuple[tuple[str, ...], ...]
    reasons: tuple[str, ...]
    rejected: tuple[str, ...]
    coverage_before: UInt32[np.ndarray, "n"]
    coverage_after: UInt32[np.ndarray, "n"]
    directions: int
    renders: int
    waves: int
    score: str = "pairs"
    removable_error: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.anchors)
        if len(self.trajectory) != len(self.cameras):
            raise ShapeError(f"{len(self.trajectory)} trajectory indices for {len(self.cameras)} cameras")
        if not len(self.gains) == len(self.values) == len(self.moves) == len(self.reasons) == count:
            raise ShapeError(f"gains, values, moves and reasons must all have {count} entries")

    def __len__(self) -> int:
        """Number of trajectories."""
        return len(self.anchors)

    @property
    def trajectories(self) -> list[Cameras]:
        """The views of each trajectory, its real start first."""
        return [self.cameras[np.flatnonzero(self.trajectory == index)] for index in range(len(self))]

    @property
    def n_virtual(self) -> int:
        """Virtual views in all: without the real starts."""
        return len(self.cameras) - len(self)

    @property
    def n_pairs(self) -> int:
        """All (Gaussian, direction) pairs there are: N times D."""
        return len(self.coverage_before) * self.directions

    @property
    def coverage_share_before(self) -> float:
        """Share of all pairs the training views cover."""
        return float(count_pairs(self.coverage_before)) / max(1, self.n_pairs)

    @property
    def coverage_share_after(self) -> float:
        """Share of all pairs covered with the trajectories."""
        return float(count_pairs(self.coverage_after)) / max(1, self.n_pairs)

    @property
    def gain_share(self) -> float:
        """Share of all pairs the trajectories add."""
        added = int(count_pairs(self.coverage_after & ~self.coverage_before))
        return added / max(1, self.n_pairs)

    def summary(self) -> dict[str, Any]:
        """Summary of the exploration, ready for JSON."""
        return {
            "trajectories": [
                {
                    "anchor_frame": int(self.anchors[index]),
                    "views": int((self.trajectory == index).sum()),
                    "gain": int(self.gains[index]),
                    "value": float(self.values[index]),
                    "moves": list(self.moves[index]),
                    "reason": self.reasons[index],
                }
                for index in range(len(self))
            ],
            "virtual_views": self.n_virtual,
            "gain": int(self.gains.sum()),
            "gain_share": self.gain_share,
            "coverage_share": {"before": self.coverage_share_before, "after": self.coverage_share_after},
            "pairs": self.n_pairs,
            "score": self.score,
            "removable_error": self.removable_error,
            "removed_error": float(self.values.sum()) if self.score == "error" else 0.0,
            "renders": self.renders,
            "waves": self.waves,
            "rejected": list(self.rejected),
        }

    def save(self, directory: Path) -> None:
        """Write the group `trajectories` (zarr v3) and `exploration.json` into a directory."""
        directory.mkdir(parents=True, exist_ok=True)
        with new_group(directory / "trajectories") as group:
            for name in ("trajectory", "anchors", "gains", "values", "coverage_before", "coverage_after"):
                write_array(group, name, getattr(self, name))
            write_array(group, "K", self.cameras.K)
            write_array(group, "world_from_camera", self.cameras.world_from_camera)
            group.attrs.update(
                {
                    "width": self.cameras.width,
                    "height": self.cameras.height,
                    "moves": [list(moves) for moves in self.moves],
                    "reasons": list(self.reasons),
                    "rejected": list(self.rejected),
                    "directions": self.directions,
                    "renders": self.renders,
                    "waves": self.waves,
                    "score": self.score,
                    "removable_error": self.removable_error,
                }
            )
        text = json.dumps(self.summary(), indent=2)
        (directory / "exploration.json").write_text(text + "\n", encoding="utf-8")

    @classmethod
    def load(cls, directory: Path) -> Exploration:
        """Read what `save` wrote."""
        group = open_group(directory / "trajectories")
        attributes: dict[str, Any] = dict(group.attrs)
        arrays = {
            name: read_array(group, name)
            for name in ("trajectory", "anchors", "gains", "values", "coverage_before", "coverage_after")
        }
        poses = read_array(group, "world_from_camera")
        return cls(
            cameras=Cameras(read_array(group, "K"), poses, attributes["width"], attributes["height"]),
            moves=tuple(tuple(moves) for moves in attributes["moves"]),
            reasons=tuple(attributes["reasons"]),
            rejected=tuple(attributes["rejected"]),
            directions=attributes["directions"],
            renders=attributes["renders"],
            waves=attributes["waves"],
            score=attributes.get("score", "pairs"),
            removable_error=attributes.get("removable_error", 0.0),
            **arrays,
        )


def start_exploration(context: SearchContext) -> WaveState:
    """The state before the first wave: coverage by the training views, and the queue of anchors.

    Args:
        context: from `prepare_search`.
    """
    config, measured = context.config, context.measured
    anchors = search_starts(measured.training, config, measured.depth_unit_mm)
    if config.score == "pairs":
        pairs = len(context.scene.gaussians) * config.directions
        total = max(1.0, float(np.ceil(config.min_gain_share * pairs)))
        least = Least(total=total, kept_share=config.wave_kept_share)
    else:
        least = Least(per_view=config.min_view_gain, kept_share=config.wave_kept_share)
    return WaveState(
        pairs_before=measured.pairs,
        pairs=measured.pairs,
        known=measured.known,
        value=measured.value,
        waiting=tuple(anchors),
        room=config.trajectories,
        least=least,
        wave=config.wave,
        renders=measured.renders,
    )


def grow(context: SearchContext, known: np.ndarray, anchor: int) -> Branch:
    """Grow the branch of one anchor: the unit of parallel work."""
    return grow_branch(context, context.measured.training.world_from_camera[anchor], known, anchor)


def finish(context: SearchContext, state: WaveState, train_frames: Int[np.ndarray, "c"]) -> Exploration:
    """The exploration from the state after the last wave.

    Args:
        context: from `prepare_search`.
        state: after the last wave.
        train_frames: frame of the sequence that each training view is.
    """
    lengths = [len(branch) for branch in state.branches]
    poses = [branch.poses for branch in state.branches]
    return Exploration(
        cameras=context.full_cameras(np.concatenate(poses) if poses else np.zeros((0, 4, 4))),
        trajectory=np.repeat(np.arange(len(lengths), dtype=np.int64), lengths),
        anchors=np.array([train_frames[branch.anchor] for branch in state.branches], dtype=np.int64),
        gains=np.array(state.gains, dtype=np.int64),
        values=np.array(state.values, dtype=np.float64),
        moves=tuple(branch.moves for branch in state.branches),
        reasons=tuple(branch.reason for branch in state.branches),
        rejected=state.rejected,
        coverage_before=state.pairs_before,
        coverage_after=state.pairs,
        directions=context.config.directions,
        renders=state.renders,
        waves=state.waves,
        score=context.config.score,
        removable_error=context.measured.removable_error,
    )


@one_torch_thread()
def explore(
    scene: Scene,
    sequence: EndoscopicSequence,
    config: ExploreConfig | None = None,
    *,
    freespace: FreeSpace | None = None,
    map: Callable[..., Iterable[Branch]] = map,
) -> Exploration:
    """Find virtual trajectories that see what the training views did not.

    Args:
        scene: the reconstructed scene.
        sequence: its frames; the training frames are the starts.
        config: settings; `trajectories` is the budget. None takes those of the profile `balanced`.
        freespace: where cameras may go; None carves it with the settings of that profile.
        map: like the builtin; a pool's `map` grows the branches of a wave in parallel, and what it is
            called with can be pickled. The result is the same for any number of workers.

    Returns:
        The trajectories; none when nothing can be gained (see `rejected` for why).

    Raises:
        CaptureError: when there is no training view or none sees a surface.

    Source: [ExtraGS, section "Virtual Exploration View Sampling"], see docs/references.md.
    """
    config = PROFILES[DEFAULT_PROFILE].explore if config is None else config
    cameras = sequence.training_cameras
    masks = sequence.training_masks
    if freespace is None:
        freespace = carve(scene, fuse_surface(scene, cameras, masks=masks), cameras, masks=masks)
    context = prepare_search(scene, cameras, freespace, config, masks=masks)
    state = start_exploration(context)
    while anchors := state.next_wave():
        branches = list(map(partial(grow, context, state.known), anchors))
        state = state.merged(branches)
        emit(
            Progress(
                "explore",
                len(state.branches),
                config.trajectories,
                {"value": float(sum(state.values)), "renders": float(state.renders)},
            )
        )
    exploration = finish(context, state, sequence.train)
    emit(MetricRecorded("explore", "gain_share", exploration.gain_share))
    if exploration.score == "error":
        emit(MetricRecorded("explore", "removed_error", float(exploration.values.sum())))
    _log.info(
        "explore: %d trajectories, %d virtual views, %.2f %% of all pairs added in %d renders",
        len(exploration),
        exploration.n_virtual,
        100 * exploration.gain_share,
        exploration.renders,
    )
    return exploration
