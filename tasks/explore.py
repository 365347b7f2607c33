"""explore: virtual trajectories in waves of parallel branches.

`start` measures the scene and chooses the anchors; each `branch` is searched independently from the coverage
snapshot of its wave; `merge` accepts branches and writes the state of the next wave; `explore` collects the
accepted trajectories. The manifest of
a state names the anchors of the next wave (`next_anchors`), so that the flow need not read arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from extrags.config import ExploreConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

if TYPE_CHECKING:
    from extrags.exploration import SearchContext, WaveState

__all__ = ["branch", "explore", "merge", "next_anchors", "start"]

NEXT_ANCHORS = "next_anchors"


@stage("explore-start", version=8)
def start(slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, config: ExploreConfig) -> None:
    """Measure the scene and choose the anchors; writes `search/` and `state/`."""
    from extrags.exploration import prepare_search, start_exploration
    from extrags.freespace import FreeSpace
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    frames = slot.load(EndoscopicSequence, sequence)
    context = prepare_search(
        slot.load(Scene, scene),
        frames.training_cameras,
        slot.load(FreeSpace, freespace),
        config,
        masks=frames.training_masks,
    )
    slot.save(context.measured)
    _write_state(slot, start_exploration(context))
    slot.counts.update(renders=context.measured.renders)


@stage("explore-branch", version=6)
def branch(
    slot: Slot, scene: Ref, freespace: Ref, search: Ref, state: Ref, anchor: int, config: ExploreConfig
) -> None:
    """Grow the branch of one anchor; writes `branch/`."""
    from extrags.exploration import WaveState, grow

    context = _prepared(slot, scene, freespace, search, config)
    grown = grow(context, slot.load(WaveState, state).known, anchor)
    slot.save(grown)
    slot.counts.update(views=len(grown), renders=grown.renders)


@stage("explore-merge", version=4)
def merge(slot: Slot, state: Ref, branches: list[Ref]) -> None:
    """Accept the branches of a wave; writes the next `state/`."""
    from extrags.exploration import Branch, WaveState

    before = slot.load(WaveState, state)
    _write_state(slot, before.merged([slot.load(Branch, ref) for ref in branches]))


@stage("explore", version=4)
def explore(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    freespace: Ref,
    search: Ref,
    state: Ref,
    config: ExploreConfig,
) -> None:
    """Collect the accepted trajectories; writes `trajectories/` and `exploration.json`."""
    from extrags.exploration import WaveState, finish
    from extrags.sequence import EndoscopicSequence

    context = _prepared(slot, scene, freespace, search, config)
    train = slot.load(EndoscopicSequence, sequence).train
    exploration = finish(context, slot.load(WaveState, state), train)
    slot.save(exploration)
    slot.counts.update(
        trajectories=len(exploration),
        virtual_views=exploration.n_virtual,
        gain_share=round(exploration.gain_share, 5),
        renders=exploration.renders,
    )


def _prepared(slot: Slot, scene: Ref, freespace: Ref, search: Ref, config: ExploreConfig) -> SearchContext:
    from extrags.exploration import SceneMeasurements, prepare_search
    from extrags.freespace import FreeSpace
    from extrags.scene import Scene

    measured = slot.load(SceneMeasurements, search)
    space = slot.load(FreeSpace, freespace)
    return prepare_search(slot.load(Scene, scene), measured.training, space, config, measured)


def _write_state(slot: Slot, state: WaveState) -> None:
    slot.save(state)
    anchors = " ".join(str(anchor) for anchor in state.next_wave())
    slot.counts.update({NEXT_ANCHORS: anchors, "accepted": len(state.branches)})


def next_anchors(counts: Mapping[str, float | int | str | None]) -> list[int]:
    """Anchors that grow together next, by the counts in the manifest of a state; none: it is the last."""
    return [int(anchor) for anchor in str(counts[NEXT_ANCHORS] or "").split()]
