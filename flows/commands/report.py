"""`report`: the page of a finished run, built again."""

from __future__ import annotations

import argparse
import shutil

from extrags.errors import StoreError
from flows.commands.common import finished_run, set_up_logging
from flows.commands.options import Parser, add_method, add_output, add_sequence

__all__ = ["add_arguments", "report"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags report`."""
    parser.set_defaults(command=report)
    add_sequence(parser)
    add_method(parser)
    add_output(parser, "FILE", help="also write the page to this file")


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
        try:
            shutil.copyfile(page, given.output)
        except OSError as error:
            raise StoreError(f"{given.output} cannot be written: {error.strerror or error}") from error
    print(given.output or page)
    return 0
