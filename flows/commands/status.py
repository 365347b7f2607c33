"""`status`: every sequence by every stage, from the store alone."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from flows.commands.common import counted, existing_store, write_json
from flows.commands.options import Parser, add_json, add_store

if TYPE_CHECKING:
    from rich.console import JustifyMethod
    from rich.table import Table

    from flows.store_status import StoreStatus

__all__ = ["add_arguments", "size_text", "status"]

MARKS = {
    "done": "[green]✓[/]",
    "skipped": "[dim]-[/]",
    "failed": "[red]✗[/]",
    "missing": "[yellow]·[/]",
    "running": "[cyan]▶[/]",
}
PLAIN_MARKS = str.maketrans("✓✗·▶", "+x.>")
"""For terminals and files whose encoding lacks one of these."""
SHORT = 3
"""Letters of a stage's name above its column."""
LEFT, RIGHT = ("sequence", "run", "state", "ended"), ("seconds", "PSNR", "size")
LEAST_FIRST = ("ended", "size", "seconds", "PSNR")
"""What a terminal that is too narrow does not show."""


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
    from flows.store_status import store_status

    found = store_status(existing_store(given), given.patterns)
    if given.json != "-":
        _print(found)
    write_json(found.to_json(), given.json)
    return 1 if found.counts.get("failed") else 0


def _print(found: StoreStatus) -> None:
    from rich.markup import escape
    from rich.measure import Measurement
    from rich.table import Table

    from extrags.report.wording import duration
    from extrags.stages import STAGES
    from flows.terminal import console

    out = console()
    marks = MARKS
    try:
        "".join(MARKS.values()).encode(out.encoding)
    except UnicodeEncodeError:
        marks = {state: mark.translate(PLAIN_MARKS) for state, mark in MARKS.items()}
    columns: dict[str, list[str]] = {"sequence": [escape(row.sequence) for row in found.rows]}
    if any(row.variant for row in found.rows):
        columns["run"] = [escape(row.variant) for row in found.rows]
    for stage in STAGES:
        columns[stage[:SHORT]] = [
            marks[row.stages[stage].state] if stage in row.stages else "" for row in found.rows
        ]
    columns["state"] = [row.state for row in found.rows]
    columns["seconds"] = [f"{row.seconds:.0f}" if row.seconds else "" for row in found.rows]
    columns["PSNR"] = ["" if row.psnr is None else f"{row.psnr:.2f}" for row in found.rows]
    columns["size"] = [size_text(row.bytes) if row.bytes else "" for row in found.rows]
    columns["ended"] = [row.ended[:16] for row in found.rows]

    def table_of(shown: dict[str, list[str]]) -> Table:
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
        for name in shown:
            justify: JustifyMethod = "left" if name in LEFT else "right" if name in RIGHT else "center"
            table.add_column(name, justify=justify, no_wrap=True)
        for cells in zip(*shown.values(), strict=True):
            table.add_row(*cells)
        return table

    # In a narrow terminal names and stages stay; the others are in the JSON.
    unlimited = out.options.update(max_width=10_000)
    for name in LEAST_FIRST:
        if Measurement.get(out, unlimited, table_of(columns)).maximum <= out.width:
            break
        columns.pop(name)
    if Measurement.get(out, unlimited, table_of(columns)).maximum <= out.width:
        out.print(table_of(columns))
    else:
        for place, row in enumerate(found.rows):
            where = f"{row.sequence} ({row.variant})" if row.variant else row.sequence
            line = "".join(columns[stage[:SHORT]][place] or " " for stage in STAGES)
            out.print(f"{where}: {row.state}", markup=False, soft_wrap=True)
            out.print(f"  {line}")
    for row in found.rows:
        if row.reason:
            where = f"{row.sequence} ({row.variant})" if row.variant else row.sequence
            out.print(f"[red]{escape(where)} failed in {escape(row.reason)}[/]", soft_wrap=True)
    counts = ", ".join(f"{count} {state}" for state, count in found.counts.items()) or "nothing on record"
    out.print(
        f"{counted(len(found.rows), 'run')}: {counts}; "
        f"{duration(found.seconds)} in all, {size_text(found.bytes)}; "
        f"{counted(found.artefacts, 'artefact')} in {found.store}, {found.unrecorded} of them of other runs",
        soft_wrap=True,
        markup=False,
    )
    legend = "   ".join(f"{mark} {state}" for state, mark in marks.items())
    out.print(f"[dim]{legend}[/]")


def size_text(count: float) -> str:
    """Bytes as people say them: `43.8 MiB`."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
