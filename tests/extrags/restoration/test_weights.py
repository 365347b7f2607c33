"""Which weights the embedded restorer starts from, and what a user is told when they are not there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from extrags.errors import ConfigError, WeightsError
from extrags.restoration.diffusion import weights
from extrags.restoration.diffusion.weights import PACKAGED, find_weights, starting_weights, weights_digest


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """Weights and their description; nobody reads what is in them here."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "restorer.safetensors").write_bytes(b"weights")
    (folder / "restorer.json").write_text("{}")
    return folder


def test_none_is_none() -> None:
    assert find_weights("none") == ()
    assert weights_digest("none") is None


def test_a_file_and_its_folder_are_the_same(pair: Path) -> None:
    file = pair / "restorer.safetensors"
    assert find_weights(str(file)) == find_weights(str(pair)) == (file,)
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
    package = pair.parent / "package"
    for name in PACKAGED:
        shutil.copytree(pair, package / name)
        (package / name / "restorer.json").write_text(f'{{"name": "{name}"}}')
    monkeypatch.setattr(
        weights, "files", lambda name: {"extrags.restoration.diffusion.weights": package}[name]
    )
    own = tuple(package / name / "restorer.safetensors" for name in PACKAGED)
    assert find_weights("bundled") == own
    for name, file in zip(PACKAGED, own, strict=True):
        assert find_weights(name) == (file,)
        assert starting_weights(name) == file
        assert weights_digest(name) == weights_digest(str(package / name))
    assert len({weights_digest(setting) for setting in ("bundled", *PACKAGED)}) == 1 + len(PACKAGED)


@pytest.mark.parametrize("setting", ["bundled", "none"])
def test_a_training_begins_with_one_set(setting: str) -> None:
    with pytest.raises(ConfigError, match=f"{setting}: expected one set of weights: colons, cavities, or"):
        starting_weights(setting)


def test_an_incomplete_installation_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "files", lambda package: tmp_path)
    with pytest.raises(WeightsError) as caught:
        find_weights("bundled")
    assert str(caught.value) == (
        "enhance.pretrained_weights=colons: there is no file "
        f"{tmp_path / 'colons' / 'restorer.safetensors'}; this "
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
        "bundled takes the weights of the package, colons or cavities one set of them, none trains from "
        "nothing"
    )
