"""`bench stability`: every part of the computation at the edges of what it can be given."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from flows.commands.common import items, set_up_logging, write_json
from flows.commands.options import Parser, add_json
from flows.commands.outputs import output_file

__all__ = ["EXAMPLES", "add_arguments", "stability"]

EXAMPLES = """examples:
  --rows 'lit step' --scenes 10000
  --rows 'TSDF/*' 'carving/*' --json -
  --rows training --iterations 15000 --figure drift.svg

A row is PART/CASE; a pattern matches it as file names are matched, or its part alone.
A row passes where its worst value is at most the limit. An error that names its cause counts as finite."""


def add_arguments(parser: Parser) -> None:
    """Options of `extrags bench stability`."""
    parser.description = (
        "Run every part of the computation on inputs at the edges of what it can be given, compare with "
        "float64 and with what must not change, and report the worst case of each. Exit code 1 if a row "
        "fails."
    )
    parser.add_argument(
        "--rows", nargs="+", default=["*"], metavar="PATTERN", help="these rows only (default: all)"
    )
    whole: dict[str, Any] = {"type": int, "metavar": "N"}
    parser.add_argument(
        "--scenes", default=200, **whole, help="random scenes of each row that draws them (default: 200)"
    )
    parser.add_argument(
        "--iterations",
        default=1000,
        **whole,
        help="of the longest training and of Adam; 1000, 5000 and 15000 are told apart (default: 1000)",
    )
    parser.add_argument(
        "--gaussians",
        default=100_000,
        **whole,
        help="of the largest scene, at most 1000000 (default: 100000)",
    )
    parser.add_argument("--threads", default=1, **whole, help="threads of kernels and torch (default: 1)")
    parser.add_argument(
        "--figure",
        metavar="FILE",
        type=output_file,
        help="also draw the drift of the trainings (.svg, .png, .pdf)",
    )
    add_json(parser)


def stability(given: argparse.Namespace) -> int:
    """`extrags bench stability`."""
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    if given.threads < 1:
        raise ConfigError(f"--threads {given.threads}: expected 1 or more")
    # Read when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from extrags.raster.bench import machine
    from extrags.raster.native import missing_kernels_error, native_isa
    from extrags.stress import ROWS, Effort, run_rows
    from extrags.stress.rows import with_threads

    if native_isa() is None:
        raise ConfigError(str(missing_kernels_error()))
    effort = Effort(given.scenes, given.iterations, given.gaussians)
    quiet = given.json == "-"
    rows = with_threads(
        given.threads, lambda: run_rows(ROWS, items(given.rows), effort, None if quiet else _tell)
    )
    if not quiet:
        _print_table(rows)
    write_json({"machine": machine(), "effort": vars(effort), "rows": rows}, given.json)
    if given.figure is not None:
        from extrags.stress.drift_plot import write_drift_plot
        from extrags.stress.optimiser import training_drift

        drifts = {
            name: training_drift(given.iterations, lit=lit) for name, lit in (("unlit", False), ("lit", True))
        }
        write_drift_plot(drifts, Path(given.figure))
    return 0 if all(row["passed"] for row in rows) else 1


def _tell(row: dict[str, Any]) -> None:
    from flows.terminal import console

    ended = "passes" if row["passed"] else f"FAILS at {row['where']}"
    console(error=True).print(
        f"{row['part']}/{row['case']}: {ended}, {row['seconds']:.1f} s", soft_wrap=True, markup=False
    )


def _print_table(rows: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from flows.terminal import console, print_table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("part", "case", "measured", "worst", "limit", "pass", "where", "trials", "s"):
        table.add_column(name)
    for row in rows:
        worst = "not finite" if row["worst"] is None else f"{row['worst']:.3g}"
        table.add_row(
            row["part"],
            row["case"],
            row["measured"],
            worst,
            f"{row['limit']:.3g}",
            "yes" if row["passed"] else "NO",
            # Errors quote shapes and values, which are no markup.
            escape(row["note"] or row["where"]),
            str(row["trials"]),
            f"{row['seconds']:.1f}",
        )
    print_table(console(), table)
    failed = sum(not row["passed"] for row in rows)
    console().print(f"{len(rows)} rows, {failed} of them fail" if failed else f"all {len(rows)} rows pass")
