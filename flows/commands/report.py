"""`report`: the page of a finished run, built again."""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from extrags.errors import StoreError
from flows.commands.common import finished_run, set_up_logging
from flows.commands.options import Parser, add_method, add_output, add_sequence
from flows.commands.outputs import output_file, write_output

if TYPE_CHECKING:
    from extrags.store import Store

__all__ = ["add_arguments", "report"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags report`."""
    parser.set_defaults(command=report)
    add_sequence(parser)
    add_method(parser)
    add_output(parser, "FILE", output_file, help="also write the page to this file")


def report(given: argparse.Namespace) -> int:
    """`extrags report`: from what is in the store, without running anything else.

    The page keeps the times of the run that made what it shows. Where the store cannot be written, `--output`
    alone is.

    Raises:
        StoreError: when the run is not finished, or neither the store nor the output can be written.
    """
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    run = finished_run(given, "evaluate")
    from flows.runners import DirectRunner
    from tasks.report import PAGE

    if given.output and not _writable(run.store):
        with TemporaryDirectory(prefix="extrags-") as folder:
            write_output(given.output, run.report_elsewhere(Path(folder)).read_bytes())
        print(given.output)
        return 0
    run.runner = DirectRunner(run.store.root, refresh=True)
    run.report_again()
    page = run.store.open(run.refs["report"]) / PAGE
    if given.output:
        write_output(given.output, page.read_bytes())
    print(given.output or page)
    return 0


def _writable(store: Store) -> bool:
    try:
        store.check_writable()
    except StoreError:
        return False
    return True
