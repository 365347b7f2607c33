"""A coarse scene that goes on from the nearest one in the store, or why it starts anew."""

from __future__ import annotations

import logging

from extrags.config import PipelineConfig
from extrags.store import Ref, Store
from flows.runners import Call
from tasks.coarse import coarse
from tasks.continuation import Earlier, continued_coarse, found_whole, made_before, nearest_scene
from tasks.stage import stage_key

__all__ = ["coarse_call"]

log = logging.getLogger(__name__)


def coarse_call(
    config: PipelineConfig, store: Store, name: str, frames: Ref, device: str, *, refresh: bool = False
) -> tuple[Call, str]:
    """The task that makes the coarse scene, with `continuation.scene` nearest.

    What the store holds of these very frames already is taken, so that a run that is repeated finds its own:
    first a scene that went on from another one, then one that started anew.

    Args:
        config: settings of all stages.
        store: where earlier scenes are.
        name: of the sequence.
        frames: the training frames.
        device: where it is optimised.
        refresh: whether what is in the store is made anew.

    Returns:
        The call, and why it starts anew; empty where it goes on from an earlier scene.
    """
    # Not above: it loads torch, which what only looks into a store does not need.
    from extrags.training.continuing import continued_iterations

    total = int(store.manifest(frames).counts["frames"] or 0)
    anew = Call(coarse, {"sequence": frames, "config": config.coarse, "device": device})

    def iterations(earlier: Earlier) -> int:
        return continued_iterations(config.continuation, config.coarse.iterations, len(earlier.frames), total)

    def continued(earlier: Earlier) -> Call:
        inputs = {
            **anew.inputs,
            "earlier": earlier.scene,
            "frames": earlier.frames,
            "iterations": iterations(earlier),
        }
        return Call(continued_coarse, inputs)

    for earlier, made_with in made_before(store, frames, config.coarse, device, refresh=refresh):
        if made_with == iterations(earlier):
            return continued(earlier), ""
    if found_whole(store, stage_key(coarse, anew.inputs)) is not None:
        return anew, "started anew: this scene is in the store already"
    search = nearest_scene(store, name, frames, config.coarse)
    for key, why in search.refusals.items():
        log.debug("%s: cannot continue from %s: %s", name, key, why)
    if search.found is None:
        reason = f"started anew, no earlier scene to continue from: {search.told()}"
        log.info("%s: %s", name, reason)
        return anew, reason
    shared = len(search.found.frames)
    log.info("%s: continued from %s, %d of %d training frames", name, search.found.key, shared, total)
    return continued(search.found), ""
