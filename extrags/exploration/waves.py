"""Branches in parallel: waves that grow from one snapshot, and a greedy merge after each.

Which anchors grow together is fixed by the settings alone, every branch sees the same snapshot, and the
merge looks at all of them at once: the result does not depend on how many workers there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int, UInt32

from extrags.cameras import Cameras, pose_distances
from extrags.errors import ConfigError
from extrags.exploration.coverage import PairValue, coverage_gain
from extrags.exploration.search import Branch
from extrags.store.storable import Storable
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["Merge", "WaveState", "merge_wave", "start_views"]


def start_views(cameras: Cameras, count: int, depth_unit_mm: float) -> Int[np.ndarray, "t"]:
    """Training views spread evenly over space, by farthest point sampling.

    Their distance is `extrags.cameras.pose_distances` in depth units. The first is the view nearest to the
    middle of all, each further one the farthest from those before it; so any number of the first views
    is spread evenly, too.

    Args:
        cameras: the training views.
        count: how many are wanted; all are returned when there are not so many.
        depth_unit_mm: median rendered depth.

    Returns:
        Indices into `cameras`, at most `count`, no index twice.

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
    while len(chosen) < min(count, len(cameras)):
        nearest[chosen] = -1.0
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, distance_from(chosen[-1]))
    return np.array(chosen, dtype=np.int64)


@dataclass(frozen=True)
class Merge:
    """Result of a merge.

    Args:
        coverage: the shared coverage with the accepted branches added, packed, [N + F].
        accepted: positions of the accepted branches in the wave, in the order of acceptance.
        gains: newly covered (Gaussian, direction) pairs each of them added when it was accepted.
        values: worth of all pairs it added then.
    """

    coverage: UInt32[np.ndarray, "r"]
    accepted: tuple[int, ...]
    gains: tuple[int, ...]
    values: tuple[float, ...]


def merge_wave(
    coverage: UInt32[np.ndarray, "r"],
    branches: Sequence[Branch],
    value: PairValue,
    *,
    min_gain: int,
    room: int,
) -> Merge:
    """Accept branches greedily by the worth of what each still adds to the shared coverage.

    Weighted coverage is submodular, so greedy acceptance is within 1 - 1/e of the best choice (Nemhauser,
    Wolsey and Fisher 1978), and once the largest marginal gain is below the threshold all others are, too.

    Args:
        coverage: the snapshot the branches grew from, packed, [N + F].
        branches: the wave.
        value: what pairs are worth; the same as in the search.
        min_gain: a branch must add pairs of at least this worth.
        room: accept at most so many.
    """
    coverage = coverage.copy()
    left = [index for index, branch in enumerate(branches) if len(branch) >= 2]
    accepted: list[int] = []
    gains: list[int] = []
    values: list[float] = []
    while left and len(accepted) < room:
        marginal = [value.gain(coverage, branches[index].pairs) for index in left]
        # The first of equals, so that the order of the wave decides and nothing else.
        top = int(np.argmax(marginal))
        if marginal[top] < max(1, min_gain):
            break
        chosen = left.pop(top)
        n = value.n_gaussians
        gains.append(int(coverage_gain(coverage[:n], branches[chosen].pairs[:n])))
        values.append(marginal[top])
        coverage |= branches[chosen].pairs
        accepted.append(chosen)
    return Merge(coverage, tuple(accepted), tuple(gains), tuple(values))


@dataclass(frozen=True)
class WaveState(Storable):
    """State of the exploration between two waves.

    Args:
        coverage_before: coverage by the training views, packed: N Gaussians, F frontier voxels, [N + F].
        coverage: coverage with all accepted trajectories, packed, [N + F].
        value: what newly covered pairs are worth.
        waiting: queue of anchors, the next one first.
        room: trajectories that may still be accepted.
        min_gain: worth of the pairs a trajectory must add.
        wave: branches per wave.
        branches: accepted so far.
        gains: (Gaussian, direction) pairs each of them added.
        values: worth of all pairs each of them added.
        rejected: why branches were not accepted, one sentence each.
        waves: waves finished.
        renders: images rendered by all branches, rejected ones included.
    """

    stored_as: ClassVar[str] = "state"

    coverage_before: UInt32[np.ndarray, "r"]
    coverage: UInt32[np.ndarray, "r"]
    value: PairValue
    waiting: tuple[int, ...]
    room: int
    min_gain: int
    wave: int
    branches: tuple[Branch, ...] = ()
    gains: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    rejected: tuple[str, ...] = ()
    waves: int = 0
    renders: int = 0

    def next_wave(self) -> tuple[int, ...]:
        """Anchors that grow together now; empty when the exploration is finished.

        Always different ones: two branches from one anchor and one snapshot would be the same.
        """
        if self.room == 0:
            return ()
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
        merge = merge_wave(self.coverage, branches, self.value, min_gain=self.min_gain, room=self.room)
        again, rejected = [], []
        for index, branch in enumerate(branches):
            alone = self.value.gain(self.coverage, branch.pairs)
            if index not in merge.accepted:
                left = self.value.gain(merge.coverage, branch.pairs)
                why = f"needs {self.min_gain}" if left < self.min_gain else "there was no room left"
                rejected.append(
                    f"from view {branch.anchor}: adds {left:.0f} pairs ({alone:.0f} alone), {why}; "
                    f"{branch.reason}"
                )
            if len(branch) >= 2 and alone >= max(1, self.min_gain):
                again.append(branch.anchor)
        return replace(
            self,
            coverage=merge.coverage,
            waiting=(*self.waiting[len(anchors) :], *again),
            room=self.room - len(merge.accepted),
            branches=(*self.branches, *(branches[index] for index in merge.accepted)),
            gains=(*self.gains, *merge.gains),
            values=(*self.values, *merge.values),
            rejected=(*self.rejected, *rejected),
            waves=self.waves + 1,
            renders=self.renders + sum(branch.renders for branch in branches),
        )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group, accepted branches inside."""
        with new_group(path) as group:
            write_array(group, "coverage_before", self.coverage_before)
            write_array(group, "coverage", self.coverage)
            group.attrs.update(
                {
                    "waiting": list(self.waiting),
                    "room": self.room,
                    "min_gain": self.min_gain,
                    "wave": self.wave,
                    "gains": list(self.gains),
                    "values": list(self.values),
                    "n_gaussians": self.value.n_gaussians,
                    "frontier_pair": self.value.frontier_pair,
                    "rejected": list(self.rejected),
                    "waves": self.waves,
                    "renders": self.renders,
                    "n_branches": len(self.branches),
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
            coverage_before=read_array(group, "coverage_before"),
            coverage=read_array(group, "coverage"),
            value=PairValue(attributes["n_gaussians"], attributes["frontier_pair"]),
            waiting=tuple(attributes["waiting"]),
            room=attributes["room"],
            min_gain=attributes["min_gain"],
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
