"""Files and folders that somebody asked for: each comes to be whole, or stays as it was.

An interruption or an error in the middle of writing neither destroys an older file nor leaves a part that
looks like a whole one.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["remove_unfinished", "whole_file", "whole_folder", "write_file"]

_unfinished: set[Path] = set()
"""What this process is writing: files and folders under their temporary names."""


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """A temporary file beside another one, whose place it takes at the end of the block.

    When the block raises, the temporary file is removed, and what was there before stays. Links are followed.
    What is no regular file, such as a pipe or a device, is written itself.

    Args:
        path: the file wanted, in a folder that is there.

    Yields:
        The file to write; its name ends as that of `path` does.

    Raises:
        OSError: when an older file may not be written, or its place not be taken; names `path`, as errors of
            the block do that would name the temporary file.
    """
    path, place = Path(path), Path(os.path.realpath(path))
    older = os.path.isfile(place)
    if not older and os.path.exists(place):
        yield path
        return
    if older and not os.access(place, os.W_OK):
        # Replacing it needs no permission for the file itself, but who took that away meant something.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    partial = _temporary(place.parent, place.suffix)
    with _named(partial, path):
        try:
            yield partial
            if older:
                shutil.copymode(place, partial)
            partial.replace(place)
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            _unfinished.discard(partial)


def write_file(path: Path | str, content: str | bytes) -> None:
    """Write a whole file: text as UTF-8, or bytes.

    Args:
        path: in a folder that is there.
        content: of the file.

    Raises:
        OSError: when it cannot be written; names `path`.
    """
    with whole_file(path) as partial:
        partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A temporary folder whose content is that of another one at the end of the block.

    When the block raises, it is removed, and `path` is as it was before.

    Args:
        path: not there yet, in a folder that is; or an empty folder, which stays the same one: it may be the
            working directory of a shell.

    Yields:
        The folder to write into.

    Raises:
        OSError: when it cannot be made, or its place not be taken; names `path`, as errors of the block do
            that would name the temporary folder.
    """
    place = Path(os.path.realpath(path))
    there = place.is_dir()
    partial = _temporary(place if there else place.parent, "")
    with _named(partial, path):
        try:
            partial.mkdir()
            yield partial
            if there:
                for entry in sorted(partial.iterdir()):
                    entry.replace(place / entry.name)
            else:
                partial.replace(place)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            _unfinished.discard(partial)


def remove_unfinished() -> None:
    """Remove what this process is still writing: for its end, when nothing unwinds any more."""
    for partial in list(_unfinished):
        with suppress(OSError):
            partial.unlink()
        shutil.rmtree(partial, ignore_errors=True)


def _temporary(folder: Path, suffix: str) -> Path:
    """A free name; hidden, and with the suffix, by which some writers choose their format."""
    partial = folder / f".extrags-{secrets.token_hex(4)}{suffix}"
    _unfinished.add(partial)
    return partial


@contextmanager
def _named(partial: Path, path: Path) -> Iterator[None]:
    """Errors inside the block that name a temporary file or folder name what was asked for."""
    try:
        yield
    except OSError as error:
        named = error.filename
        if not isinstance(named, str) or not Path(named).is_relative_to(partial):
            raise
        raise OSError(error.errno, error.strerror, str(path / Path(named).relative_to(partial))) from error
