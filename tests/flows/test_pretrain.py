from __future__ import annotations

import errno
import json
import os
import shlex
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.array_files import load_safetensors
from extrags.cameras import Cameras
from extrags.depth.completion import CompletionNetwork
from extrags.errors import CaptureError, DivergedError
from extrags.events import Progress, subscribed
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.network import build_network
from extrags.restoration.diffusion.pretraining import PretrainingConfig, check_settings, check_sizes
from extrags.restoration.hidden_depth.examples import HiddenDepthExamples
from extrags.restoration.refinement.refiner import Refiner
from extrags.restoration.surface_texture import SurfaceTexture
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene, ReferenceFrames
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, LAYER_CHANNELS, Layers
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.references import LightTransfer
from flows.cli import main
from flows.commands import pretrain_scenes
from flows.commands.options import Parser
from flows.commands.pretrain import _settings, add_arguments, for_scenes
from flows.commands.pretrain_folder import sole_training
from flows.commands.pretrain_refiner import examples_of, start_of_refiner
from flows.commands.pretrain_scenes import SceneSource, make_scenes, scene_sources
from tests.extrags.random_lpips import random_weights
from tests.extrags.restoration.test_hidden_depth import half_hidden


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


def sources(
    kinds: tuple[str, ...] = ("phantom", "cavities"), count: int = 3, exact_share: float = 0.0
) -> list[SceneSource]:
    return scene_sources(
        Namespace(
            kinds=list(kinds),
            first_scene=0,
            size_factor=1,
            real_textures=False,
            explored=False,
            exact_share=exact_share,
        ),
        count,
    )


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
    monkeypatch.setattr(pretrain_scenes, "ProcessPoolExecutor", _Here)
    monkeypatch.setattr(pretrain_scenes, "_on_one_thread", lambda job: job())
    monkeypatch.setattr(pretrain_scenes, "make_scene", lambda source, file: made.append(file.name))
    make_scenes(scenes, wanted, workers=1)
    assert made == ["cavities_00000.safetensors"]


def test_scenes_that_cannot_be_made_are_not_tried_again_by_the_same_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wanted = sources()
    tried: list[str] = []

    def attempt(source: SceneSource, file: Path) -> str | None:
        tried.append(file.stem)
        return "nothing is seen" if file.stem == wanted[1].file_name.split(".")[0] else None

    monkeypatch.setattr(pretrain_scenes, "ProcessPoolExecutor", _Here)
    monkeypatch.setattr(pretrain_scenes, "_on_one_thread", lambda job: job())
    monkeypatch.setattr(pretrain_scenes, "make_scene", attempt)
    folder = tmp_path / "none" / "yet"
    made = make_scenes(folder, wanted, workers=1)
    assert len(made) == len(wanted) - 1
    assert len(tried) == len(wanted)
    failed = wanted[1].file_name.split(".")[0]
    record = folder / f"{failed}.failed.json"
    assert json.loads(record.read_text())["reason"] == "nothing is seen"
    caplog.clear()
    assert make_scenes(folder, wanted, workers=1) == made
    assert tried.count(failed) == 1
    assert f"{failed}: left out, nothing is seen (an earlier attempt of this version, {record}" in caplog.text
    monkeypatch.setattr(pretrain_scenes, "__version__", "another")
    make_scenes(folder, wanted, workers=1)
    assert tried.count(failed) == 2
    monkeypatch.setattr(pretrain_scenes, "make_scene", lambda source, file: None)
    monkeypatch.setattr(pretrain_scenes, "__version__", "a third")
    make_scenes(folder, wanted, workers=1)
    assert not record.exists()


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
    assert SceneSource("phantom", 0, explored=True).origin != SceneSource("phantom", 0).origin
    assert sources(exact_share=0.5)[0].origin != SceneSource("phantom", 0).origin


