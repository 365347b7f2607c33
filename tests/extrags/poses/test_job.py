"""The process COLMAP runs in, and its caller."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

CALLER = """
import numpy as np
from extrags.poses.job import PoseJob, run_job
job = PoseJob(*(np.zeros(1) for _ in range(6)), settings={})
run_job("tests.extrags.poses.waiting_job", job, "a sequence", stage="poses")
"""
PATIENCE_S = 30.0


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def test_it_ends_when_its_caller_is_killed(tmp_path: Path) -> None:
    said = tmp_path / "process"
    environment = {**os.environ, "EXTRAGS_TEST_PROCESS": str(said), "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", CALLER], env=environment) as caller:
        until = time.monotonic() + PATIENCE_S
        while not (said.exists() and said.read_text().endswith("\n")):
            assert time.monotonic() < until
            assert caller.poll() is None
            time.sleep(0.02)
        process = int(said.read_text())
        assert is_running(process)
        # Ctrl-C in a terminal reaches the caller alone, which then ends the job.
        assert os.getpgid(process) == process
        caller.kill()
    until = time.monotonic() + 5
    while is_running(process):
        assert time.monotonic() < until
        time.sleep(0.02)
