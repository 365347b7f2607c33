"""Shell patterns over the names of the catalogue."""

from __future__ import annotations

from pathlib import Path

import pytest

from data_catalog.patterns import is_named, is_pattern, matching_names
from extrags.errors import SourceNotFoundError, UnknownSequenceError


@pytest.fixture
def without_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EXTRAGS_DATA", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_names_in_the_order_of_the_catalogue() -> None:
    assert matching_names("phantom/[0-2]@sparse").names == tuple(f"phantom/{i}@sparse" for i in range(3))
    assert matching_names("phantom/1@*").names == ("phantom/1@sparse", "phantom/1@distanced")


@pytest.mark.usefixtures("without_data")
def test_what_is_not_on_this_machine_is_told_apart() -> None:
    with pytest.raises(SourceNotFoundError, match=r"c1_\*' matches \d+ sequences, but the data of none"):
        matching_names("c3vdv2/c1_*")
    found = matching_names("*/[0s]*")
    assert "phantom/0@sparse" in found.names
    assert "simcol3d/s1" in found.elsewhere


@pytest.mark.parametrize(
    ("pattern", "near"), [("phantm/[0-3]@sparse", "phantom/0@sparse"), ("c3vdv2/c1_cecm*", "c3vdv2/c1_cecum")]
)
def test_a_pattern_that_matches_nothing_names_what_is_near(pattern: str, near: str) -> None:
    with pytest.raises(UnknownSequenceError, match=near):
        matching_names(pattern)


def test_a_path_that_exists_is_no_pattern(tmp_path: Path) -> None:
    odd = tmp_path / "frames[1]"
    odd.mkdir()
    assert not is_pattern(str(odd))
    assert not is_pattern("phantom/0@sparse")
    assert is_pattern("phantom/?@sparse")


def test_a_name_is_that_of_a_sequence_in_any_spelling() -> None:
    assert is_named("phantom/0@sparse", "phantom/0")
    assert is_named("scans/a [x]", "scans/a [x]")
    assert not is_named("phantom/0@distanced", "phantom/0")
