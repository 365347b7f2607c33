"""Damaged files of every kind end in named errors or correct reads: no other error, no crash, no hang."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
CASES = tuple(
    line.split('"')[1]
    for line in (ROOT / "tests" / "fuzzing_cases.py").read_text(encoding="utf-8").splitlines()
    if line.startswith('    "') and "Case(" in line
)
"""By name; the cases themselves are made in the processes that may crash."""


def ends(folder: Path, cases: tuple[str, ...], count: int) -> list[dict[str, Any]]:
    """What came of mutations 0 to count of each case; after a crash, of those that follow it."""
    waiting = [(case, 0, count) for case in cases]
    found: list[dict[str, Any]] = []
    while waiting:
        process = subprocess.run(
            [
                sys.executable,
                "-m",
                "tests.fuzzing",
                str(folder),
                *(":".join(map(str, item)) for item in waiting),
            ],
            capture_output=True,
            text=True,
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            check=False,
        )
        told = [json.loads(line) for line in process.stdout.splitlines() if line.startswith("{")]
        found += [item for item in told if item["end"] != "begun"]
        if process.returncode == 0:
            return found
        assert told, process.stderr
        last = told[-1]
        assert last["end"] == "begun", process.stderr
        crash = f"exit code {process.returncode}: {process.stderr[-300:]}"
        found.append({**last, "end": "crashed", "what": crash})
        done = next(index for index, item in enumerate(waiting) if item[0] == last["case"])
        following = last["number"] + 1
        waiting = [(last["case"], following, count - following), *waiting[done + 1 :]]
    return found


def checked(found: list[dict[str, Any]], cases: tuple[str, ...], count: int) -> None:
    assert len(found) == count * len(cases)
    wrong = [item for item in found if item["end"] not in ("read", "named")]
    assert wrong == []
    for case in cases:
        # Some change is always seen; a case in which none is would try nothing.
        assert any(item["end"] == "named" for item in found if item["case"] == case), case


def test_a_few_mutations_of_each_kind(tmp_path: Path) -> None:
    assert len(CASES) > 30
    checked(ends(tmp_path, CASES, 4), CASES, 4)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_thousand_mutations(case: str, tmp_path: Path) -> None:
    checked(ends(tmp_path, (case,), 1000), (case,), 1000)
