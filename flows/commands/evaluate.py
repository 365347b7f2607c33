"""`evaluate`: renders made elsewhere, or a finished run, measured by the protocol."""

from __future__ import annotations

import argparse
import logging
from contextlib import suppress
from typing import Any

from extrags.errors import ConfigError
from extrags.user_paths import expanded
from flows.commands.common import (
    counted,
    finished_run,
    run_config,
    set_up_logging,
    store_root,
    write_json,
)
from flows.commands.options import Parser, add_json, add_method, add_sequence
from flows.commands.run_checks import check_names

__all__ = ["add_arguments", "evaluate"]

logger = logging.getLogger(__name__)

GROUPS = ("", "aligned", "observed", "unobserved", "whole")


def add_arguments(parser: Parser) -> None:
    """The options of `extrags evaluate`."""
    parser.description = (
        "Measure a folder of renders of the held-out frames by the protocol of extrags/metrics/PROTOCOL.md; "
        "without --renders, show the figures of a run that is in the store."
    )
    parser.set_defaults(command=evaluate)
    add_sequence(parser)
    parser.add_argument(
        "--renders",
        metavar="FOLDER",
        help="8-bit images of the sequence's size, named after the held-out frames, in their folders where "
        "names alone do not tell them apart, or numbered in order",
    )
    parser.add_argument(
        "--depth", metavar="FOLDER", help="z-depth of the same frames: .npy, or 16-bit PNG or TIFF; 0: none"
    )
    parser.add_argument(
        "--depth-step", type=float, metavar="MM", help="depth of one level of an integer depth image"
    )
    add_method(parser)
    add_json(parser)


def evaluate(given: argparse.Namespace) -> int:
    """`extrags evaluate`."""
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    if given.depth is None and given.depth_step is not None:
        raise ConfigError("--depth-step goes with --depth: without it there is no depth to measure")
    if given.renders is None and given.depth is not None:
        raise ConfigError("--depth goes with --renders: it holds the depth of the same frames")
    found = _finished(given) if given.renders is None else _renders(given)
    if given.json != "-":
        _print(found)
    write_json(found, given.json)
    return 0


def _renders(given: argparse.Namespace) -> dict[str, Any]:
    """Measure a folder; the sequence comes from the store, or is read into it.

    Where the store has poses that were estimated with these settings, frames are those that a run measures:
    without the ones that got no pose, and as the estimated lens makes them.
    """
    from extrags.store import Store
    from flows.environment import prepare

    root, config = store_root(given), run_config(given)
    # A misspelled name leaves no store behind.
    check_names([given.sequence])
    prepare(Store(root).state, debug=given.debug, looks=True)
    from extrags.metrics.folder import read_renders
    from extrags.metrics.protocol import evaluate_views
    from extrags.sequence import EndoscopicSequence
    from flows.methods import METHODS
    from flows.runners import DirectRunner, NotInStoreError, StoreRunner
    from flows.wiring import SequenceRun
    from tasks.weights import lpips_by_net, lpips_weights

    left_out = METHODS[given.method].leave_out
    run = SequenceRun(given.sequence, config, root, DirectRunner(root), given.profile, leave_out=left_out)
    outcome = run.run("ingest")
    if outcome.error is not None:
        raise outcome.error
    sequence = run.store.load(EndoscopicSequence, run.refs["sequence"])
    held_out: list[str] = []
    without_pose: tuple[str, ...] = ()
    lookup = StoreRunner(root)
    known = SequenceRun(given.sequence, config, root, lookup, given.profile, leave_out=left_out)
    with suppress(NotInStoreError):
        if known.run("poses").error is None and "poses" in known.refs:
            read, sequence = sequence, known.store.load(EndoscopicSequence, known.refs["poses"])
            held_out = [read.frame_name(int(frame)) for frame in read.test]
            left = {sequence.frame_name(int(frame)) for frame in sequence.test}
            without_pose = tuple(name for name in held_out if name not in left)
    if without_pose:
        from extrags.poses.registration_report import named_frames

        logger.warning(
            "%s: %d of %d held-out frames have no estimated pose and are not measured: %s",
            given.sequence,
            len(without_pose),
            len(without_pose) + len(sequence.test),
            named_frames(without_pose, held_out),
        )
    views = read_renders(
        expanded(given.renders),
        sequence,
        depth_folder=None if given.depth is None else expanded(given.depth),
        depth_step_mm=given.depth_step,
        not_measured=without_pose,
    )
    return evaluate_views(
        views,
        sequence,
        sequence.test,
        lpips_by_net(lpips_weights(config.evaluate)),
        surface_reason="a folder of renders holds no surface",
    ).to_json()


def _finished(given: argparse.Namespace) -> dict[str, Any]:
    """The figures of a run that is in the store."""
    run = finished_run(given, "evaluate", ", or name a folder with --renders")
    from tasks.evaluate import METRICS_FILE

    ref = run.outcome.final_metrics
    if ref is None:
        raise ConfigError(f"{given.sequence} has no held-out frames to evaluate on")
    found: dict[str, Any] = run.store.load_json(METRICS_FILE, ref)
    return found


def _print(found: dict[str, Any]) -> None:
    from rich.table import Table

    from flows.tables import figure, table_figures
    from flows.terminal import console, print_table

    out = console()
    table = Table(box=None, pad_edge=False, header_style="bold")
    metrics = found["metrics"]
    # Its rows are the groups, which a figure of one group has in its name.
    columns = [name for name in table_figures(metrics) if "." not in name]
    for column in ("pixels", *columns):
        table.add_column(column)
    for group in GROUPS:
        tree = metrics[group] if group else metrics
        table.add_row(group or "valid", *(figure(name, tree.get(name)) for name in columns))
    print_table(out, table)
    surface = {name: value for name, value in metrics["surface"].items() if isinstance(value, float)}
    if surface:
        out.print("surface: " + ", ".join(f"{name} {value:.3f}" for name, value in surface.items()))
    for name, reason in found["reasons"].items():
        out.print(f"no {name}: {reason}", soft_wrap=True, style="dim", markup=False)
    told = f"{found['sequence']}: {counted(found['n_views'], 'view')}, protocol {found['protocol']}"
    out.print(told, markup=False)
