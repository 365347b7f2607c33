"""Branches in parallel: waves that grow from one snapshot, and a greedy merge after each.

Which anchors grow together is fixed by the settings alone, every branch sees the same snapshot, and the
merge looks at all of them at once: the result does not depend on how many workers there are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int, UInt32

from extrags.cameras import Cameras, pose_distances
from extrags.config import ExploreConfig
from extrags.errors import ConfigError
from extrags.exploration.coverage import coverage_gain
from extrags.exploration.search import Branch
from extrags.exploration.seen import PairValue, Value, restored
from extrags.store.storable import Storable
from extrags.zarr_io import has_array, new_group, open_group, read_array, write_array

__all__ = ["Least", "Merge", "WaveState", "merge_wave", "search_starts", "start_views"]


def start_views(
    cameras: Cameras, count: int, depth_unit_mm: float, spacing: float = math.inf
) -> Int[np.ndarray, "t"]:
    """Training views spread evenly over space, by farthest point sampling.

    Their distance is `extrags.cameras.pose_distances` in depth units. The first is the view nearest to the
    middle of all, each further one the farthest from those before it; so any number of the first views
    is spread evenly, too.

    Args:
        cameras: the training views.
        count: how many are wanted; all are returned when there are not so many.
        depth_unit_mm: median rendered depth.
        spacing: further ones are returned until every view is within this distance of one.

    Returns:
        Indices into `cameras`, no index twice.

    Raises:
        ConfigError: when `count` is below one.

    Source: Gonzalez 1985, "Clustering to minimize the maximum intercluster distance".
    """
    if count < 1:
        raise ConfigError(f"the search needs at least one start, found {count}")

    def distance_from(index: int) -> Float[np.ndarray, "c"]:
        return pose_distances(cameras, cameras[index], depth_unit_mm)[:, 0]

    middle = np.linalg.norm(cameras.centers - cameras.centers.mean(axis=0), axis=1)
    chosen = [int(np.argmin(middle))]
    nearest = distance_from(chosen[0])
    while len(chosen) < len(cameras):
        nearest[chosen] = -1.0
        if len(chosen) >= count and nearest.max() <= spacing:
            break
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, distance_from(chosen[-1]))
    return np.array(chosen, dtype=np.int64)


def search_starts(cameras: Cameras, config: ExploreConfig, depth_unit_mm: float) -> list[int]:
    """Training views that the search may start from, spread evenly.

    Args:
        cameras: the training views.
        config: number and spacing.
        depth_unit_mm: median rendered depth.

    Returns:
        Indices into `cameras`, in the order of `start_views`.
    """
    if config.score == "pairs":
        found = start_views(cameras, config.trajectories, depth_unit_mm)
    else:
        count = max(config.starts, config.trajectories)
        found = start_views(cameras, count, depth_unit_mm, config.start_spacing)
    return [int(view) for view in found]


@dataclass(frozen=True)
class Least:
    """What a trajectory must be worth to be accepted.

    Args:
        total: at least.
        per_view: for each of its virtual views.
        kept_share: of its worth alone, that the other branches of its wave have to leave; one that lost more
            grows again from what is known then.
    """

    total: float = 0.0
    per_view: float = 0.0
    kept_share: float = 0.0

    def of(self, branch: Branch) -> float:
        """What a branch must be worth."""
        return max(self.total, self.per_view * (len(branch) - 1))

    def accepts(self, branch: Branch, worth: float) -> bool:
        """Whether a worth is enough; a trajectory that adds nothing, or has no virtual view, never is."""
        return len(branch) >= 2 and worth > 0 and worth >= self.of(branch)


@dataclass(frozen=True)
class Merge:
    """Result of a merge.

    Args:
        known: the shared coverage with the accepted branches added, [R].
        pairs: (Gaussian, direction) pairs with theirs, packed, [N].
        accepted: positions of the accepted branches in the wave, in the order of acceptance.
        gains: newly covered (Gaussian, direction) pairs each of them added when it was accepted.
        values: worth of what it added then.
    """

    known: np.ndarray
    pairs: UInt32[np.ndarray, "n"]
    accepted: tuple[int, ...]
    gains: tuple[int, ...]
    values: tuple[float, ...]


def merge_wave(
    known: np.ndarray,
    pairs: UInt32[np.ndarray, "n"],
    branches: Sequence[Branch],
    value: Value,
    *,
    least: Least,
    room: int,
) -> Merge:
    """Accept branches greedily by the worth of what each still adds to the shared coverage.

    The worth is submodular, so greedy acceptance is within 1 - 1/e of the best choice (Nemhauser, Wolsey and
    Fisher 1978), and a branch that is not worth enough now never is again.

    Args:
        known: the snapshot the branches grew from, [R].
        pairs: (Gaussian, direction) pairs that are covered, packed, [N].
        branches: the wave.
        value: what rows are worth; the same as in the search.
        least: what a branch must be worth.
        room: accept at most so many.
    """
    known, pairs = known.copy(), pairs.copy()
    left = list(range(len(branches)))
    accepted: list[int] = []
    gains: list[int] = []
    values: list[float] = []
    alone = [value.gain(known, branch.seen) for branch in branches]
    while len(accepted) < room:
        worths = [value.gain(known, branches[index].seen) for index in left]
        enough = [
            least.accepts(branches[index], worth) and worth >= least.kept_share * alone[index]
            for index, worth in zip(left, worths, strict=True)
        ]
        if not any(enough):
            break
        # The first of equals, so that the order of the wave decides and nothing else.
        top = int(np.argmax(np.where(enough, worths, -np.inf)))
        chosen = left.pop(top)
        gains.append(int(coverage_gain(pairs, branches[chosen].pairs)))
        values.append(worths[top])
        value.add(known, branches[chosen].seen)
        pairs |= branches[chosen].pairs
        accepted.append(chosen)
    return Merge(known, pairs, tuple(accepted), tuple(gains), tuple(values))


@dataclass(frozen=True)
class WaveState(Storable):
    """State of the exploration between two waves.

    Args:
        pairs_before: (Gaussian, direction) pairs that the training views cover, packed, [N].
        pairs: the same with all accepted trajectories.
        known: what is known of each row, in the terms of `value`, [R].
        value: what newly shown rows are worth.
        waiting: queue of anchors, the next one first.
        room: trajectories that may still be accepted.
        least: what a trajectory must be worth.
        wave: branches per wave.
        branches: accepted so far.
        gains: (Gaussian, direction) pairs each of them added.
        values: worth of what each of them added.
        rejected: why branches were not accepted, one sentence each.
        waves: waves finished.
        renders: images rendered: to measure the scene, and by all branches, rejected ones included.
    """

    stored_as: ClassVar[str] = "state"

    pairs_before: UInt32[np.ndarray, "n"]
    pairs: UInt32[np.ndarray, "n"]
    known: np.ndarray
    value: Value
    waiting: tuple[int, ...]
    room: int
    least: Least
    wave: int
    branches: tuple[Branch, ...] = ()
    gains: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    rejected: tuple[str, ...] = ()
    waves: int = 0
    renders: int = 0

    def next_wave(self) -> tuple[int, ...]:
        """Anchors that grow together now; empty when the exploration is finished.

        Always different ones: two branches from one anchor and one snapshot would be the same. Where there
        are more starts than room, all of them grow in the first wave: which ones are worth the room cannot
        be told before. Not with a wave of one, where trajectories are found one by one.
        """
        if self.room == 0:
            return ()
        if self.waves == 0 and self.wave > 1 and len(self.waiting) > self.room:
            return self.waiting
        return self.waiting[: self.wave]

    def merged(self, branches: Sequence[Branch]) -> WaveState:
        """The state after a wave.

        Anchors of accepted branches go to the end of the queue and grow another branch when their turn
        comes and there is room. So do anchors whose branch was rejected only because of the others in its
        wave. An anchor whose branch would not have been accepted even alone is removed. Every wave
        therefore accepts a branch or removes its anchors, so the exploration terminates.

        Args:
            branches: one per anchor of `next_wave()`, in that order.

        Raises:
            ConfigError: when the branches belong to other anchors.
        """
        anchors = self.next_wave()
        if tuple(branch.anchor for branch in branches) != anchors:
            raise ConfigError(
                f"the wave has the anchors {anchors}, but the branches start from "
                f"{tuple(branch.anchor for branch in branches)}"
            )
        merge = merge_wave(self.known, self.pairs, branches, self.value, least=self.least, room=self.room)
        again, rejected = [], []
        for index, branch in enumerate(branches):
            alone = self.value.gain(self.known, branch.seen)
            if index not in merge.accepted:
                left = self.value.gain(merge.known, branch.seen)
                if not self.least.accepts(branch, left):
                    why = f"needs {self._said(self.least.of(branch))}"
                elif self.room == len(merge.accepted):
                    why = "there was no room left"
                else:
                    why = "grows again after the others of its wave"
                rejected.append(
                    f"from view {branch.anchor}: adds {self._said(left)} ({self._said(alone)} alone), {why}; "
                    f"{branch.reason}"
                )
            if self.least.accepts(branch, alone):
                again.append(branch.anchor)
        return replace(
            self,
            known=merge.known,
            pairs=merge.pairs,
            waiting=(*self.waiting[len(anchors) :], *again),
            room=self.room - len(merge.accepted),
            branches=(*self.branches, *(branches[index] for index in merge.accepted)),
            gains=(*self.gains, *merge.gains),
            values=(*self.values, *merge.values),
            rejected=(*self.rejected, *rejected),
            waves=self.waves + 1,
            renders=self.renders + sum(branch.renders for branch in branches),
        )

    def _said(self, worth: float) -> str:
        if isinstance(self.value, PairValue):
            return f"{worth:.0f} pairs"
        return f"{100 * worth:.3f} % of error"

    def save(self, path: Path) -> None:
        """Write a zarr v3 group, accepted branches inside."""
        with new_group(path) as group:
            for name in ("pairs_before", "pairs", "known"):
                write_array(group, name, getattr(self, name))
            attributes, arrays = self.value.saved()
            for name, array in arrays.items():
                write_array(group, name, array)
            group.attrs.update(
                {
                    "waiting": list(self.waiting),
                    "room": self.room,
                    "least_total": self.least.total,
                    "least_per_view": self.least.per_view,
                    "least_kept_share": self.least.kept_share,
                    "wave": self.wave,
                    "gains": list(self.gains),
                    "values": list(self.values),
                    "rejected": list(self.rejected),
                    "waves": self.waves,
                    "renders": self.renders,
                    "n_branches": len(self.branches),
                    **attributes,
                }
            )
            for index, branch in enumerate(self.branches):
                branch.write(group.create_group(f"branch_{index:04d}"))

    @classmethod
    def load(cls, path: Path) -> WaveState:
        """Read what `save` wrote."""
        group = open_group(path)
        attributes: dict[str, Any] = dict(group.attrs)
        return cls(
            pairs_before=read_array(group, "pairs_before"),
            pairs=read_array(group, "pairs"),
            known=read_array(group, "known"),
            value=restored(attributes, read_array(group, "error") if has_array(group, "error") else None),
            waiting=tuple(attributes["waiting"]),
            room=attributes["room"],
            least=Least(*(attributes[f"least_{name}"] for name in ("total", "per_view", "kept_share"))),
            wave=attributes["wave"],
            branches=tuple(
                Branch.read(group.require_group(f"branch_{index:04d}"))
                for index in range(attributes["n_branches"])
            ),
            gains=tuple(attributes["gains"]),
            values=tuple(attributes["values"]),
            rejected=tuple(attributes["rejected"]),
            waves=attributes["waves"],
            renders=attributes["renders"],
        )
