"""`status`: every sequence by every stage, from the store alone."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.errors import StoreError
from flows.commands.common import store_root, write_json
from flows.commands.options import Parser, add_json, add_store

if TYPE_CHECKING:
    from flows.store_status import StoreStatus

__all__ = ["add_arguments", "size_text", "status"]

MARKS = {
    "done": "[green]✓[/]",
    "skipped": "[dim]-[/]",
    "failed": "[red]✗[/]",
    "missing": "[yellow]·[/]",
    "running": "[cyan]▶[/]",
}
SHORT = 3
"""Letters of a stage's name above its column."""


def add_arguments(parser: Parser) -> None:
    """The options of `extrags status`."""
    parser.description = (
        "Show every sequence by every stage, from the store alone: what is done, missing, failed (with the "
        "reason) or being made now; how long it took, PSNR, sizes. No artefact is read."
    )
    parser.set_defaults(command=status)
    parser.add_argument(
        "patterns",
        nargs="*",
        metavar="PATTERN",
        help="names, patterns or @FILE; sequences of the catalogue are shown also if they were never run "
        "(default: all that were run)",
    )
    add_store(parser)
    add_json(parser)


def status(given: argparse.Namespace) -> int:
    """`extrags status`; exit code 1 when the last run of a sequence failed.

    Raises:
        StoreError: when there is no such store.
    """
    from extrags.store import Store
    from flows.store_status import store_status

    root = store_root(given)
    if "://" not in root and not Path(root).is_dir():
        raise StoreError(f"there is no store {root}")
    found = store_status(Store(root), given.patterns)
    if given.json != "-":
        _print(found)
    write_json(found.to_json(), given.json)
    return 1 if found.counts.get("failed") else 0


def _print(found: StoreStatus) -> None:
    from rich.markup import escape
    from rich.table import Table

    from extrags.pipeline import STAGES
    from extrags.report.wording import duration
    from flows.terminal import console

    out = console()
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    table.add_column("sequence", overflow="fold")
    table.add_column("run")
    for stage in STAGES:
        table.add_column(stage[:SHORT], justify="center", no_wrap=True)
    for column in ("state", "seconds", "PSNR", "size", "ended"):
        table.add_column(column, justify="left" if column in ("state", "ended") else "right", no_wrap=True)
    for row in found.rows:
        marks = [MARKS[row.stages[stage].state] if stage in row.stages else "" for stage in STAGES]
        psnr = "" if row.psnr is None else f"{row.psnr:.2f}"
        table.add_row(
            escape(row.sequence),
            escape(row.variant),
            *marks,
            row.state,
            f"{row.seconds:.0f}" if row.seconds else "",
            psnr,
            size_text(row.bytes) if row.bytes else "",
            row.ended[:16],
        )
    out.print(table)
    for row in found.rows:
        if row.reason:
            where = f"{row.sequence} ({row.variant})" if row.variant else row.sequence
            out.print(f"[red]{escape(where)} failed in {escape(row.reason)}[/]", soft_wrap=True)
    counts = ", ".join(f"{count} {state}" for state, count in found.counts.items()) or "nothing on record"
    took = sum(row.seconds for row in found.rows)
    out.print(
        f"{len(found.rows)} runs: {counts}; {duration(took)} in all, {size_text(found.bytes)}; "
        f"{found.artefacts} artefacts in {found.store}, {found.unrecorded} of them of other runs",
        soft_wrap=True,
    )
    legend = "   ".join(f"{mark} {state}" for state, mark in MARKS.items())
    out.print(f"[dim]{legend}[/]")


def size_text(count: float) -> str:
    """Bytes as people say them: `43.8 MiB`."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
