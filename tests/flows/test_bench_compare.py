"""`extrags bench compare` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flows.cli import main
from flows.commands.bench_compare import NOT_JUDGED
from tests.documented_json import undocumented


def result(*psnr: float, **more: Any) -> dict[str, Any]:
    """A benchmark of one method on one sequence, one seed for each PSNR in dB."""
    cases = [
        {
            **{"method": "coarse", "profile": "quick", "sequence": "phantom/0", "setting": "sparse"},
            **{"seed": seed, "seconds": 10.0, "peak_mib": 500.0, "metrics": {"psnr": value}, "error": ""},
            **more.get("case", {}),
        }
        for seed, value in enumerate(psnr)
    ]
    return {"machine": {}, "cases": cases, **{key: value for key, value in more.items() if key != "case"}}


def compared(folder: Path, *sides: dict[str, Any]) -> int:
    files = [folder / name for name in ("before.json", "after.json")]
    for file, side in zip(files, sides, strict=True):
        file.write_text(json.dumps(side))
    return main(["bench", "compare", *map(str, files), "--json", str(folder / "found.json")])


@pytest.mark.parametrize("before", [(30.0,), (30.0, 31.0)])
def test_what_could_not_be_judged_is_not_all_well(
    before: tuple[float, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    after = [value - loss for value, loss in zip(before, (2.0, 3.0), strict=False)]
    assert compared(tmp_path, result(*before), result(*after)) == NOT_JUDGED
    said = capsys.readouterr().out
    assert "not judged: coarse (quick) on phantom/0@sparse: psnr 30" in said
    assert "too few seeds" in said
    found = json.loads((tmp_path / "found.json").read_text())
    assert not undocumented(found, "bench-compare")
    assert len(found["not_judged"]) == 1


def test_nothing_worse_is_all_well(tmp_path: Path) -> None:
    assert compared(tmp_path, result(30.0), result(33.0)) == 0
    assert compared(tmp_path, result(30.0, 31.0), result(30.0, 31.0)) == 0


def test_what_is_not_alike_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = result(30.0, case={"asked": "a"}, sharing="none")
    assert compared(tmp_path, before, result(30.0, case={"asked": "b"}, sharing="once")) == 0
    said = capsys.readouterr().out
    assert "coarse (quick) on phantom/0@sparse was asked for with other settings" in said
    assert "memory is not judged" in said


def test_a_regression_comes_first(tmp_path: Path) -> None:
    losing = result(*(20.0 + seed / 100 for seed in range(5)))
    assert compared(tmp_path, result(*(30.0 + seed for seed in range(5))), losing) == 1


def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "compare", *[str(tmp_path / "none.json")] * 2]) == 2
    assert capsys.readouterr().err.endswith("none.json cannot be read: No such file or directory\n")
