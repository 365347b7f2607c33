"""Where data and weights are looked for: variables and the user's directories, nothing beside a checkout."""

from __future__ import annotations

import pwd
from pathlib import Path

import pytest

from data_catalog.catalog import list_sequences, resolve
from extrags.data_directories import cache_directory, check_home, data_roots, user_directories, weights_roots
from extrags.errors import ConfigError, SourceNotFoundError, WeightsError
from extrags.metrics.lpips_weights import WEIGHTS_VARIABLE, absent_parts, find_weights
from extrags.store.url import default_cache_directory


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without variables and files."""
    for name in (
        "EXTRAGS_DATA",
        "EXTRAGS_CACHE",
        WEIGHTS_VARIABLE,
        "XDG_CACHE_HOME",
        "XDG_DATA_HOME",
        "TORCH_HOME",
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_the_users_directories(home: Path) -> None:
    assert user_directories() == [home / ".local/share/extrags", home / ".cache/extrags"]
    assert data_roots() == user_directories()
    assert weights_roots("lpips") == [home / ".local/share/extrags/lpips", home / ".cache/extrags/lpips"]
    assert cache_directory() == default_cache_directory() == home / ".cache/extrags"


def test_copies_below_a_home_folder(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRAGS_CACHE", "~/copies")
    assert default_cache_directory() == home / "copies"


def test_xdg_variables_are_honoured(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert user_directories() == [tmp_path / "data/extrags", tmp_path / "cache/extrags"]
    monkeypatch.setenv("XDG_DATA_HOME", "relative/data")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert user_directories() == [home / ".local/share/extrags", home / ".cache/extrags"]


def test_without_a_home_folder_what_is_named_is_searched(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*_: object) -> None:
        raise KeyError("getpwuid(): uid not found")

    monkeypatch.delenv("HOME")
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert data_roots() == weights_roots("lpips") == []
    for wanted in (cache_directory, user_directories, check_home):
        with pytest.raises(ConfigError, match="set HOME to a folder that can be written"):
            wanted()
    with pytest.raises(SourceNotFoundError, match=r"no folder sinus_hopkins\. Put it there"):
        resolve("sinus/hopkins")
    monkeypatch.setenv("EXTRAGS_DATA", str(tmp_path / "sets"))
    assert data_roots() == [tmp_path / "sets"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert user_directories() == [tmp_path / "data/extrags", tmp_path / "cache/extrags"]


def test_the_folder_that_the_user_names_comes_first(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRAGS_DATA", "~/sets")
    assert data_roots() == [home / "sets", *user_directories()]


def test_data_sets_are_found_in_the_users_data(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = home / ".local/share/extrags/sinus_hopkins"
    there.mkdir(parents=True)
    assert resolve("sinus/hopkins").path == str(there)


def test_nothing_is_looked_for_beside_the_checkout_or_the_working_directory(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The working directory is a folder beside one that holds everything, as the tests' checkout is."""
    beside = tmp_path / "shared" / "data"
    (beside / "sinus_hopkins").mkdir(parents=True)
    (beside / "lpips_weights").mkdir()
    (beside / "lpips_weights" / "lpips_alex_v0.1.npz").touch()
    (tmp_path / "checkout").mkdir()
    monkeypatch.chdir(tmp_path / "checkout")
    with pytest.raises(SourceNotFoundError) as data:
        resolve("sinus/hopkins")
    with pytest.raises(WeightsError) as weights:
        find_weights(None, "alex")
    found = {item.name for item in list_sequences() if item.folder is not None and item.available}
    assert not found
    for place in (".local/share/extrags", ".cache/extrags"):
        assert str(home / place) in str(data.value)
        assert str(home / place / "lpips" / "lpips_alex_v0.1.npz") in absent_parts("alex")
    assert "EXTRAGS_DATA" in str(data.value)
    assert WEIGHTS_VARIABLE in absent_parts("alex")
    assert "extrags weights lpips" in str(weights.value)
