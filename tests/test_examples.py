"""Every program in `examples/` runs, on a phantom so small that it takes seconds."""

from __future__ import annotations

import importlib.util
import runpy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

import extrags
from data_catalog.phantom.config import PhantomConfig
from extrags.events import Event, subscribed
from extrags.metrics.registry import unregister_metric
from extrags.restoration import backends
from tests.flows.tiny import GIVEN, SEQUENCE, spared, tiny_config

FAST = tiny_config(enhance__pretrained_weights="bundled", enhance__train_iterations=0, enhance__judge=False)
"""The bundled restorer as it is, neither trained nor judged on the scene."""

SCENE = int(SEQUENCE.split("/")[1].split("@")[0])

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def example(name: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", autouse=True)
def little_work() -> Iterator[None]:
    with spared():
        yield


@pytest.fixture(scope="module")
def finished(little_work: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[extrags.Result, Path]:
    """The whole job, once for all tests."""
    ply = tmp_path_factory.mktemp("examples") / "scene.ply"
    return example("whole_job").whole_job(SEQUENCE, ply, FAST), ply


def test_every_example_is_tested() -> None:
    tested = Path(__file__).read_text(encoding="utf-8")
    for file in EXAMPLES.glob("*.py"):
        assert f'example("{file.stem}")' in tested, f"{file.name} has no test"


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        *((file.stem, given) for file in sorted(EXAMPLES.glob("*.py")) for given in ([], 4 * ["x"])),
        ("video_of_a_phantom", ["exam.mp4", "three"]),
        ("frames_to_flythrough", ["frames/", "way.mp4"]),
    ],
)
def test_wrong_arguments_show_the_right_ones(
    name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["", *arguments])
    with pytest.raises(SystemExit, match=f"python examples/{name}.py"):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


@pytest.mark.parametrize(
    ("name", "target", "begins"),
    [("whole_job", "scene.ply", "extrags.run_pipeline"), ("frames_to_flythrough", "way.gif", "extrags.read")],
)
def test_the_folder_of_the_result_is_there_before_the_work(
    name: str, target: str, begins: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was missed after all stages, and the scene was lost."""
    monkeypatch.setattr(begins, Mock(side_effect=InterruptedError))
    monkeypatch.setattr("sys.argv", ["", SEQUENCE, str(tmp_path / "results" / target)])
    if name == "whole_job":
        monkeypatch.setattr("extrags.read", Mock())
    with pytest.raises(InterruptedError):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert (tmp_path / "results").is_dir()


class TestWholeJob:
    def test_every_stage_has_its_product(self, finished: tuple[extrags.Result, Path]) -> None:
        result, ply = finished
        assert result.skipped == GIVEN
        assert result.pseudo_views is not None
        assert result.finetuning is not None
        assert set(result.evaluations) == {"coarse", "final", "restored"}
        assert len(extrags.Gaussians.read_ply(ply)) == len(result.scene.gaussians)

    def test_progress_can_be_followed(self) -> None:
        seen: list[Event] = []
        sequence = extrags.read(SEQUENCE, FAST.ingest)
        with subscribed(seen.append):
            extrags.run_pipeline(sequence, tiny_config(), until="coarse")
        assert {event.stage for event in seen} == {"coarse"}


def test_frames_to_flythrough(tmp_path: Path) -> None:
    module = example("frames_to_flythrough")
    scene, cameras = module.reconstructed(SEQUENCE, FAST)
    frames = module.flythrough(scene, cameras[:3], tmp_path / "way.gif", views_between=2)
    assert len(frames) == 5
    with Image.open(tmp_path / "way.gif") as image:
        assert image.size == (48, 40)
        assert image.n_frames == 5


def test_video_of_a_phantom(tmp_path: Path) -> None:
    """It is read as any video, and shows the colon of that number."""
    module = example("video_of_a_phantom")
    file = tmp_path / "recordings" / "exam.mp4"
    config = PhantomConfig(width=48, height=40, video_frames=24, supersample=1)
    module.main(file, SCENE, config)
    read = extrags.read(str(file), extrags.PROFILES["quick"].ingest)
    assert read.rgb.shape[1:] == (40, 48, 3)
    truth = extrags.read(SEQUENCE, FAST.ingest)
    # Frames of one passage through one colon: the same light and tissue in the mean.
    shown = truth.rgb[truth.train].mean(axis=(0, 1, 2))
    np.testing.assert_allclose(read.rgb.mean(axis=(0, 1, 2)), shown, rtol=0.1)


def test_explore_a_ply(finished: tuple[extrags.Result, Path], tmp_path: Path) -> None:
    _, ply = finished
    module = example("explore_a_ply")
    found = module.explore_ply(ply, SEQUENCE, tmp_path / "views", FAST)
    assert len(found) > 0
    assert len(list((tmp_path / "views").glob("*.png"))) == len(found)


def test_restore_with_another_model(
    monkeypatch: pytest.MonkeyPatch, finished: tuple[extrags.Result, Path], tmp_path: Path
) -> None:
    module = example("restore_with_another_model")
    # A registration lasts as long as the process: it is taken back after the test.
    monkeypatch.setitem(backends.BACKENDS, "telea", None)
    monkeypatch.delitem(backends.BACKENDS, "telea")
    extrags.register_backend(module.TeleaBackend(), "inpainting by fast marching")
    result = module.restored_with_telea(SEQUENCE, FAST)
    views, (known, _) = result.pseudo_views, finished
    assert views is not None
    assert known.pseudo_views is not None
    assert len(views) == len(known.pseudo_views)
    assert views.provenance["backend"] == "telea"
    module.TeleaEnhancer().save(tmp_path)
    assert isinstance(backends.load_enhancer(tmp_path), module.TeleaEnhancer)


def test_custom_metric() -> None:
    module = example("custom_metric")
    extrags.register_metric(module.CHROMA_ERROR)
    try:
        result = module.evaluated(SEQUENCE, FAST)
    finally:
        unregister_metric(module.CHROMA_ERROR.key)
    assert 0 < result.metrics["chroma_error"] < 0.2
    assert 0 < result.metrics["aligned"]["chroma_error"] < 0.2


def test_custom_metric_where_nobody_knows_what_was_observed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of frames with poses alone it ended in a traceback, after the reconstruction."""
    module = example("custom_metric")
    plain = replace(extrags.read(SEQUENCE, FAST.ingest), depth_mm=None, observed=None)
    monkeypatch.setattr(module.extrags, "read", lambda *_: plain)
    extrags.register_metric(module.CHROMA_ERROR)
    try:
        module.evaluated("frames with poses", FAST)
    finally:
        unregister_metric(module.CHROMA_ERROR.key)
    assert "observed surface" not in capsys.readouterr().out
