"""Stacks of frames in memory, or where they are large, in a nameless file whose pages can be taken back.

A stack of a long recording would fill the memory with what is looked at frame by frame. The file lies in the
folder of temporary files (`TMPDIR`), needs as much room there as the stack, and goes with the process,
however that ends: on Linux it never has a name.
"""

from __future__ import annotations

import errno
import math
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

__all__ = ["MAPPED_BYTES", "FrameStack", "empty_stack", "frames_of", "stacked"]

MAPPED_BYTES = 64 << 20
"""Larger stacks are mapped files."""


def empty_stack(shape: Sequence[int], dtype: np.dtype[Any] | type) -> np.ndarray:
    """An array of zeros, of at most `MAPPED_BYTES` in memory, else in a mapped file.

    Args:
        shape: of the array.
        dtype: of its elements.

    Raises:
        OSError: when there is no room for the file; names the folder of temporary files.
    """
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    if size <= MAPPED_BYTES:
        return np.zeros(tuple(shape), dtype=kind)
    try:
        with tempfile.TemporaryFile(prefix="extrags-") as file:
            _reserve(file.fileno(), size)
            # The map keeps the file open.
            return np.memmap(file, dtype=kind, mode="r+", shape=tuple(shape)).view(np.ndarray)
    except OSError as error:
        # A file without a name cannot tell where it lies.
        raise OSError(error.errno, os.strerror(error.errno or 0), tempfile.gettempdir()) from error


def stacked(frames: Iterable[np.ndarray], count: int) -> np.ndarray:
    """Frames of equal shape as one array, as `numpy.stack`, without holding them all beside it.

    Args:
        frames: taken one at a time.
        count: how many there are.

    Raises:
        ValueError: when there are not so many, or of different shapes.
    """
    stack = FrameStack(count)
    for frame in frames:
        stack.append(frame)
    return stack.array


def frames_of(stack: np.ndarray, chosen: Int[np.ndarray, "n"]) -> np.ndarray:
    """Copy of chosen frames, as indexing makes one, in a mapped file where it is large."""
    found = empty_stack((len(chosen), *stack.shape[1:]), stack.dtype)
    for position, frame in enumerate(chosen):
        found[position] = stack[frame]
    return found


class FrameStack:
    """An array that is filled frame by frame; shape and dtype are those of the first one.

    Args:
        count: of frames.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._filled = 0
        self._array: np.ndarray | None = None

    def __len__(self) -> int:
        return self._filled

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter(() if self._array is None else self._array[: self._filled])

    def append(self, frame: np.ndarray) -> np.ndarray:
        """Take in the next frame; it is copied.

        Returns:
            The frame as it lies in the stack: who keeps it keeps no copy.

        Raises:
            ValueError: when its shape or dtype differs from the first one's, or there is no room for it.
        """
        if self._array is None:
            self._array = empty_stack((self._count, *frame.shape), frame.dtype)
        if self._filled == self._count:
            raise ValueError(f"a further frame after {self._count}, for which there is room")
        if frame.shape != self._array.shape[1:] or frame.dtype != self._array.dtype:
            raise ValueError(
                f"frame {self._filled} of {self._count} is {frame.shape} of {frame.dtype}, the first one "
                f"{self._array.shape[1:]} of {self._array.dtype}"
            )
        self._array[self._filled] = frame
        self._filled += 1
        return np.asarray(self._array[self._filled - 1])

    @property
    def array(self) -> np.ndarray:
        """All frames, [count, ...].

        Raises:
            ValueError: while frames are missing.
        """
        if self._array is None or self._filled != self._count:
            raise ValueError(f"{self._filled} of {self._count} frames were given")
        return self._array


def _reserve(file: int, size: int) -> None:
    """Room for a file, now: when a page of a map finds the disk full, the process ends without an error."""
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(file, 0, size)
        except OSError as error:
            # Some file systems reserve nothing, and not every C library writes in their place.
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
                raise
        else:
            return
    blank, written = bytes(1 << 20), 0
    while written < size:
        written += os.pwrite(file, blank[: size - written], written)
