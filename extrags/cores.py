"""How many cores this process may keep busy, and what they are."""

from __future__ import annotations

import math
import os
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path

__all__ = ["processor_name", "usable_cores"]

CONTROL_GROUP = Path("/sys/fs/cgroup")
"""Where a container sees its own limits."""


def usable_cores() -> int:
    """Cores this process may use: those it may run on, or a container's share of their time if less."""
    cores = len(os.sched_getaffinity(0))
    share = _quota()
    return cores if share is None else max(1, min(cores, math.ceil(share)))


@cache
def processor_name() -> str:
    """The processor as the system names it; empty where it does not."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor()


def _quota() -> float | None:
    """Processor time that the control group may take, in cores; None where there is no such limit."""
    # Version 2 has one file, `max 100000` or `150000 100000`; version 1 has two, and -1 for no limit.
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        with suppress(OSError, ValueError):
            quota, period = " ".join((CONTROL_GROUP / name).read_text() for name in files).split()
            if quota != "max" and int(quota) > 0 and int(period) > 0:
                return int(quota) / int(period)
    return None
