"""explore: virtual trajectories in waves of parallel branches.

`start` chooses the anchors; each `branch` is searched independently from the coverage snapshot of its wave;
`merge` accepts branches and writes the state of the next wave; `explore` collects the accepted trajectories.
`next.json` lists the anchors of the next wave, so that the flow need not read arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from extrags.config import ExploreConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

if TYPE_CHECKING:
    from extrags.exploration import SearchContext, WaveState
    from extrags.sequence import EndoscopicSequence

__all__ = ["NEXT", "branch", "explore", "merge", "start"]

NEXT = "next.json"


@stage("explore-start", version=3)
def start(slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, config: ExploreConfig) -> None:
    """Choose the anchors; writes `state/` and `next.json`."""
    from extrags.exploration import start_exploration

    context, frames = _prepared(slot, scene, sequence, freespace, config)
    _write_state(slot, start_exploration(context, frames.training_cameras))


@stage("explore-branch", version=3)
def branch(
    slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, state: Ref, anchor: int, config: ExploreConfig
) -> None:
    """Grow the branch of one anchor; writes `branch/`."""
    from extrags.exploration import WaveState, grow

    context, frames = _prepared(slot, scene, sequence, freespace, config)
    grown = grow(context, frames.training_cameras, slot.load(WaveState, state).coverage, anchor)
    slot.save(grown)
    slot.counts.update(views=len(grown), renders=grown.renders)


@stage("explore-merge", version=2)
def merge(slot: Slot, state: Ref, branches: list[Ref]) -> None:
    """Accept the branches of a wave; writes the next `state/` and `next.json`."""
    from extrags.exploration import Branch, WaveState

    before = slot.load(WaveState, state)
    _write_state(slot, before.merged([slot.load(Branch, ref) for ref in branches]))


@stage("explore", version=2)
def explore(slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, state: Ref, config: ExploreConfig) -> None:
    """Collect the accepted trajectories; writes `trajectories/` and `exploration.json`."""
    from extrags.exploration import WaveState, finish

    context, frames = _prepared(slot, scene, sequence, freespace, config)
    exploration = finish(context, slot.load(WaveState, state), frames.train)
    slot.save(exploration)
    slot.counts.update(
        trajectories=len(exploration),
        virtual_views=exploration.n_virtual,
        gain_share=round(exploration.gain_share, 5),
        renders=exploration.renders,
    )


def _prepared(
    slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, config: ExploreConfig
) -> tuple[SearchContext, EndoscopicSequence]:
    from extrags.exploration import prepare_search
    from extrags.freespace import FreeSpace
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    frames = slot.load(EndoscopicSequence, sequence)
    space = slot.load(FreeSpace, freespace)
    return prepare_search(slot.load(Scene, scene), frames.training_cameras, space, config), frames


def _write_state(slot: Slot, state: WaveState) -> None:
    slot.save(state)
    slot.save_json(NEXT, {"anchors": list(state.next_wave()), "accepted": len(state.branches)})
