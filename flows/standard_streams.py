"""Standard output and standard error of a command, wherever they go.

They may be closed, lead to a full disk, or to a terminal that has not all characters.
"""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

__all__ = ["output_refusal", "set_up_streams", "write_out"]

STANDARD_OUTPUT, STANDARD_ERROR = 1, 2


class _Output(io.FileIO):
    """A file that remembers why it could not be written.

    What the layers above do not hold any more after a failure, nothing else tells.
    """

    refusal: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """As the file does."""
        try:
            return super().write(data)
        except OSError as error:
            self.refusal = error
            raise


def set_up_streams() -> None:
    """Give this process streams that can be written, in any encoding; for the main thread, at the start.

    Characters that an encoding lacks are written by their number, in ASCII. What goes to a stream that the
    caller has closed is lost.
    """
    if sys.stdout is None or sys.stderr is None:
        # Files that are opened later would take the places of the closed streams, and native code and
        # children would write into them.
        while (place := os.open(os.devnull, os.O_RDWR)) <= STANDARD_ERROR:
            os.set_inheritable(place, True)
        os.close(place)
    if sys.stdout is None:
        sys.stdout = _nowhere()
    elif isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.flush()
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(_Output(sys.stdout.fileno(), "w", closefd=False)),
            encoding=sys.stdout.encoding,
            errors="backslashreplace",
            # Unbuffered (PYTHONUNBUFFERED): by the line.
            line_buffering=sys.stdout.line_buffering or sys.stdout.write_through,
        )
    if sys.stderr is None:
        sys.stderr = _nowhere()
    elif isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="backslashreplace")


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")


def output_refusal() -> OSError | None:
    """Why standard output could not be written; None where it could, or its reader has gone."""
    buffer = getattr(sys.stdout, "buffer", None)
    refusal: OSError | None = getattr(getattr(buffer, "raw", None), "refusal", None)
    return None if isinstance(refusal, BrokenPipeError) else refusal


def write_out() -> None:
    """Write what the streams still hold; it goes nowhere where it cannot be written.

    Left to Python's own end, it would be written then, and fail with a message and an exit code of its own.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is None:
            continue
        try:
            stream.flush()
        except ValueError:
            # A closed stream: Python reports that in its own way.
            continue
        except OSError:
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream.fileno())
                os.close(nowhere)
