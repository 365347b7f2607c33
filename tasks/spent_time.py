"""Elapsed and processor time of tasks, several of which may run at once in one process: each its share."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

__all__ = ["SpentTime", "SpentTimes", "spent_time"]


@dataclass(eq=False)
class SpentTime:
    """What one task has spent."""

    elapsed_s: float = 0.0
    """Of the clock; while n tasks run, each is charged an n-th, so that all of them add up to the time that
    somebody has waited."""
    processor_s: float = 0.0
    """Of all threads of the process and of the children that it has waited for, user and system, divided in
    the same way: threads belong to no task."""


def _process_seconds() -> float:
    return sum(os.times()[:4])


class SpentTimes:
    """Divides the time of a process among the tasks that run in it. May be used from any thread.

    Args:
        clock: elapsed seconds, from any origin.
        processor: seconds of processor time, from any origin.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        processor: Callable[[], float] = _process_seconds,
    ) -> None:
        self._clock, self._processor = clock, processor
        self._guard = threading.Lock()
        self._running: list[SpentTime] = []
        self._last = (0.0, 0.0)

    @contextmanager
    def spent(self) -> Iterator[SpentTime]:
        """Charge what is spent while the block runs; final once it has ended."""
        own = SpentTime()
        with self._guard:
            self._charge()
            self._running.append(own)
        try:
            yield own
        finally:
            with self._guard:
                self._charge()
                self._running.remove(own)
            own.elapsed_s, own.processor_s = round(own.elapsed_s, 3), round(own.processor_s, 3)

    def _charge(self) -> None:
        """Divide what was spent since the last task began or ended."""
        now = self._clock(), self._processor()
        for task in self._running:
            task.elapsed_s += (now[0] - self._last[0]) / len(self._running)
            task.processor_s += (now[1] - self._last[1]) / len(self._running)
        self._last = now


_of_this_process = SpentTimes()


def spent_time() -> AbstractContextManager[SpentTime]:
    """What the block spends, of the tasks of this process: see `SpentTimes.spent`."""
    return _of_this_process.spent()
