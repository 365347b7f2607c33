"""Saved monocular networks: found, told apart by their content, refused with a sentence, run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from extrags.config import DepthConfig
from extrags.depth.estimate import estimate_depth
from extrags.depth.monocular_network import (
    Preparation,
    find_monocular,
    load_monocular,
    monocular_digest,
)
from extrags.errors import MissingDependencyError, WeightsError
from tests.extrags.depth.tiny_monocular import PREPROCESSOR, save_depth_anything, save_dpt
from tests.extrags.depth.withheld import with_points, withheld_phantom

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("transformers", reason="transformers is not installed")
    folder = tmp_path_factory.mktemp("saved") / "depth-anything"
    save_depth_anything(folder)
    return folder


@pytest.fixture
def changed(saved: Path, tmp_path: Path) -> Callable[..., Path]:
    """A copy with other entries in its configuration or preprocessor; None removes one."""

    def copy(file: str, **entries: object) -> Path:
        folder = tmp_path / "changed"
        shutil.copytree(saved, folder)
        content = json.loads((folder / file).read_text()) | entries
        (folder / file).write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
        return folder

    return copy


def test_it_runs_as_transformers_does(saved: Path) -> None:
    from transformers import AutoModelForDepthEstimation

    rgb = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(0))
    network = load_monocular(str(saved), CPU)
    found = network.inverse_depth(rgb)
    assert found.shape == (30, 40)
    assert found.std() > 0
    model = AutoModelForDepthEstimation.from_pretrained(saved).eval()
    with torch.no_grad():
        expected = model(pixel_values=network.preparation(rgb)).predicted_depth
    assert expected.shape[1:] == network.preparation.target(30, 40) == (28, 42)
    expected = torch.nn.functional.interpolate(expected[:, None], (30, 40), mode="bilinear")[0, 0]
    assert torch.allclose(found, expected)


def test_images_are_prepared_as_transformers_does(saved: Path) -> None:
    import numpy as np
    from PIL import Image
    from transformers.models.dpt.image_processing_pil_dpt import DPTImageProcessorPil

    pixels = np.random.default_rng(0).integers(80, 176, (61, 83, 3), dtype=np.uint8)
    expected = DPTImageProcessorPil.from_pretrained(saved)(Image.fromarray(pixels), return_tensors="pt")
    ours = Preparation.read(saved / "preprocessor_config.json")(
        torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
    )
    assert ours.shape == expected["pixel_values"].shape
    # Pillow rounds to whole grey levels after each direction: a level is 0.017 to 0.018 here.
    assert (ours - expected["pixel_values"]).abs().max() < 0.06
    assert (ours - expected["pixel_values"]).abs().mean() < 0.01


def test_metric_depth_is_inverted(tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="transformers is not installed")
    save_depth_anything(tmp_path, "metric")
    rgb = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(0))
    network = load_monocular(str(tmp_path), CPU)
    assert network.gives_depth
    with torch.no_grad():
        depth = network.model(pixel_values=network.preparation(rgb)).predicted_depth
    inverse = network.inverse_depth(rgb)
    assert 1 / depth.max() * 0.999 <= inverse.min() < inverse.max() <= 1 / depth.min() * 1.001


def test_dpt_is_one_of_them(tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="transformers is not installed")
    save_dpt(tmp_path)
    found = load_monocular(str(tmp_path), CPU).inverse_depth(torch.rand(3, 42, 42))
    assert torch.isfinite(found).all()


def test_the_stage_runs_with_it(saved: Path) -> None:
    part = with_points(withheld_phantom(3, width=48, height=40)).training_part()
    settings = DepthConfig(hypotheses=16, sources=2, completion="none", monocular=str(saved))
    found = estimate_depth(part, settings)
    assert len(found.report["monocular"]) == 1
    assert (found.depth[part.mask] > 0).all()


@pytest.mark.parametrize(
    ("size", "keep", "expected"),
    [((518, 518), True, (518, 686)), ((518, 518), False, (518, 518)), (None, True, (480, 640))],
)
def test_sizes(size: tuple[int, int] | None, keep: bool, expected: tuple[int, int]) -> None:
    preparation = Preparation(size, keep, 14 if size else 1, "bicubic", (0.0,) * 3, (1.0,) * 3, 1.0)
    assert preparation.target(480, 640) == expected


class TestDigest:
    def test_it_is_that_of_the_content(self, saved: Path, changed: Callable[..., Path]) -> None:
        assert monocular_digest(None) is None
        folder = changed("config.json")
        before = json.loads((saved / "config.json").read_text())
        (folder / "config.json").write_bytes((saved / "config.json").read_bytes())
        (folder / "preprocessor_config.json").write_bytes((saved / "preprocessor_config.json").read_bytes())
        assert monocular_digest(str(folder)) == monocular_digest(str(saved))
        (folder / "config.json").write_text(json.dumps(before | {"max_depth": 3}))
        assert monocular_digest(str(folder)) != monocular_digest(str(saved))


class TestRefused:
    def test_without_transformers(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError, match=r"pip install -e '\.\[monocular\]'"):
            find_monocular(str(tmp_path))

    def test_no_folder(self, saved: Path, tmp_path: Path) -> None:
        with pytest.raises(WeightsError, match=r"depth\.monocular=.*there is no such folder"):
            find_monocular(str(tmp_path / "absent"))

    @pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "model.safetensors"])
    def test_a_missing_file(self, changed: Callable[..., Path], name: str) -> None:
        folder = changed("config.json")
        (folder / name).unlink()
        with pytest.raises(WeightsError, match=name):
            find_monocular(str(folder))

    def test_another_architecture(self, changed: Callable[..., Path]) -> None:
        folder = changed("config.json", architectures=["DPTForSemanticSegmentation"])
        with pytest.raises(WeightsError, match="names DPTForSemanticSegmentation; expected one of DepthAny"):
            find_monocular(str(folder))

    def test_an_unknown_preprocessor(self, changed: Callable[..., Path]) -> None:
        with pytest.raises(WeightsError, match="do_pad is not supported"):
            find_monocular(str(changed("preprocessor_config.json", do_pad=True)))

    def test_a_damaged_configuration(self, changed: Callable[..., Path]) -> None:
        folder = changed("config.json")
        (folder / "config.json").write_text("{")
        with pytest.raises(WeightsError, match="not readable as JSON"):
            find_monocular(str(folder))

    def test_weights_that_lack_tensors(self, changed: Callable[..., Path]) -> None:
        folder = changed("config.json")
        tensors = load_file(folder / "model.safetensors")
        tensors.pop(sorted(tensors)[0])
        save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
        with pytest.raises(WeightsError, match="lack 1 tensors of the network"):
            load_monocular(str(folder), CPU)


def test_the_preprocessor_is_read_whole(saved: Path) -> None:
    found = Preparation.read(saved / "preprocessor_config.json")
    assert (found.size, found.multiple, found.mode, found.unit) == ((42, 42), 14, "bicubic", 1.0)
    assert list(found.mean) == PREPROCESSOR["image_mean"]
