"""What a run prints at its end."""

from __future__ import annotations

import pytest
from rich.console import Console

from flows.console import print_outcomes
from flows.outcome import DatasetOutcome, SequenceOutcome, StageRow

METRICS = {"psnr": 20.84, "ssim": 0.776, "lpips": 0.188}


@pytest.fixture
def run() -> DatasetOutcome:
    stages = [StageRow("ingest", "ran"), StageRow("coarse", "cached"), StageRow("surface", "skipped")]
    made = SequenceOutcome("phantom/0@sparse", "ok", stages)
    made.metrics = {"coarse": METRICS, "final": {**METRICS, "psnr": 26.97}, "restored": METRICS}
    failed = SequenceOutcome(
        "some [folder]/scan", "failed", [StageRow("ingest", "failed", reason="no frames")]
    )
    return DatasetOutcome([made, failed])


def printed(run: DatasetOutcome, width: int, patched: pytest.MonkeyPatch) -> str:
    out = Console(width=width)
    patched.setattr("flows.console.console", lambda **_: out)
    with out.capture() as captured:
        print_outcomes(run, 1.0)
    return captured.get()


@pytest.mark.parametrize("width", [20, 40, 80, 120])
def test_words_stay_whole_in_any_terminal(
    run: DatasetOutcome, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = printed(run, width, monkeypatch)
    assert "some [folder]/scan failed in ingest: no frames" in said
    assert all(word in said for word in ("phantom/0@", "cached", "restored", "26.97", "psnr"))
    # A table has its heads in a line of their own.
    assert ("sequence" in said) == (width >= 80)


def test_in_a_narrow_one_each_figure_has_a_line(run: DatasetOutcome, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = printed(run, 30, monkeypatch).splitlines()
    assert lines[:2] == ["phantom/0@sparse: ok", "  1 ran, 1 cached, 1 skipped"]
    assert lines[2:4] == ["  psnr 20.84 → 26.97", "  psnr, restored 26.97 → 20.84"]
    assert "some [folder]/scan: failed" in lines
    assert not any("depth_absrel" in line for line in lines)
