"""`extrags devices`: what would run where, before anything runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from extrags.errors import ConfigError
from extrags.placement import Placement
from extrags.stages import STAGES
from flows.cli import main
from flows.preflight import preflight
from tests.flows.tiny import tiny_config

WITHOUT_CUDA = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")


def test_every_stage_with_its_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "devices.json"
    assert main(["devices", "--device", "cpu", "--json", str(file)]) == 0
    said = capsys.readouterr().out
    found = json.loads(file.read_text())
    assert [stage for stage in STAGES if stage not in {item["stage"] for item in found}] == []
    assert all(item["reason"] and item["device"] == "cpu" for item in found)
    for stage in STAGES:
        assert stage in said
    assert "native" in said


def test_reasons_are_told_with_their_brackets(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Placement("coarse", "training", "cpu", "", "pip install -e '.[cuda]'")
    monkeypatch.setattr("extrags.placement.placements", lambda _: [made])
    assert main(["devices"]) == 0
    assert "pip install -e '.[cuda]'" in capsys.readouterr().out


def test_only_the_stages_of_the_method(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--method", "3dgs", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert not {"explore", "enhance", "finetune"} & {item["stage"] for item in found}


@WITHOUT_CUDA
def test_what_cannot_be_had_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--device", "cuda"]) == 2
    assert "device=cuda, but torch sees no CUDA device" in capsys.readouterr().err


@WITHOUT_CUDA
def test_a_run_is_refused_before_anything_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    assert main(["run", "phantom/0@sparse", "--device", "cuda", "--store", str(store)]) == 2
    assert "device=cuda, but torch sees no CUDA device" in capsys.readouterr().err
    assert not list((store / "artefacts").glob("*"))


def test_a_lens_that_a_gpu_does_not_render_is_refused_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    config = tiny_config(device="cuda", ingest__lens="native")
    with pytest.raises(ConfigError, match=r"ingest\.lens=pinhole, or device=cpu"):
        preflight(config, "coarse")
    # Frames may be looked at all the same.
    preflight(config, "ingest")
