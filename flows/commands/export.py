"""`export`: a reconstructed scene as PLY."""

from __future__ import annotations

import argparse
from pathlib import Path

from extrags.errors import StoreError
from extrags.store import Store
from flows.commands.common import parsed_settings, set_up_logging, store_root
from flows.environment import prepare
from flows.settings import pipeline_config

__all__ = ["export"]


def export(given: argparse.Namespace) -> int:
    """`extrags export`."""
    set_up_logging(debug=given.debug, terminal=True)
    root = store_root(given)
    prepare(Store(root).state, debug=given.debug)
    from extrags.scene import Scene
    from flows.runners import NotInStoreError, StoreRunner
    from flows.wiring import SequenceRun

    config = pipeline_config(given.profile, parsed_settings(given.settings), given.seed)
    sequence = SequenceRun(given.sequence, config, root, StoreRunner(root), given.profile)
    try:
        outcome = sequence.run("coarse" if given.scene == "coarse" else "finetune")
    except NotInStoreError as error:
        raise StoreError(
            f"{given.sequence} with these settings is not finished in {root}; run it first ({error})"
        ) from error
    if outcome.error is not None:
        raise outcome.error
    # Where the plan left fine-tuning out, the coarse scene is the final one.
    ref = sequence.refs.get("finetune", sequence.refs["coarse"])
    scene = Scene.load(sequence.store.open(ref) / "scene")
    target = Path(given.output)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scene.gaussians.write_ply(target)
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {error.strerror or error}") from error
    print(f"{target}: {len(scene.gaussians)} Gaussians")
    return 0
