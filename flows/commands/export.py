"""`export`: a reconstructed scene as PLY, a sequence as COLMAP model or `transforms.json`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, StoreError
from flows.commands.common import finished_run, run_config, set_up_logging
from flows.commands.options import Parser, add_method

if TYPE_CHECKING:
    from extrags.sequence import EndoscopicSequence

__all__ = ["add_arguments", "export"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags export`."""
    parser.description = (
        "Write a finished run's scene as PLY, or a sequence with its poses, images, masks, depth and points "
        "for COLMAP or nerfstudio. Poses that the run estimates or refines are taken from its store."
    )
    parser.set_defaults(command=export)
    parser.add_argument("sequence", metavar="SEQUENCE")
    add_method(parser)
    parser.add_argument(
        "--to",
        choices=("ply", "colmap", "colmap-text", "transforms"),
        default="ply",
        help="ply: the scene; the others: the sequence (default: ply)",
    )
    parser.add_argument(
        "--scene", choices=("final", "coarse"), default="final", help="which scene, for ply (default: final)"
    )
    parser.add_argument(
        "-o", "--output", "--out", required=True, metavar="FILE.ply|DIR", help="file, or folder to write into"
    )


def export(given: argparse.Namespace) -> int:
    """`extrags export`."""
    set_up_logging(debug=given.debug, terminal=True)
    return _scene(given) if given.to == "ply" else _sequence(given)


def _scene(given: argparse.Namespace) -> int:
    if run_config(given).uc_nerf.enabled:
        raise ConfigError(f"the method {given.method} makes no Gaussians; --to ply has nothing to write")
    run = finished_run(given, "coarse" if given.scene == "coarse" else "finetune")
    from extrags.scene import Scene

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
    from data_catalog.readers.colmap_model import points_of, write_colmap
    from data_catalog.readers.transforms_json import write_transforms

    target = Path(given.output)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"{target} exists and is not an empty folder; nothing is written over it")
    sequence = _posed_sequence(given)
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


def _posed_sequence(given: argparse.Namespace) -> EndoscopicSequence:
    """The frames with the poses and intrinsics that the scene of a run with these settings is made with.

    Where no stage changes those of the source, no run is needed.

    Raises:
        StoreError: when a stage changes them and has not run.
    """
    from data_catalog.catalog import read
    from extrags.sequence import EndoscopicSequence
    from extrags.training.reconstruction import refines_poses

    config = run_config(given)
    source = read(given.sequence, config.ingest)
    estimated = source.world_from_camera is None or config.poses.replace_given
    if not estimated and not refines_poses(source, config.coarse):
        return source
    run = finished_run(given, "poses" if config.coarse.refine_poses is False else "coarse")
    return run.store.load(EndoscopicSequence, run.refs["sequence"])
