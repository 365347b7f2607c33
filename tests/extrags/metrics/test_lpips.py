"""LPIPS against published figures, and where its weights are looked for."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from extrags.config import EvaluateConfig, LpipsNet
from extrags.errors import ConfigError, ShapeError, WeightsError
from extrags.metrics import lpips as lpips_module
from extrags.metrics import lpips_weights as weights_module
from extrags.metrics.lpips import Lpips, TargetActivations, available_lpips
from extrags.metrics.lpips_weights import (
    WEIGHTS_VARIABLE,
    absent_parts,
    check_weights,
    download_backbone,
    find_weights,
    read_weights,
)
from tests.extrags.random_lpips import random_weights


@pytest.fixture(scope="module")
def weights_folder(shared_data: Path) -> Path:
    return shared_data / "lpips_weights"


@pytest.fixture(scope="module")
def alex(weights_folder: Path) -> Lpips:
    return Lpips.load(weights_folder, "alex")


def example(folder: Path, name: str) -> torch.Tensor:
    from PIL import Image

    with Image.open(folder / name) as image:
        return torch.from_numpy(np.asarray(image.convert("RGB"), dtype=np.float32) / 255)


def random_pair(n: int, height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(n, height, width, 3, generator=generator)
    return first, (first + 0.2 * torch.randn(n, height, width, 3, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize(
    ("net", "far", "near", "doctest"),
    [
        ("alex", 0.7218807, 0.1375656, (0.1311690, 0.1419626)),
        # The weights at hand are rounded to 16 bits.
        ("vgg", 0.5686128, 0.4216643, None),
        ("squeeze", 0.7110476, 0.1479016, (0.1023802, 0.0937736)),
    ],
)
def test_published_figures(
    weights_folder: Path, net: LpipsNet, far: float, near: float, doctest: tuple[float, float] | None
) -> None:
    metric = Lpips.load(weights_folder / f"lpips_{net}_v0.1.npz", net)
    reference = example(weights_folder, "ex_ref.png")
    assert float(metric.distance(reference, example(weights_folder, "ex_p0.png"))) == pytest.approx(
        far, abs=2e-5
    )
    assert float(metric.distance(reference, example(weights_folder, "ex_p1.png"))) == pytest.approx(
        near, abs=2e-5
    )
    if doctest is None:
        return
    generator = torch.Generator().manual_seed(42)
    first = torch.rand(2, 3, 100, 100, generator=generator).movedim(1, -1)
    second = torch.rand(2, 3, 100, 100, generator=generator).movedim(1, -1)
    assert metric.distance(first, second).tolist() == pytest.approx(doctest, abs=2e-5)


def test_vgg_against_a_figure_published_by_torchmetrics(weights_folder: Path) -> None:
    metric = Lpips.load(weights_folder, "vgg")
    rng = np.random.RandomState(123)
    first, second = (torch.from_numpy(rng.rand(10, 3, 100, 100)).float().movedim(1, -1) for _ in range(2))
    with torch.inference_mode():
        assert float(metric.distance(first, second).mean()) == pytest.approx(0.3494, abs=5e-5)


def test_map_has_image_size_and_points_at_the_change(alex: Lpips) -> None:
    first, _ = random_pair(1, 96, 128)
    second = first.clone()
    second[0, 60:90, 80:120] = 0
    error = alex.distance_map(first, second)
    assert error.shape == (1, 96, 128)
    assert float(error.min()) >= 0
    assert float(error[0, 62:88, 82:118].mean()) > 10 * float(error[0, :30, :30].mean())
    assert float(alex.distance_map(first, first).max()) == 0


def test_regions(alex: Lpips) -> None:
    first, second = random_pair(2, 64, 80)
    everything = torch.ones(2, 64, 80, dtype=torch.bool)
    left = everything.clone()
    left[:, :, 40:] = False
    left[1] = False
    found = alex.regional_distances(first, second, {"all": everything, "left": left})
    assert found["all"] == pytest.approx(alex.distance(first, second).tolist(), abs=1e-6)
    assert found["left"][1] is None
    changed = first.clone()
    changed[0, :, :30] = 0.5
    halves = alex.regional_distances(first, changed, {"left": left, "right": everything & ~left})
    assert halves["left"][0] is not None
    assert halves["right"][0] is not None
    assert halves["left"][0] > 3 * halves["right"][0]


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_kept_activations_of_the_targets_change_no_bit(net: LpipsNet) -> None:
    lpips = Lpips(net, random_weights(net))
    target, first = random_pair(2, 64, 80)
    regions = {
        "all": torch.ones(2, 64, 80, dtype=torch.bool),
        "left": torch.zeros(2, 64, 80, dtype=torch.bool),
    }
    regions["left"][:, :, :40] = True
    kept = TargetActivations(target)
    for render in (first, 0.5 * first, target):
        alone = lpips.regional_distances(render, target, regions)
        assert lpips.regional_distances(render, target, regions, kept) == alone
    assert alone == {"all": [0, 0], "left": [0, 0]}


def test_differences_in_parts_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    lpips = Lpips("alex", random_weights("alex"))
    first, second = random_pair(2, 64, 80)
    whole = lpips.distance_map(first, second)
    monkeypatch.setattr(lpips_module, "_VALUES_AT_ONCE", 7000)
    torch.testing.assert_close(lpips.distance_map(first, second), whole, atol=1e-6, rtol=1e-5)


def test_batches_longer_than_a_chunk_change_nothing(alex: Lpips) -> None:
    first, second = random_pair(18, 32, 40)
    together = alex.distance(first.reshape(2, 9, 32, 40, 3), second.reshape(2, 9, 32, 40, 3))
    alone = torch.stack([alex.distance(a, b) for a, b in zip(first, second, strict=True)])
    torch.testing.assert_close(together.reshape(-1), alone, atol=1e-6, rtol=1e-5)


def test_has_a_gradient(alex: Lpips) -> None:
    first, second = random_pair(1, 32, 32)
    first.requires_grad_(True)
    alex.distance(first, second).sum().backward()
    assert first.grad is not None
    assert float(first.grad.abs().max()) > 0


def test_small_images_are_refused(alex: Lpips) -> None:
    first, second = random_pair(1, 31, 64)
    with pytest.raises(ShapeError, match="at least 32 px, found 64x31"):
        alex.distance(first, second)


def test_search_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    with pytest.raises(WeightsError, match="no LPIPS weights for alex"):
        find_weights(None, "alex")
    absent = absent_parts("alex")
    assert f"no {tmp_path / 'data' / 'extrags' / 'lpips' / 'lpips_alex_v0.1.npz'} and no " in absent

    cached = tmp_path / "cache" / "extrags" / "lpips" / "lpips_alex_v0.1.npz"
    in_data = tmp_path / "data" / "extrags" / "lpips" / "lpips_alex_v0.1.npz"
    by_variable = tmp_path / "elsewhere" / "lpips_alex_v0.1.npz"
    explicit = tmp_path / "mine.npz"
    for file in (cached, in_data, by_variable, explicit):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
        if file == by_variable:
            monkeypatch.setenv(WEIGHTS_VARIABLE, str(by_variable.parent))
        assert find_weights(str(explicit) if file == explicit else None, "alex") == (file,)
    with pytest.raises(WeightsError, match=r"lpips_squeeze_v0\.1\.npz, which does not exist"):
        find_weights(None, "squeeze")


def test_a_named_file_that_is_missing_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, weights_folder: Path
) -> None:
    monkeypatch.chdir(weights_folder)
    with pytest.raises(WeightsError, match=r"the setting names .*nowhere\.npz, which does not exist"):
        find_weights(str(tmp_path / "nowhere.npz"), "alex")


def test_wrong_files_are_refused(tmp_path: Path, weights_folder: Path) -> None:
    with pytest.raises(WeightsError, match="not the weights of LPIPS with squeeze"):
        Lpips.load(weights_folder / "lpips_alex_v0.1.npz", "squeeze")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(WeightsError, match="not a readable npz"):
        Lpips.load(tmp_path / "text.npz")
    with pytest.raises((ConfigError, TypeCheckError), match=r"known: alex, vgg, squeeze|Type-check"):
        find_weights(None, "resnet")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "shape"),
    [("features.3.weight", (192, 63, 5, 5)), ("features.6.bias", (383,)), ("lin4", (255,)), ("lin0", ())],
)
def test_arrays_of_other_shapes_are_refused(tmp_path: Path, name: str, shape: tuple[int, ...]) -> None:
    weights = {key: value.numpy() for key, value in random_weights("alex").items()}
    file = tmp_path / "mine.npz"
    np.savez(file, **weights)
    check_weights((file,), "alex")
    np.savez(file, **{**weights, name: np.zeros(shape, np.float32)})
    with pytest.raises(WeightsError, match=rf"mine\.npz: .*; {name} has the shape {re.escape(str(shape))}"):
        check_weights((file,), "alex")


def test_weights_that_are_exchanged_with_their_times_are_checked_again(tmp_path: Path) -> None:
    """As a copy that keeps size and time of change does."""
    file = tmp_path / "mine.npz"
    np.savez(file, **{key: value.numpy() for key, value in random_weights("alex").items()})
    check_weights((file,), "alex")
    before = file.stat()
    file.write_bytes(bytes(before.st_size))
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(WeightsError, match="not a readable npz"):
        check_weights((file,), "alex")


def as_pytorch_has_it(
    net: LpipsNet, root: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, torch.Tensor], Path, Path]:
    """A package with heads, and a backbone with its classifier for torch's cache, named by its digest."""
    weights = random_weights(net)
    package = root / "site" / "lpips"
    heads = package / "weights" / "v0.1" / f"{net}.pth"
    heads.parent.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('nobody should import this')")
    lin = {
        f"{name}.model.1.weight": value.reshape(1, -1, 1, 1)
        for name, value in weights.items()
        if "lin" in name
    }
    torch.save(lin, heads)
    monkeypatch.syspath_prepend(root / "site")
    features = {name: value for name, value in weights.items() if "lin" not in name}
    made = root / "made.pth"
    torch.save({**features, "classifier.0.weight": torch.zeros(4, 4)}, made)
    name = f"{net}-{hashlib.sha256(made.read_bytes()).hexdigest()[:8]}.pth"
    monkeypatch.setitem(weights_module.BACKBONES, net, name)
    for variable in ("TORCH_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(variable, str(root / variable))
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    made.rename(root / name)
    return weights, root / name, root / "TORCH_HOME" / "hub" / "checkpoints" / name


class TestPytorchsFiles:
    @pytest.mark.parametrize("net", ["alex", "vgg"])
    def test_agree_with_the_npz_file(
        self, net: LpipsNet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        weights, made, cached = as_pytorch_has_it(net, tmp_path, monkeypatch)
        with pytest.raises(WeightsError, match=r"no LPIPS weights for \w+; `extrags weights lpips`"):
            find_weights(None, net)
        assert f"there is no {tmp_path}" in absent_parts(net)
        assert f"no {cached} (extrags weights lpips --download)" in absent_parts(net)
        cached.parent.mkdir(parents=True)
        made.rename(cached)
        files = find_weights(None, net)
        assert [file.name for file in files] == [f"{net}.pth", cached.name]
        assert absent_parts(net) == ""
        np.savez(tmp_path / "one.npz", **{name: value.numpy() for name, value in weights.items()})
        read, expected = read_weights(files, net), read_weights((tmp_path / "one.npz",), net)
        assert read.keys() == expected.keys()
        assert all(torch.equal(read[name], expected[name]) for name in read)
        first, second = random_pair(1, 48, 40)
        distance = Lpips.load(None, net).distance(first, second)
        assert torch.equal(distance, Lpips.load(tmp_path / "one.npz", net).distance(first, second))
        assert float(distance) > 0

    def test_a_file_with_another_digest_is_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        _, made, cached = as_pytorch_has_it("alex", tmp_path, monkeypatch)
        cached.parent.mkdir(parents=True)
        cached.write_bytes(made.read_bytes()[:-1])
        with pytest.raises(WeightsError, match="its SHA-256 does not begin with"):
            find_weights(None, "alex")
        with pytest.raises(WeightsError, match="its SHA-256 does not begin with"):
            download_backbone("alex")

    def test_without_heads(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        as_pytorch_has_it("alex", tmp_path, monkeypatch)
        monkeypatch.setattr(weights_module, "find_spec", lambda name: None)
        with pytest.raises(WeightsError, match="no LPIPS weights for alex"):
            find_weights(None, "alex")
        assert "pip install -e '.[lpips]'" in absent_parts("alex")

    def test_heads_of_torchmetrics_are_those_of_the_npz_file(self, weights_folder: Path) -> None:
        pytest.importorskip("torchmetrics")
        for net, heads in (("alex", 5), ("vgg", 5), ("squeeze", 7)):
            file = weights_module.find_heads(net)
            assert file is not None
            found = torch.load(file, map_location="cpu", weights_only=True)
            expected = read_weights((weights_folder / f"lpips_{net}_v0.1.npz",), net)
            for index in range(heads):
                head = found[f"lin{index}.model.1.weight"].flatten()
                assert torch.equal(head, expected[f"lin{index}"])

    def test_download(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        _, made, cached = as_pytorch_has_it("alex", tmp_path, monkeypatch)
        monkeypatch.setattr(weights_module, "BACKBONES_URL", f"{tmp_path.as_uri()}/")
        assert download_backbone("alex") == cached
        assert cached.read_bytes() == made.read_bytes()
        made.unlink()
        assert download_backbone("alex") == cached
        cached.unlink()
        with pytest.raises(WeightsError, match="could not be downloaded"):
            download_backbone("alex")
        made.write_bytes(b"something else")
        with pytest.raises(WeightsError, match="invalid hash value"):
            download_backbone("alex")
        assert not cached.exists()


def test_a_file_named_by_the_variable_serves_its_own_backbone_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("TORCH_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(variable, str(tmp_path / variable))
    file = tmp_path / "mine.npz"
    np.savez(file, **{name: value.numpy() for name, value in random_weights("alex").items()})
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(file))
    found = available_lpips(EvaluateConfig(lpips_nets=("alex", "vgg")))
    assert isinstance(found["alex"], Lpips)
    assert isinstance(found["vgg"], str)
    assert "no LPIPS weights for vgg" in found["vgg"]
    named = EvaluateConfig(lpips_nets=("alex", "vgg"), lpips_weights=str(file))
    with pytest.raises(WeightsError, match="not the weights of LPIPS with vgg, but with alex"):
        available_lpips(named)
