"""Text for a terminal: names in files of others can hold what a terminal obeys instead of showing it."""

from __future__ import annotations

import logging
import re
from copy import copy
from pathlib import PurePath

from extrags.errors import ExtragsError
from extrags.escaped_text import escaped

__all__ = ["PrintableFormatter", "in_one_line", "printable"]

_OBEYED = re.compile(
    # Control characters but for tab and line feed; marks that turn the direction in which text is read.
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]"
)


def printable(text: str) -> str:
    r"""The text with `\x1b`, as Python writes it, in place of each character that a terminal would obey."""
    return escaped(text, _OBEYED)


def in_one_line(text: str) -> str:
    r"""The text as `printable` gives it, with `\n` in place of line feeds: folders can be named with them."""
    return printable(text).replace("\n", "\\n")


class PrintableFormatter(logging.Formatter):
    """Log lines and tracebacks, as `printable` gives them.

    Names and errors of extrags that a message is given stand in one line; its own line feeds stay.
    """

    def format(self, record: logging.LogRecord) -> str:
        """As a formatter does."""
        args = record.args
        if isinstance(args, tuple):
            # Of a copy: other handlers have the record too.
            record = copy(record)
            record.args = tuple(_argument(item) for item in args)
        return printable(super().format(record))


def _argument(value: object) -> object:
    return in_one_line(str(value)) if isinstance(value, str | PurePath | ExtragsError) else value
