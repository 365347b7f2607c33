"""`devices`: what a run would do on the processor and what on a GPU, and why."""

from __future__ import annotations

import argparse

from flows.commands.common import run_config, set_up_logging, write_json
from flows.commands.options import Parser, add_json, add_method

__all__ = ["add_arguments", "devices"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags devices`."""
    parser.description = (
        "Say of each stage of a run with these settings where it would work on this machine, with which "
        "rasteriser, and why. Nothing is run. What is unavailable is refused as `extrags run` refuses it."
    )
    parser.set_defaults(command=devices)
    add_method(parser)
    add_json(parser)


def devices(given: argparse.Namespace) -> int:
    """`extrags devices`.

    Raises:
        ConfigError: for a device that is unavailable; names the setting.
    """
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    from extrags.placement import placements
    from flows.methods import METHODS

    left_out = METHODS[given.method].leave_out
    found = [item for item in placements(run_config(given)) if item.stage not in left_out]
    if given.json != "-":
        from rich.markup import escape
        from rich.table import Table

        from flows.terminal import console, print_table

        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in ("stage", "work", "device", "rasteriser", "why"):
            table.add_column(name)
        for item in found:
            table.add_row(item.stage, item.work, item.device, item.rasteriser or "-", escape(item.reason))
        print_table(console(), table)
    write_json([item.to_json() for item in found], given.json)
    return 0
