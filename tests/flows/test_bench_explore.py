"""`extrags bench explore` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flows.cli import main
from tests.documented_json import undocumented
from tests.flows.tiny import SEQUENCE, TINY

pytestmark = pytest.mark.usefixtures("untouched_environment")

SETTINGS = [
    part
    for name, value in TINY.items()
    if name.startswith(("ingest.", "coarse.", "surface.", "freespace.", "explore.", "enhance.", "finetune."))
    for part in ("--set", f"{name}={json.dumps(value)}")
]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench_explore")


def run(store: Path, *arguments: str) -> dict[str, Any]:
    target = store / "found.json"
    given = ["bench", "explore", SEQUENCE, "--store", str(store / "store"), *SETTINGS]
    assert main([*given, *arguments, "--json", str(target)]) == 0
    found: dict[str, Any] = json.loads(target.read_text())
    assert not undocumented(found, "bench-explore")
    return found


def test_a_table_and_json(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ways = ["extrags", "random", "perturbed", "frontier", "clairvoyant"]
    found = run(store, "--views", "2", "4", "--ways", *ways)
    assert [case["way"] for case in found["cases"]] == ways
    assert found["views"] == [2, 4]
    assert found["config"]["explore"]["length"] == TINY["explore.length"]
    by_way = {case["way"]: case for case in found["cases"]}
    for case in found["cases"]:
        assert (case["sequence"], case["seed"]) == (SEQUENCE, 0)
        assert case["n_views"] == sum(len(clip["world_from_camera"]) - 1 for clip in case["clips"])
        for shares in case["after_each"].values():
            assert len(shares) == case["n_views"] + 1
            assert shares == sorted(shares)
        assert case["after"]["4"]["never_seen"] == case["after_each"]["never_seen"][min(4, case["n_views"])]
    assert by_way["extrags"]["renders"] > 0
    assert by_way["random"]["renders"] == 0
    best = by_way["clairvoyant"]["after"]["4"]["never_seen"]
    assert best >= by_way["random"]["after"]["4"]["never_seen"]
    assert best > 0
    said = capsys.readouterr().out
    assert f"{SEQUENCE}, seed 0: of " in said
    assert "held-out pixels" in said


def test_end_use_restores_and_fine_tunes(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (case,) = run(store, "--views", "2", "--ways", "random", "--end-use")["cases"]
    assert set(case["end_use"]) == {"0", "2"}
    for figures in case["end_use"].values():
        assert figures["whole"]["psnr"] > 5
        assert figures["unobserved"]["psnr"] > 0
    assert case["end_use"]["2"]["n_views"] == 2
    assert case["end_use"]["2"]["whole"] != case["end_use"]["0"]["whole"]
    assert "dB at 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([SEQUENCE, "--ways", "straight"], "unknown ways straight; expected extrags, paper"),
        # The method that trains on held-out frames is no way to choose views.
        ([SEQUENCE, "--ways", "oracle"], "unknown ways oracle; expected extrags, paper"),
        ([SEQUENCE, "--views", "0"], "numbers of views [0]; expected 1 or more"),
        ([SEQUENCE, "--views", "many"], "--views many: expected a whole number"),
        ([SEQUENCE, "--views", ",", "--end-use"], "--views ,: expected one or more whole numbers"),
        ([SEQUENCE, "--seeds", ","], "expected one or more different seeds"),
        ([SEQUENCE, "--seeds", "1", "1"], "--seeds 1,1: expected one or more different seeds"),
    ],
)
def test_wrong_usage_is_one_sentence(
    arguments: list[str], message: str, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "explore", *arguments, "--store", str(store / "store")]) == 2
    assert message in capsys.readouterr().err


def test_without_a_true_surface_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import cv2
    import numpy as np

    rng = np.random.default_rng(0)
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(4):
        image = rng.integers(20, 200, (32, 40, 3), dtype=np.uint8)
        assert cv2.imwrite(str(frames / f"{number:03d}.png"), image)
    assert main(["bench", "explore", str(frames), "--store", str(tmp_path / "store")]) == 2
    assert "has no true surface" in capsys.readouterr().err