def test_scenes_alone_train_nothing(scenes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Fewer than would validate by default.
    assert main(["pretrain", "--scenes-only", "--scenes-folder", str(scenes), "--scenes", "3"]) == 0
    assert "3 scenes in" in capsys.readouterr().out
    assert len(list(scenes.iterdir())) == 3


class TestScenesThatCannotBeMade:
    @pytest.fixture(autouse=True)
    def poor(self, scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The second of three scenes has yet to be made, and its reconstruction diverges."""
        (scenes / sources()[1].file_name).unlink()

        def diverged(*_given: object, **_named: object) -> PretrainingScene:
            raise DivergedError("pretraining-scene: the loss is not finite at iteration 3")

        monkeypatch.setattr(pretrain_scenes, "ProcessPoolExecutor", _Here)
        monkeypatch.setattr(pretrain_scenes, "_on_one_thread", lambda job: job())
        monkeypatch.setattr(SceneSource, "recording", lambda source: None)
        module = "extrags.restoration.training_data.pretraining_scenes.make_pretraining_scene"
        monkeypatch.setattr(module, diverged)

    def test_they_are_left_out(
        self,
        scenes: Path,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        common = ["pretrain", "--scenes-folder", str(scenes), "--scenes", "3", "--validation-scenes", "1"]
        assert main([*common, "--scenes-only"]) == 0
        assert "2 scenes in" in capsys.readouterr().out
        assert "cavities_00000: left out, pretraining-scene: the loss is not finite" in caplog.text
        given = ["--iterations", "1", "--batch", "1", "--without-perceptual", "--threads", "1"]
        given += ["--set", "channels=8,16,16", "--output", str(tmp_path / "w")]
        assert main([*common, *given]) == 0
        record = json.loads((tmp_path / "w" / "restorer.json").read_text())["record"]
        assert record["pretraining"]["scenes"] == 2

    def test_too_few_others_are_told(
        self, scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        common = ["pretrain", "--scenes-folder", str(scenes), "--without-perceptual"]
        given = ["--output", str(tmp_path / "w"), "--scenes", "3", "--validation-scenes", "2"]
        assert main([*common, *given]) != 0
        assert (
            "2 of 3 scenes could be made, and 2 are for validation; none is left" in capsys.readouterr().err
        )
        only = ["--scenes-only", "--kinds", "cavities", "--first-scene", "7", "--scenes", "2"]
        assert main([*common, *only]) != 0
        assert "0 of 2 scenes could be made; none is left" in capsys.readouterr().err

    def test_processes_are_as_many_as_the_scenes_at_most(self) -> None:
        config = PretrainingConfig(scenes=9, validation_scenes=2, drawing_processes=7)
        fewer = for_scenes(config, 5)
        assert (fewer.scenes, fewer.drawing_processes) == (5, 3)
        assert for_scenes(config, 9) == config


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
    assert main(["pretrain", "--output", str(first), "--iterations", "2", *common]) == 0
    out = capsys.readouterr().out
    assert "embedded_1" in out
    assert (
        main(["pretrain", "--output", str(second), "--iterations", "1", "--start", str(first), *common]) == 0
    )
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
    given = ["pretrain", "--output", str(tmp_path / "w"), "--scenes-folder", str(scenes), "--scenes", "3"]
    given += ["--validation-scenes", "1", "--batch", "2", "--without-perceptual", "--threads", "1"]
    given += ["--set", "channels=8,16,16", "--set", "most_seconds=0.001"]
    for made in (1, 2):
        assert main(given) == 0
        record = json.loads((tmp_path / "w" / "restorer.json").read_text())["record"]
        assert record["iterations_made"] == made
    assert (tmp_path / "w" / "checkpoint.safetensors").exists()
    assert "--set channels=8,16,16" in record["command"]
    # The command of the beginning, and those that went on.
    assert main([*given, "--iterations", "700"]) == 0
    record = json.loads((tmp_path / "w" / "restorer.json").read_text())["record"]
    assert "--iterations" not in record["command"]
    first, second = record["resumed"]
    assert "--iterations" not in first["command"]
    assert "--iterations 700" in second["command"]
    # How busy it was differs from command to command.
    loads = [made["machine"].pop("load_average") for made in (second, record)]
    assert min(loads) >= 0
    assert second["machine"] == record["machine"]
    assert main([*given, "--set", "drawn=1"]) == 2
    assert "drawn_share" in capsys.readouterr().err
    assert main([*given, "--set", "most_seconds=-1"]) == 2
    assert "most_seconds" in capsys.readouterr().err


def test_two_trainings_do_not_write_into_one_folder(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each went on from, and wrote over, the checkpoint of the other. One that was killed is no hindrance."""
    given = ["pretrain", "--output", str(tmp_path / "w"), "--scenes-folder", str(scenes), "--scenes", "3"]
    given += ["--validation-scenes", "1", "--batch", "1", "--without-perceptual", "--threads", "1"]
    given += ["--set", "channels=8,16,16", "--iterations", "1"]
    (tmp_path / "w").mkdir()
    code = (
        "import sys, time; from pathlib import Path\n"
        "from flows.commands.pretrain_folder import sole_training\n"
        "with sole_training(Path(sys.argv[1])): print('has it', flush=True); time.sleep(600)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "w")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "has it\n"
            assert main(given) == 2
            said = capsys.readouterr().err
            assert f"--output {tmp_path / 'w'}: another training writes there now" in said
            # Scenes alone write nothing there.
            assert main([*given, "--scenes-only"]) == 0
        finally:
            other.kill()
    assert main(given) == 0
    assert {file.name for file in (tmp_path / "w").iterdir()} == {"restorer.json", "restorer.safetensors"}


def test_a_folder_that_cannot_be_locked_is_trained_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def without_locks(*_given: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("tasks.locks.fcntl.flock", without_locks)
    with sole_training(tmp_path):
        assert "cannot be locked against a second training: No locks available" in caplog.text


def test_finished_weights_are_not_overwritten(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Who gives more steps means to go on, and there is no checkpoint any more."""
    given = ["pretrain", "--output", str(tmp_path / "w"), "--scenes-folder", str(scenes), "--scenes", "3"]
    given += ["--validation-scenes", "1", "--batch", "1", "--without-perceptual", "--threads", "1"]
    given += ["--set", "channels=8,16,16"]
    assert main([*given, "--iterations", "1"]) == 0
    before = (tmp_path / "w" / "restorer.json").read_bytes()
    capsys.readouterr()
    assert main([*given, "--iterations", "2"]) == 2
    assert "a finished restorer is there, and no checkpoint to go on from" in capsys.readouterr().err
    assert (tmp_path / "w" / "restorer.json").read_bytes() == before
    # Scenes alone overwrite nothing.
    assert main([*given, "--scenes-only"]) == 0
    (tmp_path / "w" / "restorer.json").unlink()
    assert main([*given, "--iterations", "2"]) == 0


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--set", "drawn_share=0.5"], "setting drawn_share: nothing draws without --generative"),
        (["--set", "patch_px=32"], "setting patch_px: nothing draws without --generative"),
        (["--perceptual-weight", "0.5"], "setting perceptual_weight: there is no such distance"),
        (["--kinds", "phantom", "--size-factor", "2"], "--size-factor are for cavities"),
    ],
)
def test_options_without_effect_are_refused(
    options: list[str],
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def too_late(*_: object) -> None:
        raise AssertionError("scenes were made")

    monkeypatch.setattr("flows.commands.pretrain.make_scenes", too_late)
    given = ["pretrain", "--output", str(tmp_path / "w"), "--scenes-folder", str(tmp_path / "s")]
    assert main([*given, "--without-perceptual", *options]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_what_would_fail_after_hours_is_said_at_once(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--output", str(tmp_path / "w"), "--scenes-folder", str(scenes)]
    assert main(["pretrain", *out, "--scenes", "3", "--validation-scenes", "3"]) == 2
    assert "none is left to train" in capsys.readouterr().err
    assert main(["pretrain", "--scenes-folder", str(scenes)]) == 2
    assert "--output" in capsys.readouterr().err
    assert main(["pretrain", *out, "--workers", "0"]) == 2
    assert "--workers 0" in capsys.readouterr().err
    refused = "extrags pretrain: setting learning_rate is -1.0; expected a number above 0\n"
    assert main(["pretrain", *out, "--learning-rate", "-1"]) == 2
    assert capsys.readouterr().err.endswith(refused)
    assert main(["pretrain", *out, "--generative", "--without-perceptual"]) == 2
    told = capsys.readouterr().err
    assert "extrags pretrain: generative needs the perceptual distance" in told
    assert "validation error" not in told
    (tmp_path / "file").write_text("")
    assert main(["pretrain", "--output", str(tmp_path / "file" / "w"), "--without-perceptual"]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_settings_that_do_not_fit_are_told_before_a_scene_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_late(*_: object) -> None:
        raise AssertionError("scenes were made")

    monkeypatch.setattr("flows.commands.pretrain.make_scenes", too_late)
    given = ["pretrain", "--output", str(tmp_path / "w"), "--scenes-folder", str(tmp_path / "scenes")]
    given += ["--scenes", "3", "--validation-scenes", "1", "--without-perceptual"]
    assert main([*given, "--set", "drawing_processes=3"]) == 2
    assert "there are 2 scenes to train on" in capsys.readouterr().err
    # Phantoms of 176 x 112 px are among them.
    assert main([*given, "--scenes", "30", "--set", "crop=128"]) == 2
    assert "crop=128: images of some scenes (176x112 px) are too small for it" in capsys.readouterr().err
    network = build_network(CONDITION_CHANNELS, (8, 16, 16), torch.Generator().manual_seed(1))
    start = EmbeddedEnhancer(network, 1, 1, 0, False, Gamut(0.0, 1e6, 0.0, 1e6), {})
    start.save(tmp_path / "start")
    assert main([*given, "--start", str(tmp_path / "start")]) == 2
    assert "the weights to start from have channels (8, 16, 16)" in capsys.readouterr().err


def test_documented_trainings_fit_their_scenes() -> None:
    document = Path(__file__).parents[2] / "docs" / "restorer_weights.md"
    lines = [line for line in document.read_text().splitlines() if line.startswith("extrags pretrain ")]
    others = ("--refiner", "--hidden-depth", "--scenes-only")
    commands = [line for line in lines if not any(option in line for option in others)]
    assert any("--generative" in command for command in commands)
    for command in commands:
        parser = Parser()
        add_arguments(parser)
        given = parser.parse_args(shlex.split(command)[2:])
        config = _settings(given)
        scenes = [source.config for source in scene_sources(given, config.scenes)]
        check_settings(config.model_copy(update={"device": "cpu"}), None)
        check_sizes(config, [(scene.height, scene.width) for scene in scenes])


def test_the_weights_of_the_package_say_where_they_come_from() -> None:
    from extrags.restoration.diffusion.weights import BUNDLED, PACKAGED, find_weights

    found = find_weights(BUNDLED)
    assert len(found) == len(PACKAGED)
    for weights, name in zip(found, PACKAGED, strict=True):
        description = json.loads(weights.with_suffix(".json").read_text())
        assert description["trained_on"] == name
        record = description["record"]
        assert record["command"].startswith("extrags pretrain ")
        assert record["before"]["command"].startswith("extrags pretrain ")
        scores = record["validation_scores"]
        restored, filled = scores["embedded_1"], scores["classical"]
        assert restored["psnr"] > filled["psnr"]
        assert restored["psnr_hole"] > filled["psnr_hole"] + 0.5
    assert sum(weights.stat().st_size for weights in found) < 25_000_000


class TestRefiner:
    @pytest.fixture(autouse=True)
    def random_perception(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """LPIPS with random weights: those of SqueezeNet are not shipped."""
        from extrags.metrics import lpips_weights

        monkeypatch.setattr(Lpips, "load", lambda **_given: Lpips("alex", random_weights("alex")))
        monkeypatch.setattr(lpips_weights, "find_weights", lambda *_given: ())

    @pytest.fixture
    def given(self, tmp_path: Path) -> list[str]:
        folder = tmp_path / "pretraining"
        generator = torch.Generator().manual_seed(0)
        for index, source in enumerate(sources()):
            tiles = torch.randn(16, 3, 32, 32, generator=generator) * 0.2
            # One scene is seen too poorly to give texture.
            texture = None if index == 1 else SurfaceTexture(tiles, 0.5)
            replace(small_scene(index), texture=texture).save(folder / source.file_name, origin=source.origin)
        common = ["--scenes-folder", str(folder), "--scenes", "3", "--validation-scenes", "1", "--batch", "1"]
        return ["pretrain", "--refiner", *common, "--threads", "1", "--iterations", "2", "--set", "crop=64"]

    def test_it_is_trained_on_restored_views_of_the_scenes(
        self,
        given: list[str],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        out = tmp_path / "refiner"
        assert main([*given, "--output", str(out)]) == 0
        assert "textured" in capsys.readouterr().out
        assert "cavities_00000.safetensors: left out" in caplog.text
        record = Refiner.load(out).record
        assert record["iterations_made"] == 2
        assert "--refiner" in record["command"]
        assert len(record["restorer"]) == 32
        assert set(record["validation_scores"]) == {"smooth", "textured", "refined"}
        kept = sorted((tmp_path / "pretraining" / "refinement").iterdir())
        assert len(kept) == 2
        before = [file.stat().st_mtime_ns for file in kept]
        assert main([*given, "--output", str(tmp_path / "again")]) == 0
        assert [file.stat().st_mtime_ns for file in kept] == before

    def test_weights_of_another_kind_are_not_overwritten(
        self, given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Restorers and refiners have descriptions of one name."""
        refiner, restorer = tmp_path / "refiner", tmp_path / "restorer"
        plain = [item for item in given if item not in ("--refiner", "--set", "crop=64")]
        plain += ["--without-perceptual", "--set", "channels=8,16,16"]
        assert main([*given, "--output", str(refiner)]) == 0
        assert main([*plain, "--output", str(restorer)]) == 0
        capsys.readouterr()
        for arguments, folder in (plain, refiner), (given, restorer):
            before = (folder / "restorer.json").read_bytes()
            assert main([*arguments, "--output", str(folder)]) == 2
            assert f"--output {folder}: restorer.json there" in capsys.readouterr().err
            assert (folder / "restorer.json").read_bytes() == before
        assert Refiner.load(refiner).record["iterations_made"] == 2
        assert EmbeddedEnhancer.load(restorer).record["iterations_made"] == 2
        # Its own kind may be trained anew.
        assert main([*given, "--output", str(refiner)]) == 0

    def test_a_scene_without_texture_is_done_too(self, tmp_path: Path) -> None:
        file = tmp_path / "scene.safetensors"
        small_scene(0).save(file)
        told: list[object] = []
        with subscribed(told.append):
            assert examples_of([file], start_of_refiner("colons")) == []
        assert told[-1] == Progress("refiner-examples", 1, 1)

    def test_what_a_scene_told_a_restorer_is_forgotten(self, tmp_path: Path) -> None:
        start_of_refiner("colons").restorer.cloning_seamlessly().save(tmp_path)
        assert not start_of_refiner(str(tmp_path)).restorer.seamless

    def test_wrong_settings_are_named(
        self, given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = ["--output", str(tmp_path / "refiner")]
        assert main([*given, *out, "--set", "drawn_share=0.3"]) == 2
        assert "adversarial_weight" in capsys.readouterr().err
        assert main([*given, *out, "--learning-rate", "-1"]) == 2
        assert "learning_rate" in capsys.readouterr().err
        for start in ("none", "bundled", str(tmp_path / "typo")):
            assert main([*given, *out, "--start", start]) == 2
            assert f"--start {start}" in capsys.readouterr().err
        for option in ("--generative", "--deterministic", "--without-perceptual"):
            assert main([*given, *out, option]) == 2
            assert option in capsys.readouterr().err
        assert main([*given, *out, "--first-scene", "-1"]) == 2
        assert "--first-scene -1" in capsys.readouterr().err
        assert main([*given, *out, "--exact-share", "1.5"]) == 2
        assert "--exact-share 1.5" in capsys.readouterr().err


def test_scenes_can_begin_at_a_number() -> None:
    given = Namespace(
        kinds=["phantom", "cavities"],
        first_scene=7,
        size_factor=1,
        real_textures=False,
        explored=True,
        exact_share=0.5,
    )
    assert [source.index for source in scene_sources(given, 4)] == [7, 7, 8, 8]


class TestHiddenDepth:
    @pytest.fixture
    def given(self, tmp_path: Path) -> list[str]:
        common = ["--scenes-folder", str(tmp_path / "scenes"), "--scenes", "3", "--validation-scenes", "1"]
        return ["pretrain", "--hidden-depth", *common, "--threads", "1", "--iterations", "2", "--batch", "2"]

    def test_scenes_are_explored_and_the_network_trained(
        self,
        given: list[str],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        caplog: pytest.LogCaptureFixture,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        made: list[str] = []

        def explored(recording: str, *_given: object) -> HiddenDepthExamples:
            made.append(recording)
            if recording == "cavities 0":
                raise CaptureError("nothing to explore")
            return half_hidden(len(made))

        monkeypatch.setattr(pretrain_scenes, "ProcessPoolExecutor", _Here)
        monkeypatch.setattr(pretrain_scenes, "_on_one_thread", lambda job: job())
        monkeypatch.setattr(
            SceneSource, "recording", lambda source, *, to_restore: f"{source.family} {source.index}"
        )
        monkeypatch.setattr(HiddenDepthExamples, "of_recording", explored)
        out = tmp_path / "reader"
        assert main([*given, "--output", str(out)]) == 0
        assert made == ["phantom 0", "cavities 0", "phantom 1"]
        assert "trained" in capsys.readouterr().out
        assert "cavities_00000: left out" in caplog.text
        record = json.loads((out / "hidden.json").read_text())
        assert "--hidden-depth" in record["command"]
        assert record["scenes"] == 2
        assert len(record["restorer"]) == len(record["completion"]) == 32
        weights = load_safetensors(out / "hidden.safetensors")
        CompletionNetwork().load_state_dict({name: value.float() for name, value in weights.items()})
        # Whoever may read the record may read the weights.
        assert (out / "hidden.safetensors").stat().st_mode == (out / "hidden.json").stat().st_mode
        # What could be explored is kept, and why the other could not.
        caplog.clear()
        assert main([*given, "--output", str(tmp_path / "again")]) == 0
        assert made[3:] == []
        failure = tmp_path / "scenes" / "hidden_depth" / "cavities_00000.failed.json"
        assert (
            f"cavities_00000: left out, nothing to explore (an earlier attempt of this version, {failure}"
            in (caplog.text)
        )
        monkeypatch.setattr(pretrain_scenes, "__version__", "another")
        assert main([*given, "--output", str(tmp_path / "later")]) == 0
        assert made[3:] == ["cavities 0"]

    def test_wrong_settings_are_named(
        self, given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = ["--output", str(tmp_path / "reader")]
        assert main([*given, *out, "--set", "drawn_share=0.3"]) == 2
        assert "slope_weight" in capsys.readouterr().err
        assert main([*given, *out, "--learning-rate", "-1"]) == 2
        assert "learning_rate" in capsys.readouterr().err
        for start in ("none", "bundled", str(tmp_path / "typo")):
            assert main([*given, *out, "--start", start]) == 2
            assert f"--start {start}" in capsys.readouterr().err
        for completion in ("none", str(tmp_path / "typo")):
            assert main([*given, *out, "--set", f"completion={completion}"]) == 2
            assert f"completion={completion}" in capsys.readouterr().err
        refused = ["--generative", "--deterministic", "--refiner", "--without-perceptual"]
        for option in ([name] for name in refused):
            assert main([*given, *out, *option]) == 2
            assert option[0] in capsys.readouterr().err
        assert main([*given, *out, "--perceptual-weight", "1"]) == 2
        assert "--perceptual-weight" in capsys.readouterr().err

    def test_the_weights_of_the_package_say_where_they_come_from(self) -> None:
        weights = Path(str(files("extrags.depth.weights"))) / "hidden.safetensors"
        assert weights.stat().st_size < 5_000_000
        record = json.loads(weights.with_suffix(".json").read_text())
        assert "--hidden-depth" in record["command"]
        scores = record["validation_scores"]
        assert scores["trained"]["error"] < 0.8 * scores["before"]["error"] < scores["smooth"]["error"]
