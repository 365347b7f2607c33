"""`data list`, `data show`."""

from __future__ import annotations

import argparse

from rich.table import Table

from data_catalog.catalog import describe, list_sequences, resolve
from extrags.errors import UnknownSequenceError
from flows.commands.common import write_json
from flows.terminal import console

__all__ = ["list_all", "show"]


def list_all(given: argparse.Namespace) -> int:
    """`extrags data list`."""
    sequences = list_sequences()
    if given.json != "-":
        table = Table(box=None, pad_edge=False, header_style="bold")
        for column in ("name", "frames", "size", "here", "description"):
            table.add_column(column)
        for item in sequences:
            size = f"{item.width}x{item.height}"
            here = "yes" if item.available else "no"
            table.add_row(item.name, str(item.frames), size, here, item.description)
        console().print(table)
    write_json([item.model_dump(mode="json") for item in sequences], given.json)
    return 0


def show(given: argparse.Namespace) -> int:
    """`extrags data show`."""
    try:
        found = describe(given.sequence).model_dump(mode="json")
    except UnknownSequenceError:
        # Not in the catalogue, but perhaps a folder.
        found = resolve(given.sequence).model_dump(mode="json", exclude_none=True)
    if given.json != "-":
        table = Table(box=None, show_header=False, pad_edge=False)
        for name, value in found.items():
            table.add_row(f"[bold]{name}[/]", str(value))
        console().print(table)
    write_json(found, given.json)
    return 0
