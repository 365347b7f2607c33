"""`evaluate`: renders made elsewhere, or a finished run, measured by the protocol."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.table import Table

from extrags.errors import ConfigError, StoreError
from extrags.store import Store
from flows.commands.common import parsed_settings, set_up_logging, store_root, write_json
from flows.environment import prepare
from flows.methods import METHODS, method_config, refuse_pinned
from flows.tables import figure, tabled
from flows.terminal import console

__all__ = ["evaluate"]

GROUPS = ("", "aligned", "observed", "unobserved", "whole")


def evaluate(given: argparse.Namespace) -> int:
    """`extrags evaluate`."""
    set_up_logging(debug=given.debug, terminal=True)
    settings = parsed_settings(given.settings)
    refuse_pinned(given.method, settings)
    config = method_config(given.method, given.profile, settings, given.seed)
    if given.renders is None and (given.depth is not None or given.depth_step is not None):
        raise ConfigError("--depth goes with --renders: it holds the depth of the same frames")
    root = store_root(given)
    prepare(Store(root).state, debug=given.debug)
    found = _finished(given, config, root) if given.renders is None else _renders(given, config, root)
    if given.json != "-":
        _print(found)
    write_json(found, given.json)
    return 0


def _renders(given: argparse.Namespace, config: Any, root: str) -> dict[str, Any]:
    """Measure a folder; the sequence comes from the store, or is read into it."""
    from extrags.metrics.folder import read_renders
    from extrags.metrics.lpips import Lpips
    from extrags.metrics.protocol import evaluate_views
    from extrags.sequence import EndoscopicSequence
    from flows.runners import DirectRunner
    from flows.wiring import SequenceRun
    from tasks.weights import lpips_weights

    run = SequenceRun(given.sequence, config, root, DirectRunner(root), given.profile)
    outcome = run.run("ingest")
    if outcome.error is not None:
        raise outcome.error
    sequence = run.store.load(EndoscopicSequence, run.refs["sequence"])
    views = read_renders(
        Path(given.renders),
        sequence,
        depth_folder=None if given.depth is None else Path(given.depth),
        depth_step_mm=given.depth_step,
    )
    weights = lpips_weights(config.evaluate)
    return evaluate_views(
        views,
        sequence,
        sequence.test,
        None if weights.path is None else Lpips.load(weights.path, net=weights.net),
        lpips_reason=weights.reason,
        surface_reason="a folder of renders holds no surface",
    ).to_json()


def _finished(given: argparse.Namespace, config: Any, root: str) -> dict[str, Any]:
    """The figures of a run that is in the store."""
    from flows.runners import NotInStoreError, StoreRunner
    from flows.wiring import SequenceRun
    from tasks.evaluate import METRICS_FILE

    run = SequenceRun(
        given.sequence,
        config,
        root,
        StoreRunner(root),
        given.profile,
        leave_out=METHODS[given.method].leave_out,
    )
    try:
        outcome = run.run("evaluate")
    except NotInStoreError as error:
        raise StoreError(
            f"{given.sequence} with these settings is not finished in {root}; run it first, or name a folder "
            f"with --renders ({error})"
        ) from error
    if outcome.error is not None:
        raise outcome.error
    ref = outcome.final_metrics
    if ref is None:
        raise ConfigError(f"{outcome.name} has no held-out frames to evaluate on")
    found: dict[str, Any] = run.store.load_json(METRICS_FILE, ref)
    return found


def _print(found: dict[str, Any]) -> None:
    out = console()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("pixels", *tabled()):
        table.add_column(column)
    metrics = found["metrics"]
    for group in GROUPS:
        tree = metrics[group] if group else metrics
        table.add_row(group or "valid", *(figure(name, tree.get(name)) for name in tabled()))
    out.print(table)
    surface = {name: value for name, value in metrics["surface"].items() if isinstance(value, float)}
    if surface:
        out.print("surface: " + ", ".join(f"{name} {value:.3f}" for name, value in surface.items()))
    for name, reason in found["reasons"].items():
        out.print(f"[dim]no {name}: {reason}[/]", soft_wrap=True)
    out.print(f"{found['sequence']}: {found['n_views']} views, protocol {found['protocol']}")
