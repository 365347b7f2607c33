from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene, ReferenceFrames
from extrags.view_synthesis.conditioning import LAYER_CHANNELS, Layers
from extrags.view_synthesis.references import LightTransfer
from flows.cli import main
from flows.commands import pretrain as command
from flows.commands.pretrain import SceneSource, make_scenes, scene_sources


def small_scene(seed: int) -> PretrainingScene:
    generator = torch.Generator().manual_seed(seed)
    layers = torch.rand(2, LAYER_CHANNELS, 40, 48, generator=generator)
    layers[:, 4] = 20 + 10 * layers[:, 4]
    layers[:, 16] = 1 + 0.2 * layers[:, 16]
    none = np.zeros(2, dtype=bool)
    cameras = Cameras(np.tile(np.diag([30.0, 30, 1]), (2, 1, 1)), np.tile(np.eye(4), (2, 1, 1)), 48, 40)
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
        np.zeros(2, dtype=np.int64),
        cameras,
        ReferenceFrames(np.zeros((2, 40, 48, 3), np.uint8), np.ones((2, 40, 48), bool), cameras),
    )


def sources(kinds: tuple[str, ...] = ("phantom", "cavities"), count: int = 3) -> list[SceneSource]:
    return scene_sources(Namespace(kinds=list(kinds), size_factor=1, real_textures=False), count)


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    folder = tmp_path / "pretraining"
    for index, source in enumerate(sources()):
        small_scene(index).save(folder / source.file_name, origin=source.origin)
    return folder


def test_scenes_made_in_the_same_way_stay(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = sources()
    before = [(scenes / source.file_name).stat().st_mtime_ns for source in wanted]
    files = make_scenes(scenes, wanted, workers=1)
    assert [file.stat().st_mtime_ns for file in files] == before
    small_scene(1).save(files[1], origin="of another version")
    made: list[str] = []
    monkeypatch.setattr(command, "ProcessPoolExecutor", _Here)
    monkeypatch.setattr(command, "make_scene", lambda source, file: made.append(file.name))
    make_scenes(scenes, wanted, workers=1)
    assert made == ["cavities_00000.safetensors"]


def test_families_take_turns_and_do_not_share_numbers() -> None:
    names = [(source.family, source.index) for source in sources(("phantom", "cavities", "cavities"), 6)]
    assert names == [
        ("phantom", 0),
        ("cavities", 0),
        ("cavities", 1),
        ("phantom", 1),
        ("cavities", 2),
        ("cavities", 3),
    ]
    found = sources(count=6)
    assert len({source.seed for source in found}) == 6
    assert len({source.origin for source in found}) == 6
    assert SceneSource("cavities", 0, size_factor=2).origin != SceneSource("cavities", 0).origin


def test_scenes_alone_train_nothing(scenes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["pretrain", "--scenes-only", "--scenes-folder", str(scenes), "--scenes", "3"]
    assert main([*given, "--validation-scenes", "1"]) == 0
    assert "3 scenes in" in capsys.readouterr().out
    assert len(list(scenes.iterdir())) == 3


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
    assert "--kinds phantom cavities" in record["command"]
    assert record["machine"]["versions"]["torch"] == torch.__version__
    assert record["before"]["pretraining"]["iterations"] == 2
    assert EmbeddedEnhancer.load(second).network.widths == (48, 96, 160)
    assert not list(tmp_path.glob("*/checkpoint.safetensors"))


def test_any_setting_can_be_given_and_an_ended_training_goes_on(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["pretrain", "--out", str(tmp_path / "w"), "--scenes-folder", str(scenes), "--scenes", "3"]
    given += ["--validation-scenes", "1", "--batch", "2", "--without-perceptual", "--threads", "1"]
    given += ["--set", "channels=8,16,16", "--set", "most_seconds=0.001"]
    for made in (1, 2):
        assert main(given) == 0
        record = json.loads((tmp_path / "w" / "restorer.json").read_text())["record"]
        assert record["iterations_made"] == made
    assert (tmp_path / "w" / "checkpoint.safetensors").exists()
    assert "--set channels=8,16,16" in record["command"]
    assert main([*given, "--set", "drawn=1"]) == 2
    assert "drawn_share" in capsys.readouterr().err
    assert main([*given, "--set", "most_seconds=-1"]) == 2
    assert "most_seconds" in capsys.readouterr().err


def test_what_would_fail_after_hours_is_said_at_once(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "w"), "--scenes-folder", str(scenes)]
    assert main(["pretrain", *out, "--scenes", "3", "--validation-scenes", "3"]) == 2
    assert "none is left to train" in capsys.readouterr().err
    assert main(["pretrain", "--scenes-folder", str(scenes)]) == 2
    assert "--out" in capsys.readouterr().err
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
