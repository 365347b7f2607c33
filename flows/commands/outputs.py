"""Where verbs write to: every output is spelled, checked and made in one way.

Nothing heavy is imported here: parsers need it.
"""

from __future__ import annotations

import errno
import os
from argparse import ArgumentTypeError
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from extrags.errors import StoreError, reason_of
from extrags.output_files import write_file
from extrags.user_paths import expanded

__all__ = [
    "STANDARD_OUTPUT",
    "file_or_standard_output",
    "made_folder",
    "output_file",
    "output_folder",
    "output_place",
    "write_output",
]

STANDARD_OUTPUT = "-"


def output_place(text: str) -> str:
    """A file or folder to be written at the end, `~` expanded; `type` of an option.

    What is wrong with its place is said before hours of work.

    Raises:
        ArgumentTypeError: when nothing can be made there.
    """
    place = expanded(text)
    first, *within = place.parts or ("",)
    if first.startswith("~") and within and not os.path.isdir(first):
        # A file may be called so; a folder would be made for a user whose name is misspelled.
        raise ArgumentTypeError(f"{text} cannot be written: there is no home folder and no folder {first}")
    if not text:
        raise ArgumentTypeError("expected a name")
    absolute = place.absolute()
    # By os.path: what may not be looked into counts as not there, and is refused below.
    there = os.path.exists(absolute)
    if there and not os.access(absolute, os.W_OK):
        raise ArgumentTypeError(f"{text} cannot be written: {os.strerror(errno.EACCES)}")
    # Folders, pipes and devices are written into, files are replaced.
    if not there or os.path.isfile(absolute):
        folder = next(above for above in absolute.parents if os.path.exists(above))
        if not (os.path.isdir(folder) and os.access(folder, os.W_OK)):
            raise ArgumentTypeError(f"{text} cannot be written: nothing can be made in {folder}")
    return str(place)


def output_file(text: str) -> str:
    """A file to be written, as `output_place`; `type` of an option.

    Raises:
        ArgumentTypeError: for a folder, or when nothing can be made there.
    """
    place = output_place(text)
    if os.path.isdir(place):
        raise ArgumentTypeError(f"{text} is a folder; expected a file")
    return place


def output_folder(text: str) -> str:
    """A folder to be written into, as `output_place`; `type` of an option.

    Raises:
        ArgumentTypeError: for a file, or when nothing can be made there.
    """
    place = output_place(text)
    if os.path.exists(place) and not os.path.isdir(place):
        raise ArgumentTypeError(f"{text} is a file; expected a folder")
    return place


def file_or_standard_output(text: str) -> str:
    """As `output_file`, or `-`; `type` of an option.

    Raises:
        ArgumentTypeError: for a folder, or when nothing can be made there.
    """
    return text if text == STANDARD_OUTPUT else output_file(text)


@contextmanager
def made_folder(wanted: Path) -> Iterator[None]:
    """Make a folder, and take back what was made where nothing comes to lie in it.

    Raises:
        OSError: when it cannot be made.
    """
    made = [folder for folder in (wanted, *wanted.parents) if not folder.exists()]
    # At once: a place that cannot be written must not be found out after all the work.
    wanted.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for folder in made:
                folder.rmdir()
        raise


def write_output(target: str, content: str | bytes) -> None:
    """Write a whole file, and the folder it is in.

    Args:
        target: from one of the checks above.
        content: text, written as UTF-8, or bytes.

    Raises:
        StoreError: when it cannot be written.
    """
    try:
        with made_folder(Path(target).parent):
            write_file(target, content)
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {reason_of(error)}") from error
