"""Some of the kills of `tests.flows.killing`, by its own command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("kind", "count"), [("runs", 20), ("workers", 10), ("servers", 2)])
def test_killed_it_ends_as_if_undisturbed(kind: str, count: int) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "tests.flows.killing", kind, str(count)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = json.loads(ended.stdout)
    counts = found["counts"]
    assert counts["trials"] == counts["exit code 0"] == count
    assert not any(counts.get(wrong) for wrong in ("other artefacts", "damaged", "left behind"))
    assert found["flow runs that the server takes for running"] == 0
    assert sum(found["hits by stage"].values()) >= count / 2
