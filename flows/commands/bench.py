"""`bench raster`, `bench train`, `bench pipeline`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from rich.table import Table

from extrags.store import Store
from flows.commands.common import parsed_settings, set_up_logging, store_root, write_json
from flows.environment import prepare, without_heartbeat
from flows.terminal import console

__all__ = ["pipeline", "raster", "train"]


def raster(given: argparse.Namespace) -> int:
    """`extrags bench raster`."""
    set_up_logging(debug=given.debug, terminal=True)
    from extrags.raster.bench import bench_raster

    return _kernels(given, bench_raster(quick=given.quick, threads=given.threads))


def train(given: argparse.Namespace) -> int:
    """`extrags bench train`."""
    set_up_logging(debug=given.debug, terminal=True)
    from extrags.raster.bench import bench_train

    return _kernels(given, bench_train(quick=given.quick, threads=given.threads))


def pipeline(given: argparse.Namespace) -> int:
    """`extrags bench pipeline`."""
    terminal = sys.stderr.isatty()
    set_up_logging(debug=given.debug, terminal=terminal)
    root = store_root(given)
    settings = parsed_settings(given.settings)
    prepare(Store(root).state, debug=given.debug)
    from flows.benchmark import benchmark
    from flows.console import watched
    from flows.settings import task_runner

    with without_heartbeat(), watched(terminal=terminal):
        found = benchmark.with_options(task_runner=task_runner(given.runner))(
            sequences=given.sequences,
            profiles=given.profiles,
            methods=given.methods,
            seeds=given.seeds,
            settings=settings,
            store=root,
        )
    if given.json != "-":
        names = ("sequence", "setting", "profile", "method", "seed", "seconds", "peak_mib")
        rows = [[case[name] for name in names] for case in found["cases"]]
        shown = ("psnr", "ssim", "lpips_alex", "depth_absrel")
        for row, case in zip(rows, found["cases"], strict=True):
            row += [(case["metrics"] or {}).get(name) for name in shown]
        _print([*names, *shown], rows)
    write_json(found, given.json)
    return 0


def _kernels(given: argparse.Namespace, found: dict[str, Any]) -> int:
    if given.json != "-":
        names = ("width", "height", "n_gaussians", "backend", "threads")
        times = ("forward", "backward", "iteration")
        rows = [
            [*(case[name] for name in names), *(case["ms"].get(name) for name in times)]
            for case in found["cases"]
        ]
        _print([*names, *(f"{name} ms" for name in times)], rows)
    write_json(found, given.json)
    return 0


def _print(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in header:
        table.add_column(name)
    for row in rows:
        table.add_row(*(_text(value) for value in row))
    console().print(table)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
