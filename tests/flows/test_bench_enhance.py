"""`extrags bench enhance` on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flows.cli import main
from tests.documented_json import undocumented
from tests.flows.tiny import SEQUENCE, TINY

pytestmark = pytest.mark.usefixtures("untouched_environment")

SETTINGS = [
    part
    for name, value in TINY.items()
    if name.startswith(("ingest.", "coarse.", "enhance."))
    for part in ("--set", f"{name}={json.dumps(value)}")
]


def test_a_table_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "found.json"
    methods = ["--methods", "none,classical", "classical/no-references"]
    assert (
        main(["bench", "enhance", SEQUENCE, *methods, "--seed", "2", *SETTINGS, "--json", str(target)]) == 0
    )
    found = json.loads(target.read_text())
    assert not undocumented(found, "bench-enhance")
    assert found["profile"] == "quick"
    assert [case["method"] for case in found["cases"]] == ["none", "classical", "classical/no-references"]
    for case in found["cases"]:
        assert {"psnr", "ssim", "lpips_alex", "steps", "seconds_per_frame", "kept", "flicker"} <= set(case)
        assert case["aligned"]["psnr"] >= case["psnr"]
        assert {"psnr", "lpips_alex", "well", "hole", "kept", "calibration"} <= set(case["aligned"])
        assert (case["sequence"], case["seed"], case["views"]) == (SEQUENCE, 2, 14)
        for part in ("well", "hole", "observed", "unobserved"):
            assert {"psnr", "ssim", "lpips_alex"} <= set(case[part])
    assert found["cases"][0]["changed_share"] == 0
    said = capsys.readouterr().out
    assert f"{SEQUENCE}: 14 held-out views" in said
    assert "classical/no-references" in said


def test_trained_restorers_and_the_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figure = tmp_path / "calibration.png"
    methods = ["--methods", "scratch", "--set", "enhance.samples=2", "--set", "enhance.precision=float32"]
    arguments = [SEQUENCE, *SETTINGS, *methods, "--figure", str(figure), "--json", "-"]
    assert main(["bench", "enhance", *arguments]) == 0
    (case,) = json.loads(capsys.readouterr().out)["cases"]
    assert case["steps"] in (1, 4)
    assert case["prepare_seconds"] > 0
    table = case["calibration"]
    assert table["cells"] == sum(row["cells"] for row in table["bins"])
    assert figure.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([SEQUENCE, "--methods", "none", "telea"], "unknown methods telea; expected none, embedded-1"),
        ([SEQUENCE, "--seed", "-1"], "the seed is -1"),
        (["phantom/0@spars"], "no setting 'spars'"),
        ([SEQUENCE, "--set", "enhance.step=1"], "did you mean enhance.steps"),
    ],
)
def test_wrong_usage_is_one_sentence(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "enhance", *arguments]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_no_prediction_no_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figure = tmp_path / "calibration.png"
    arguments = [SEQUENCE, *SETTINGS, "--methods", "none", "--figure", str(figure)]
    assert main(["bench", "enhance", *arguments]) == 2
    said = capsys.readouterr()
    assert "14 held-out views" in said.out
    assert "no restorer here predicts its error" in said.err
    assert not figure.exists()
