"""Weights of the depth completion: found, told apart by their content, refused with a sentence."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from extrags.depth.completion import INPUT_CHANNELS
from extrags.depth.weights import completion_digest, find_completion, load_completion
from extrags.errors import WeightsError


def bundled() -> Path:
    found = find_completion("bundled")
    assert found is not None
    return found


def test_those_of_the_package_fit_the_network() -> None:
    network = load_completion("bundled")
    assert network is not None
    assert not network.training
    with torch.no_grad():
        log_depth, log_error = network(torch.zeros(1, INPUT_CHANNELS, 20, 27))
    assert log_depth.shape == log_error.shape == (1, 20, 27)
    assert torch.isfinite(log_depth).all()
    assert torch.isfinite(log_error).all()


def test_none_is_stereo_alone() -> None:
    assert find_completion("none") is None
    assert completion_digest("none") is None
    assert load_completion("none") is None


def test_the_digest_is_that_of_the_content(tmp_path: Path) -> None:
    copy = tmp_path / "copy.safetensors"
    shutil.copy(bundled(), copy)
    assert completion_digest(str(copy)) == completion_digest("bundled")
    save_file({"entrance.bias": torch.zeros(3)}, copy)
    assert completion_digest(str(copy)) != completion_digest("bundled")


@pytest.mark.parametrize("name", ["absent.safetensors", "weights.pt"])
def test_a_file_that_cannot_be_it(tmp_path: Path, name: str) -> None:
    (tmp_path / "weights.pt").write_bytes(b"")
    with pytest.raises(WeightsError, match=r"depth\.completion=.*bundled takes"):
        find_completion(str(tmp_path / name))


def test_another_network_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "other.safetensors"
    save_file({"entrance.bias": torch.zeros(3)}, file)
    with pytest.raises(WeightsError, match="is not a completion network"):
        load_completion(str(file))
