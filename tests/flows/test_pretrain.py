from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene
from extrags.view_synthesis.conditioning import LAYER_CHANNELS, Layers
from extrags.view_synthesis.references import LightTransfer
from flows.cli import main
from flows.commands import pretrain as command
from flows.commands.pretrain import make_scenes, origin


def small_scene(seed: int) -> PretrainingScene:
    generator = torch.Generator().manual_seed(seed)
    layers = torch.rand(2, LAYER_CHANNELS, 40, 48, generator=generator)
    layers[:, 4] = 20 + 10 * layers[:, 4]
    layers[:, 16] = 1 + 0.2 * layers[:, 16]
    none = np.zeros(2, dtype=bool)
    return PretrainingScene(
        Pairs(
            Layers(layers),
            torch.rand(2, 3, 40, 48, generator=generator),
            torch.ones(2, 1, 40, 48),
            torch.full((2, 1, 40, 48), 25.0),
            np.arange(2),
            none,
            none.copy(),
        ),
        LightTransfer(None, 0.8, 25.0),
    )


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    folder = tmp_path / "pretraining"
    for index in range(3):
        small_scene(index).save(folder / f"{index:04d}.safetensors", origin=origin(index))
    return folder


def test_scenes_made_in_the_same_way_stay(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = [file.stat().st_mtime_ns for file in sorted(scenes.iterdir())]
    files = make_scenes(scenes, 3, workers=1)
    assert [file.stat().st_mtime_ns for file in files] == before
    assert origin(0) != origin(1)
    small_scene(1).save(files[1], origin="of another version")
    made: list[int] = []
    monkeypatch.setattr(command, "ProcessPoolExecutor", _Here)
    monkeypatch.setattr(command, "make_scene", lambda index, file: made.append(index))
    make_scenes(scenes, 3, workers=1)
    assert made == [1]


class _Here:
    """A pool that works in this process."""

    def __init__(self, workers: int, context: object) -> None:
        assert workers == 1

    def __enter__(self) -> _Here:
        return self

    def __exit__(self, *error: object) -> None:
        return None

    def submit(self, function, *arguments):
        from concurrent.futures import Future

        future: Future = Future()
        future.set_result(function(*arguments))
        return future


def test_weights_come_with_what_they_were_made_from(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--scenes-folder", str(scenes), "--scenes", "3", "--validation-scenes", "1", "--batch", "2"]
    common += ["--without-perceptual", "--threads", "1"]
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["pretrain", "--out", str(first), "--iterations", "2", *common]) == 0
    out = capsys.readouterr().out
    assert "embedded_1" in out
    assert main(["pretrain", "--out", str(second), "--iterations", "1", "--start", str(first), *common]) == 0
    record = json.loads((second / "restorer.json").read_text())["record"]
    assert "--iterations 1" in record["command"]
    assert record["machine"]["versions"]["torch"] == torch.__version__
    assert record["before"]["pretraining"]["iterations"] == 2
    assert EmbeddedEnhancer.load(second).network.widths == (48, 96, 160)


def test_what_would_fail_after_hours_is_said_at_once(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "w"), "--scenes-folder", str(scenes)]
    assert main(["pretrain", *out, "--scenes", "3", "--validation-scenes", "3"]) == 2
    assert "none is left to train" in capsys.readouterr().err
    assert main(["pretrain", *out, "--workers", "0"]) == 2
    assert "--workers 0" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["pretrain", "--out", str(tmp_path / "file" / "w"), "--without-perceptual"]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_the_weights_of_the_package_say_where_they_come_from() -> None:
    from extrags.restoration.diffusion.weights import find_weights

    weights = find_weights("bundled")
    assert weights is not None
    record = json.loads(weights.with_suffix(".json").read_text())["record"]
    assert record["command"].startswith("extrags pretrain ")
    assert record["before"]["command"].startswith("extrags pretrain ")
    scores = record["validation_scores"]
    assert scores["embedded_1"]["psnr"] > scores["classical"]["psnr"] + 1
    assert weights.stat().st_size < 8_000_000
