"""Peak resident memory of the process while a block runs."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

__all__ = ["PeakMemory", "peak_memory"]

SAMPLE_SECONDS = 0.1
MIB = 1 << 20


@dataclass
class PeakMemory:
    """Peak resident set size in MiB so far; None where the system does not report it."""

    mib: float | None = None


@contextmanager
def peak_memory() -> Iterator[PeakMemory]:
    """Sample the resident set size ten times per second while the block runs.

    The size is that of the whole process, including stages that run concurrently on other threads.
    """
    peak = PeakMemory(_resident_mib())
    if peak.mib is None:
        yield peak
        return
    finished = threading.Event()

    def sample() -> None:
        while not finished.wait(SAMPLE_SECONDS):
            peak.mib = max(peak.mib or 0.0, _resident_mib() or 0.0)

    sampler = threading.Thread(target=sample, name="peak-memory", daemon=True)
    sampler.start()
    try:
        yield peak
    finally:
        finished.set()
        sampler.join()
        peak.mib = round(max(peak.mib or 0.0, _resident_mib() or 0.0), 1)


def _resident_mib() -> float | None:
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB
