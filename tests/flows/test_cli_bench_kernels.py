"""The command line: benchmarks of kernels and of stability."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from extrags.stress import Effort, Row
from extrags.stress.rows import Trial
from flows.cli import main
from tests.documented_json import undocumented

pytestmark = pytest.mark.usefixtures("untouched_environment")


class TestBench:
    """The kernels' benchmarks at sizes that take no time."""

    SMALL = ("--size", "24x16,32x20", "--gaussians", "40", "60", "--rounds", "2", "--threads", "1")

    def test_raster_as_json(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["bench", "raster", *self.SMALL, "--peers", "torch,reference", "--json", "-"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert not undocumented(found, "bench-raster")
        named = [(case["width"], case["n_gaussians"], case["backend"]) for case in found["cases"]]
        peers = ("native", "torch", "reference")
        assert named == [(w, n, peer) for w, n in ((24, 40), (32, 60)) for peer in peers]
        for case in found["cases"]:
            assert {"forward", "backward", "iteration"} <= set(case["ms"])
            assert case["error"]["image"] < 1e-5
            assert set(case["error"]["grads"]) == {"means", "quats", "scales", "opacities", "sh"}
            assert "peak_mib" in case

    def test_train_as_a_table(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["bench", "train", *self.SMALL, "--peers", "native"]) == 0
        said = capsys.readouterr().out
        assert "x native" in said
        assert "32x20, native, 1 threads: project" in said
        assert "worst gradient" not in said
        assert main(["bench", "train", *self.SMALL, "--peers", "native", "--error"]) == 0
        assert "worst gradient" in capsys.readouterr().out
        assert main(["bench", "train", *self.SMALL, "--peers", "direct", "--json", "-"]) == 0
        assert not undocumented(json.loads(capsys.readouterr().out), "bench-raster")

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--size", "24x16", "--gaussians", "40", "60"], "--size names 1 sizes and --gaussians 2"),
            (["--size", "24x16"], "--gaussians 0 numbers"),
            (["--size", "24", "--gaussians", "40"], "expected WIDTHxHEIGHT"),
            (["--size", "24x16", "--gaussians", "many"], "expected a whole number"),
            (["--size", "24x16", "--gaussians", "0"], "start at 1"),
            (["--quick", "--size", "24x16", "--gaussians", "40"], "--quick is the smallest"),
            (["--quick", "--threads", "two"], "expected a whole number"),
            (["--quick", "--peers", "warp"], "unknown peers warp"),
        ],
    )
    def test_wrong_usage(
        self, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["bench", "raster", *arguments]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1

    def test_stability(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        target = tmp_path / "stability.json"
        chosen = ["--rows", "rasteriser/not finite", "Adam", "--scenes", "5", "--iterations", "20"]
        assert main(["bench", "stability", *chosen, "--json", str(target)]) == 0
        found = json.loads(target.read_text())
        assert not undocumented(found, "bench-stability")
        assert {row["part"] for row in found["rows"]} == {"rasteriser", "Adam"}
        assert found["effort"] == {"scenes": 5, "iterations": 20, "largest": 100_000}
        assert all(row["passed"] and row["worst"] <= row["limit"] for row in found["rows"])
        assert f"all {len(found['rows'])} rows pass" in capsys.readouterr().out

    def test_an_unstable_row(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        row = Row("lamp", "case", "what", 1.0, lambda effort: [("seed 7", 2.0)])
        monkeypatch.setattr("extrags.stress.ROWS", (row,))
        assert main(["bench", "stability"]) == 1
        said = capsys.readouterr()
        assert "lamp/case: FAILS at seed 7" in said.err
        assert "1 rows, 1 of them fail" in said.out
        assert main(["bench", "stability", "--rows", "wind"]) == 2
        assert main(["bench", "stability", "--threads", "0"]) == 2

    def test_an_error_is_told_with_its_brackets(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def failing(effort: Effort) -> Iterator[Trial]:
            yield "at [/a/b] first", 3.0
            raise ValueError("expected images [n, 3]")

        def worse(effort: Effort) -> Iterator[Trial]:
            yield "at [/a/b] first", 3.0

        rows = tuple(
            Row("lamp", name, "what", 1.0, trials) for name, trials in (("a", failing), ("b", worse))
        )
        monkeypatch.setattr("extrags.stress.ROWS", rows)
        assert main(["bench", "stability"]) == 1
        said = capsys.readouterr()
        assert "expected images [n, 3]" in said.out
        assert "at [/a/b] first" in said.out
        assert "FAILS at at [/a/b] first" in said.err
