"""`leaderboard`: sequences by methods, from the records of a store."""

from __future__ import annotations

import argparse

from extrags.errors import StoreError
from flows.commands.common import existing_store, set_up_logging, write_page
from flows.commands.options import Parser, add_output, add_store
from flows.commands.outputs import output_file

__all__ = ["add_arguments", "leaderboard"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags leaderboard`."""
    parser.description = (
        "Make a page of sequences by methods, to be sorted and filtered, from the last run of each sequence, "
        "method, profile and seed that the store has on record. No artefact is read."
    )
    parser.set_defaults(command=leaderboard)
    parser.add_argument(
        "patterns", nargs="*", metavar="PATTERN", help="sequences, with * and ? (default: all on record)"
    )
    add_store(parser)
    parser.add_argument("--name", default="Leaderboard", help="title of the page (default: %(default)s)")
    add_output(
        parser, "FILE", output_file, default="leaderboard.html", help="the page (default: %(default)s)"
    )


def leaderboard(given: argparse.Namespace) -> int:
    """`extrags leaderboard`.

    Raises:
        StoreError: when there is no such store, no run of one of the patterns, or the page cannot be written.
    """
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    store = existing_store(given)
    from extrags.report.leaderboard import build_leaderboard
    from flows.recorded_runs import board_rows, nearest_on_record

    rows = board_rows(store, given.patterns, given.output)
    # One by one: a page without a sequence that was asked for would pass for one with all of them.
    absent = [pattern for pattern in given.patterns if not board_rows(store, [pattern])]
    if absent or not rows:
        wanted = f" of {', '.join(absent)}" if absent else ""
        near = nearest_on_record(store, absent)
        raise StoreError(f"no run{wanted} is on record in {store.root}{near}")
    print(write_page(build_leaderboard(rows, name=given.name), given.output))
    return 0
