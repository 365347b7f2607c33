"""Names, patterns and manifests become a list of sequences, each with its settings."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from extrags.errors import ConfigError, UnknownSequenceError
from flows.selection import Chosen, absolute_manifests, chosen_sequences

TEXT = """
# every night
phantom/[01]@sparse   # both
phantom/1@distanced
"""
YAML = """
settings: {coarse.iterations: 500, coarse.seed: 1}
sequences:
  - phantom/[01]@sparse
  - sequence: phantom/1@distanced
    settings: {coarse.iterations: 60}
"""


def names(given: list[str]) -> list[str]:
    return [item.name for item in chosen_sequences(given)]


def manifest(folder: Path, name: str, text: str) -> str:
    (folder / name).write_text(text)
    return f"@{folder / name}"


def test_what_several_patterns_match_is_there_once(tmp_path: Path) -> None:
    assert names(["phantom/1@sparse", "phantom/[01]@*"]) == [
        "phantom/1@sparse",
        "phantom/0@sparse",
        "phantom/0@distanced",
        "phantom/1@distanced",
    ]
    assert names([str(tmp_path)]) == [str(tmp_path)]


def test_a_path_has_one_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "grow").mkdir()
    monkeypatch.chdir(tmp_path)
    for spelling in ("grow/", "./grow", "grow//"):
        assert names([spelling]) == ["grow"]
    assert names(["./phantom/1"]) == ["./phantom/1"]
    for twice in (["grow", "grow/"], ["grow", str(tmp_path / "grow")]):
        with pytest.raises(ConfigError, match="named twice"):
            names(twice)


def test_a_sequence_of_the_catalogue_has_one_name() -> None:
    assert names(["phantom/1"]) == ["phantom/1@sparse"]
    assert names(["phantom/1", "phantom/[0-1]@sparse"]) == ["phantom/1@sparse", "phantom/0@sparse"]
    with pytest.raises(ConfigError, match="named twice"):
        names(["phantom/1", "phantom/1@sparse"])


def test_a_text_has_one_a_line(tmp_path: Path) -> None:
    file = manifest(tmp_path, "night.txt", TEXT)
    assert names([file]) == ["phantom/0@sparse", "phantom/1@sparse", "phantom/1@distanced"]
    assert names([file, "phantom/2@sparse"])[-1] == "phantom/2@sparse"


def test_a_name_may_hold_what_begins_a_comment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("pat", "pat #3", "pat #3 #4", "scan#1"):
        (tmp_path / folder).mkdir()
    text = "  # all of them\npat # the first\npat #3\npat #3 #4   # the last\nscan#1\t#comment\n#scan#1\n"
    assert names([manifest(tmp_path, "night.txt", text)]) == ["pat", "pat #3", "pat #3 #4", "scan#1"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.txt", "phantom/1@sparse\n"),
        ("a.json", '["phantom/1@sparse"]'),
        ("a.yaml", "- phantom/1@sparse\n"),
        ("a.YAML", "- phantom/1@sparse\n"),
        ("a.Json", '["phantom/1@sparse"]'),
    ],
)
def test_byte_order_marks_and_upper_case(name: str, text: str, tmp_path: Path) -> None:
    assert names([manifest(tmp_path, name, "\ufeff" + text)]) == ["phantom/1@sparse"]
    assert names([manifest(tmp_path, name, text)]) == ["phantom/1@sparse"]


def test_yaml_and_json_have_settings(tmp_path: Path) -> None:
    found = chosen_sequences([manifest(tmp_path, "night.yaml", YAML)])
    assert found[0] == Chosen("phantom/0@sparse", {"coarse.iterations": 500, "coarse.seed": 1})
    assert found[2] == Chosen("phantom/1@distanced", {"coarse.iterations": 60, "coarse.seed": 1})
    listed = [{"sequence": "phantom/0@sparse", "settings": {"coarse.seed": 2}}, "phantom/1@sparse"]
    found = chosen_sequences([manifest(tmp_path, "night.json", json.dumps(listed))])
    assert found == [Chosen("phantom/0@sparse", {"coarse.seed": 2}), Chosen("phantom/1@sparse")]


def test_words_mean_what_they_mean_after_a_flag(tmp_path: Path) -> None:
    text = "settings: {enhance.max_width: none}\nsequences: [{sequence: phantom/1@sparse, settings: {%s}}]"
    given = manifest(tmp_path, "a.yaml", text % "coarse.thickness: 1e-3, evaluate.lpips_nets: alex")
    assert chosen_sequences([given])[0].settings == {
        "enhance.max_width": None,
        "coarse.thickness": 1e-3,
        "evaluate.lpips_nets": ("alex",),
    }
    with pytest.raises(ConfigError, match=r"a\.yaml, entry 1: setting enhance\.max_width is wide; expected"):
        chosen_sequences([manifest(tmp_path, "a.yaml", text % "enhance.max_width: wide")])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "# nothing\n", "no sequence is named"),
        ("a.yaml", "[", "is no YAML"),
        ("a.json", "{", "is no JSON"),
        ("a.yaml", "3", "holds no list"),
        ("a.yaml", "{sequence: [phantom/0@sparse]}", "has the field sequence; expected sequences"),
        ("a.yaml", "[{name: x}]", "entry 1: expected a name"),
        ("a.yaml", "['']", "entry 1: expected a name"),
        ("a.yaml", "[{sequence: phantom/0@sparse, settings: 3}]", "entry 1: expected settings by dotted"),
        ("a.yaml", "[phantom/0@sparse, phantom/0@sparse]", "named twice"),
        (
            "a.yaml",
            "[phantom/*@sparse, {sequence: phantom/0@sparse, settings: {coarse.seed: 1}}]",
            "chosen twice, with different settings",
        ),
    ],
)
def test_a_wrong_manifest_is_refused(name: str, text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        chosen_sequences([manifest(tmp_path, name, text)])


def test_a_name_that_is_no_utf8_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"M\xfcller")
    folder.mkdir()
    with pytest.raises(ConfigError, match=r"the name .*/M\\udcfcller is no UTF-8"):
        names([str(folder)])
    # Other scripts are.
    (tmp_path / "Müller 一").mkdir()
    assert names([str(tmp_path / "Müller 一")]) == [str(tmp_path / "Müller 一")]


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        chosen_sequences([f"@{tmp_path / 'none.txt'}"])
    with pytest.raises(UnknownSequenceError, match="near ones: phantom"):
        chosen_sequences(["phantm/*@sparse"])


def test_manifests_are_found_from_another_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert absolute_manifests(["@night.txt", "phantom/0@sparse"]) == [
        f"@{tmp_path / 'night.txt'}",
        "phantom/0@sparse",
    ]
