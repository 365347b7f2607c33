"""Processor time of the process and of the children it has waited for, while a block runs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

__all__ = ["ProcessorTime", "processor_time"]


@dataclass
class ProcessorTime:
    """Seconds of all threads and of children that have ended, user and system together."""

    seconds: float = 0.0


@contextmanager
def processor_time() -> Iterator[ProcessorTime]:
    """Measure what the whole process spends while the block runs.

    Stages that run concurrently on other threads are counted as well: where it matters, run one at a time.
    """
    spent = ProcessorTime()
    begun = sum(os.times()[:4])
    try:
        yield spent
    finally:
        spent.seconds = round(sum(os.times()[:4]) - begun, 3)
