"""Text for a terminal: names in files of others can hold what a terminal obeys instead of showing it."""

from __future__ import annotations

import logging
import re

from extrags.escaped_text import escaped

__all__ = ["PrintableFormatter", "printable"]

_OBEYED = re.compile(
    # Control characters but for tab and line feed; marks that turn the direction in which text is read.
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]"
)


def printable(text: str) -> str:
    r"""The text with `\x1b`, as Python writes it, in place of each character that a terminal would obey."""
    return escaped(text, _OBEYED)


class PrintableFormatter(logging.Formatter):
    """Log lines and tracebacks, as `printable` gives them."""

    def format(self, record: logging.LogRecord) -> str:
        """As a formatter does."""
        return printable(super().format(record))
