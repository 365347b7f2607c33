"""`export`: a reconstructed scene as PLY, a sequence as COLMAP model or `transforms.json`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.config import PipelineConfig
from extrags.errors import ConfigError, StoreError
from extrags.pipeline import StageName
from extrags.store import Store
from flows.commands.common import parsed_settings, set_up_logging, store_root
from flows.environment import prepare
from flows.methods import METHODS, method_config, refuse_pinned

if TYPE_CHECKING:
    from flows.wiring import SequenceRun

__all__ = ["export"]


def export(given: argparse.Namespace) -> int:
    """`extrags export`."""
    set_up_logging(debug=given.debug, terminal=True)
    return _scene(given) if given.to == "ply" else _sequence(given)


def _scene(given: argparse.Namespace) -> int:
    from extrags.scene import Scene

    run = _from_store(given, "coarse" if given.scene == "coarse" else "finetune")
    # Where the plan left fine-tuning out, the coarse scene is the final one.
    ref = run.refs.get("finetune", run.refs["coarse"])
    scene = run.store.load(Scene, ref)
    target = Path(given.output)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scene.gaussians.write_ply(target)
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {error.strerror or error}") from error
    print(f"{target}: {len(scene.gaussians)} Gaussians")
    return 0


def _sequence(given: argparse.Namespace) -> int:
    from data_catalog.catalog import read
    from data_catalog.colmap_model import points_of, write_colmap
    from data_catalog.transforms_json import write_transforms
    from extrags.sequence import EndoscopicSequence

    target = Path(given.output)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"{target} exists and is not an empty folder; nothing is written over it")
    sequence = read(given.sequence, _config(given).ingest)
    if sequence.world_from_camera is None:
        # Poses of a source that has none come from its run.
        run = _from_store(given, "poses")
        sequence = run.store.load(EndoscopicSequence, run.refs["poses"])
    found = points_of(sequence)
    points, points_rgb = found if found is not None else (None, None)
    try:
        target.mkdir(parents=True, exist_ok=True)
        if given.to == "transforms":
            write_transforms(sequence, target, points=points, points_rgb=points_rgb)
        else:
            write_colmap(sequence, target, binary=given.to == "colmap", points=points, points_rgb=points_rgb)
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {error.strerror or error}") from error
    count = 0 if points is None else len(points)
    print(f"{target}: {len(sequence)} frames with poses, {count} points")
    return 0


def _config(given: argparse.Namespace) -> PipelineConfig:
    settings = parsed_settings(given.settings)
    refuse_pinned(given.method, settings)
    return method_config(given.method, given.profile, settings, given.seed)


def _from_store(given: argparse.Namespace, until: StageName) -> SequenceRun:
    """A finished run's refs.

    Raises:
        StoreError: when the stage is not in the store.
    """
    root = store_root(given)
    prepare(Store(root).state, debug=given.debug)
    from flows.runners import NotInStoreError, StoreRunner
    from flows.wiring import SequenceRun

    sequence = SequenceRun(
        given.sequence,
        _config(given),
        root,
        StoreRunner(root),
        given.profile,
        leave_out=METHODS[given.method].leave_out,
    )
    try:
        outcome = sequence.run(until)
    except NotInStoreError as error:
        raise StoreError(
            f"{given.sequence} with these settings is not finished in {root}; run it first ({error})"
        ) from error
    if outcome.error is not None:
        raise outcome.error
    return sequence
