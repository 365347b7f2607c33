"""The console that tables are printed to."""

from __future__ import annotations

import sys

from rich.console import Console

__all__ = ["console"]

FILE_WIDTH = 200
"""Width, in columns, of tables that are written to a file or a pipe."""


class _PipedConsole(Console):
    """Leaves it to the command what to do when nobody reads its output any more; rich would exit with 1."""

    def on_broken_pipe(self) -> None:
        """Raise the `BrokenPipeError` that is being handled."""
        self.quiet = True
        raise


def console(*, error: bool = False) -> Console:
    """A console on standard output (or standard error), with a fixed width for files and pipes."""
    stream = sys.stderr if error else sys.stdout
    return _PipedConsole(stderr=error, width=None if stream.isatty() else FILE_WIDTH, highlight=False)
