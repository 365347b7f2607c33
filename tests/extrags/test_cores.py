"""Cores that a process may use, in a container with a quota or without."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import extrags.cores
from extrags.cores import usable_cores

V1 = ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 6),
        ({"cpu.max": "max 100000\n"}, 6),
        ({"cpu.max": "400000 100000\n"}, 4),
        ({"cpu.max": "250000 100000\n"}, 3),
        ({"cpu.max": "10000 100000\n"}, 1),
        ({"cpu.max": "6400000 100000\n"}, 6),
        ({"cpu.max": "unheard of\n"}, 6),
        (dict(zip(V1, ("-1\n", "100000\n"), strict=True)), 6),
        (dict(zip(V1, ("150000\n", "100000\n"), strict=True)), 2),
        ({V1[0]: "150000\n"}, 6),
    ],
)
def test_the_quota_of_a_container_counts(
    files: dict[str, str], cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extrags.cores, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert usable_cores() == cores


def test_the_kernels_begin_with_no_more_threads(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    code = (
        "import sys, pathlib, extrags.cores\n"
        "extrags.cores.CONTROL_GROUP = pathlib.Path(sys.argv[1])\n"
        "from extrags.raster import native\n"
        "print(native.num_threads())"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("1\n", "")
