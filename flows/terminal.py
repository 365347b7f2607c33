"""Where tables go."""

from __future__ import annotations

import sys

from rich.console import Console

__all__ = ["console"]

FILE_WIDTH = 200
"""Columns of a table that goes to a file or a pipe: nobody folds lines there."""


def console(*, error: bool = False) -> Console:
    """A console on standard output (or standard error) that does not squeeze tables in files."""
    stream = sys.stderr if error else sys.stdout
    return Console(stderr=error, width=None if stream.isatty() else FILE_WIDTH, highlight=False)
