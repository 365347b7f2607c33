"""Digests of the content of files, each file read once as long as it does not change."""

from __future__ import annotations

import hashlib
import os
import time
from contextlib import ExitStack
from pathlib import Path

__all__ = ["size_and_digest"]

_BLOCK_BYTES = 1 << 20
_SETTLED_NS = 60_000_000_000
"""A file that changed since then may change again without another time of change: clocks of file systems are
coarse, and what is written through mapped memory is stamped late."""
_MOST_REMEMBERED = 1 << 17

_remembered: dict[tuple[tuple[int, ...], ...], str] = {}
"""Digests by what the operating system tells of the files."""


def size_and_digest(*files: Path) -> tuple[int, str]:
    """Size in bytes and BLAKE2b digest of the content of files, one after the other.

    Files that this process has digested, and that the operating system says are unchanged since, are not read
    again: same device and inode, size, and times of the last change of content and of inode. Programs can set
    the first of these times back, not the second.

    Raises:
        OSError: when one cannot be read.
    """
    with ExitStack() as opened:
        streams = [opened.enter_context(file.open("rb")) for file in files]
        # Of the open files, and before their content: a change while they are read leads to other times.
        # Network file systems ask their server when a file is opened, not at every `stat`.
        states = [os.fstat(stream.fileno()) for stream in streams]
        now_ns = time.time_ns()
        known_by = tuple(
            (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
            for state in states
        )
        found = _remembered.get(known_by)
        if found is None:
            digest = hashlib.blake2b(digest_size=16)
            for stream in streams:
                while block := stream.read(_BLOCK_BYTES):
                    digest.update(block)
            found = digest.hexdigest()
            # File systems without times give 0.
            if all(0 < state.st_ctime_ns < now_ns - _SETTLED_NS for state in states):
                if len(_remembered) >= _MOST_REMEMBERED:
                    _remembered.clear()
                _remembered[known_by] = found
    return sum(state.st_size for state in states), found
