"""What a measurement was taken on."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path
from typing import Any

from extrags.store.manifest import software_versions
from flows.settings import usable_cores

__all__ = ["machine"]


def machine() -> dict[str, Any]:
    """Processor, cores, threads, versions and commit, as JSON."""
    import torch

    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "versions": software_versions(),
        "commit": _commit(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.machine())


def _commit() -> str | None:
    """Commit of the checkout this runs from; None for an installed package."""
    try:
        found = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()
