"""`report`: the page of a finished run, built again."""

from __future__ import annotations

import argparse

from flows.commands.common import finished_run, set_up_logging
from flows.commands.options import Parser, add_method, add_output, add_sequence
from flows.commands.outputs import output_file, write_output

__all__ = ["add_arguments", "report"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags report`."""
    parser.set_defaults(command=report)
    add_sequence(parser)
    add_method(parser)
    add_output(parser, "FILE", output_file, help="also write the page to this file")


def report(given: argparse.Namespace) -> int:
    """`extrags report`: from what is in the store, without running anything else.

    The page keeps the times of the run that made what it shows.
    """
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    run = finished_run(given, "evaluate")
    from flows.runners import DirectRunner
    from tasks.report import PAGE

    run.runner = DirectRunner(run.store.root, refresh=True)
    run.report_again()
    page = run.store.open(run.refs["report"]) / PAGE
    if given.output:
        write_output(given.output, page.read_bytes())
    print(given.output or page)
    return 0
