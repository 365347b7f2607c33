"""The console that tables are printed to."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Any, Self

from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from flows.printable import in_one_line, printable

__all__ = ["TerminalConsole", "console", "print_table"]

FILE_WIDTH = 200
"""Width, in columns, of tables that are written to a file or a pipe."""


class TerminalConsole(Console):
    """Shows text, whatever it holds, instead of letting the terminal obey it.

    It leaves it to the command what to do when nobody reads its output any more; rich would exit with 1.
    """

    turn: AbstractContextManager[object] = nullcontext()
    """Held while something is printed. A live display, which must not be moved between looking where it
    stands and drawing it, sets a lock that may be taken again, and holds it whenever it draws."""

    def __enter__(self) -> Self:
        """As rich does: what is printed is written where the outermost of these blocks ends."""
        self.turn.__enter__()
        super().__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """As rich does."""
        try:
            super().__exit__(kind, error, trace)
        finally:
            self.turn.__exit__(kind, error, trace)

    def render_str(self, text: str, **options: Any) -> Text:
        """As rich does, in one line: a line feed in a name would begin a row of a table that is none."""
        return super().render_str(in_one_line(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """As rich does; here come texts that were put together elsewhere, too."""
        for segment in super().render(renderable, options):
            shown = segment.text if segment.control else printable(segment.text)
            yield segment if shown == segment.text else Segment(shown, segment.style)

    def on_broken_pipe(self) -> None:
        """Raise the `BrokenPipeError` that is being handled."""
        self.quiet = True
        raise


def console(*, error: bool = False) -> TerminalConsole:
    """A console on standard output (or standard error), with a fixed width for files and pipes."""
    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() else FILE_WIDTH
    # Without emoji: names may have `:a:` in them.
    return TerminalConsole(stderr=error, width=width, highlight=False, emoji=False)


def print_table(out: Console, table: Table) -> None:
    """Print a table; where the terminal is too narrow for its words, each row as a line with all cells.

    rich shortens names with an ellipsis there, or leaves columns out; names and keys are there to be copied.

    Args:
        out: where to.
        table: the first column names the row.
    """
    needed = Measurement.get(out, out.options.update(max_width=10_000), table).minimum
    if needed <= out.width:
        out.print(table)
        return
    if table.title:
        out.print(table.title, soft_wrap=True)
    heads = [str(column.header) for column in table.columns]
    for name, *cells in zip(*(column.cells for column in table.columns), strict=True):
        told = ", ".join(f"{head} {cell}" for head, cell in zip(heads[1:], cells, strict=True) if cell)
        out.print(f"{name}: {told}" if told else name, soft_wrap=True)
