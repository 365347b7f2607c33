"""Which weights the embedded restorer starts from, and what a user is told when they are not there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from extrags.errors import WeightsError
from extrags.restoration.diffusion import weights
from extrags.restoration.diffusion.weights import find_weights, weights_digest


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """Weights and their description; nobody reads what is in them here."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "restorer.safetensors").write_bytes(b"weights")
    (folder / "restorer.json").write_text("{}")
    return folder


def test_none_is_none() -> None:
    assert find_weights("none") is None
    assert weights_digest("none") is None


def test_a_file_and_its_folder_are_the_same(pair: Path) -> None:
    file = pair / "restorer.safetensors"
    assert find_weights(str(file)) == find_weights(str(pair)) == file
    assert weights_digest(str(file)) == weights_digest(str(pair))


def test_the_digest_is_of_the_content_and_not_of_the_place(pair: Path, tmp_path: Path) -> None:
    first = weights_digest(str(pair))
    moved = tmp_path / "elsewhere"
    shutil.copytree(pair, moved)
    assert weights_digest(str(moved)) == first
    digests = {first}
    for file, content in (("restorer.safetensors", b"Weights"), ("restorer.json", b"{ }")):
        (pair / file).write_bytes(content)
        digests.add(weights_digest(str(pair)))
    # A byte that moves from one file to the other.
    (pair / "restorer.safetensors").write_bytes(b"weights{")
    (pair / "restorer.json").write_text("}")
    digests.add(weights_digest(str(pair)))
    assert len(digests) == 4


def test_the_packages_own_are_found_beside_the_code(pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Path(str(weights.files(weights.__name__))) == Path(weights.__file__).parent
    monkeypatch.setattr(
        weights, "files", lambda package: {"extrags.restoration.diffusion.weights": pair}[package]
    )
    assert find_weights("bundled") == pair / "restorer.safetensors"
    assert weights_digest("bundled") == weights_digest(str(pair))


def test_an_incomplete_installation_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "files", lambda package: tmp_path)
    with pytest.raises(WeightsError) as caught:
        find_weights("bundled")
    assert str(caught.value) == (
        f"enhance.pretrained_weights=bundled: there is no file {tmp_path / 'restorer.safetensors'}; this "
        "installation is incomplete: reinstall extrags, or set enhance.pretrained_weights=none"
    )


@pytest.mark.parametrize("missing", ["restorer.safetensors", "restorer.json"])
def test_a_named_file_that_is_missing_is_told(pair: Path, missing: str) -> None:
    (pair / missing).unlink()
    named = pair / "restorer.safetensors"
    with pytest.raises(WeightsError) as caught:
        weights_digest(str(named))
    assert str(caught.value) == (
        f"enhance.pretrained_weights={named}: there is no file {pair / missing}; expected a .safetensors "
        "file with its .json beside it, or a folder that holds restorer.safetensors and restorer.json; "
        "bundled takes the weights of the package, none trains from nothing"
    )
