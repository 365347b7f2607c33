"""Spellings of one path are one name."""

from __future__ import annotations

from pathlib import Path

import pytest

from data_catalog.names import comparable_name, plain_name


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "grow").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("spelling", ["grow", "grow/", "./grow", ".//grow//", "grow/."])
def test_a_path_that_exists_has_one_spelling(spelling: str) -> None:
    assert plain_name(spelling) == "grow"


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("phantom/0", "phantom/0@sparse"),
        ("phantom/00@distanced", "phantom/0@distanced"),
        ("caverns/7", "caverns/7@sparse"),
        ("c3vdv2/c1_cecum_t1", "c3vdv2/c1_cecum_t1@sparse"),
        ("simcol3d_s1", "simcol3d/s1"),
    ],
)
def test_a_sequence_of_the_catalogue_has_the_name_it_is_listed_by(
    spelling: str, name: str, here: Path
) -> None:
    assert plain_name(spelling) == plain_name(name) == name
    assert comparable_name(spelling) == comparable_name(name)
    # A path that exists wins.
    (here / spelling).mkdir(parents=True)
    assert plain_name(spelling) == spelling
    assert comparable_name(spelling) == str(here / spelling)


@pytest.mark.parametrize(
    "name", ["phantom/0@sparse", "phantom/0@dense", "./phantom/0", "elsewhere/", "x" * 5000, "a\0b"]
)
def test_what_does_not_exist_stays_as_it_is(name: str) -> None:
    assert plain_name(name) == name


def test_the_plain_spelling_is_not_made_absolute(here: Path) -> None:
    assert plain_name(f"{here}/grow/") == f"{here}/grow"


def test_what_is_compared_is_the_place(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(here))
    for spelling in ("grow", "grow/", f"../{here.name}/grow", f"{here}//grow", "~/grow"):
        assert comparable_name(spelling) == str(here / "grow")
    assert comparable_name("gone/") == comparable_name("gone") != comparable_name("grow")
    assert comparable_name("phantom/0@sparse") != comparable_name("phantom/0@distanced")
