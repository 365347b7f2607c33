"""explore: virtual trajectories in waves of parallel branches.

`start` lays out the anchors; each `branch` grows alone from the coverage snapshot of its wave; `merge`
accepts branches and leaves the next wave's state; `explore` collects what was accepted. `next.json`
tells the flow which anchors grow next, so that it need not open arrays.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from extrags.config import ExploreConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

if TYPE_CHECKING:
    from extrags.cameras import Cameras
    from extrags.exploration import SearchContext, WaveState
    from extrags.sequence import EndoscopicSequence

__all__ = ["NEXT", "branch", "explore", "merge", "start"]

NEXT = "next.json"


@stage("explore-start", version=2)
def start(slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, config: ExploreConfig) -> None:
    """Choose the anchors; writes `state/` and `next.json`."""
    from extrags.exploration import start_exploration

    context, cameras, _ = _prepared(slot, scene, sequence, freespace, config)
    _write_state(slot, start_exploration(context, cameras))


@stage("explore-branch", version=2)
def branch(
    slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, state: Ref, anchor: int, config: ExploreConfig
) -> None:
    """Grow the branch of one anchor; writes `branch/`."""
    from extrags.exploration import WaveState, grow

    context, cameras, _ = _prepared(slot, scene, sequence, freespace, config)
    grown = grow(context, cameras, WaveState.load(slot.open(state) / "state").coverage, anchor)
    grown.save(slot.path / "branch")
    slot.counts.update(views=len(grown), renders=grown.renders)


@stage("explore-merge", version=1)
def merge(slot: Slot, state: Ref, branches: list[Ref]) -> None:
    """Accept the branches of a wave; writes the next `state/` and `next.json`."""
    from extrags.exploration import Branch, WaveState

    before = WaveState.load(slot.open(state) / "state")
    _write_state(slot, before.merged([Branch.load(slot.open(ref) / "branch") for ref in branches]))


@stage("explore", version=1)
def explore(slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, state: Ref, config: ExploreConfig) -> None:
    """Collect the accepted trajectories; writes `trajectories/` and `exploration.json`."""
    from extrags.exploration import WaveState, finish

    context, _, posed = _prepared(slot, scene, sequence, freespace, config)
    exploration = finish(context, WaveState.load(slot.open(state) / "state"), posed.train)
    exploration.save(slot.path)
    slot.counts.update(
        trajectories=len(exploration),
        virtual_views=exploration.n_virtual,
        gain_share=round(exploration.gain_share, 5),
        renders=exploration.renders,
    )


def _prepared(
    slot: Slot, scene: Ref, sequence: Ref, freespace: Ref, config: ExploreConfig
) -> tuple[SearchContext, Cameras, EndoscopicSequence]:
    from extrags.exploration import prepare_search
    from extrags.freespace import FreeSpace
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    posed = EndoscopicSequence.load(slot.open(sequence) / "sequence")
    cameras = posed.cameras[posed.train]
    context = prepare_search(
        Scene.load(slot.open(scene) / "scene"),
        cameras,
        FreeSpace.load(slot.open(freespace) / "freespace"),
        config,
    )
    return context, cameras, posed


def _write_state(slot: Slot, state: WaveState) -> None:
    state.save(slot.path / "state")
    anchors = list(state.next_wave())
    (slot.path / NEXT).write_text(json.dumps({"anchors": anchors, "accepted": len(state.branches)}))
