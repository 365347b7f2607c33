"""The console that tables are printed to."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from flows.printable import printable

__all__ = ["console"]

FILE_WIDTH = 200
"""Width, in columns, of tables that are written to a file or a pipe."""


class _Console(Console):
    """Shows text, whatever it holds, instead of letting the terminal obey it.

    It leaves it to the command what to do when nobody reads its output any more; rich would exit with 1.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        """As rich does."""
        return super().render_str(printable(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """As rich does; here come texts that were put together elsewhere, too."""
        for segment in super().render(renderable, options):
            shown = segment.text if segment.control else printable(segment.text)
            yield segment if shown == segment.text else Segment(shown, segment.style)

    def on_broken_pipe(self) -> None:
        """Raise the `BrokenPipeError` that is being handled."""
        self.quiet = True
        raise


def console(*, error: bool = False) -> Console:
    """A console on standard output (or standard error), with a fixed width for files and pipes."""
    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() else FILE_WIDTH
    # Without emoji: names may have `:a:` in them.
    return _Console(stderr=error, width=width, highlight=False, emoji=False)
