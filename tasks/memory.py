"""Peak resident memory of the process while a block runs."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

__all__ = ["PeakMemory", "peak_memory"]

SAMPLE_SECONDS = 0.1
KIB_PER_MIB = 1 << 10


@dataclass
class PeakMemory:
    """Peak resident set size in MiB so far; None where the system does not report it."""

    mib: float | None = None


@contextmanager
def peak_memory() -> Iterator[PeakMemory]:
    """Sample the resident set size ten times per second while the block runs.

    The size is that of the whole process, including stages that run concurrently on other threads. Pages of
    mapped files do not count (those of libraries, and of stacks that `extrags.zarr_io.read_array` maps): the
    system takes them back where memory is short. Those of a file system in memory (tmpfs) do count.
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
    """What the process has in memory and nothing else can take back, in MiB: without pages of files."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    held = [int(line.split()[1]) for line in lines if line.startswith(("RssAnon:", "RssShmem:"))]
    return sum(held) / KIB_PER_MIB if held else None
