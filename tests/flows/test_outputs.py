"""Where verbs write to: the same spelling, checks and folders for all of them."""

from __future__ import annotations

import os
from argparse import ArgumentTypeError
from pathlib import Path

import pytest

from extrags.errors import StoreError
from flows.cli import main
from flows.commands.common import write_json, write_page
from flows.commands.outputs import (
    file_or_standard_output,
    made_folder,
    output_file,
    output_folder,
    output_place,
    write_output,
)


def test_a_home_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for kind in (output_place, output_file, output_folder, file_or_standard_output):
        assert kind("~/new/x") == str(tmp_path / "new" / "x")
        assert kind("x/y") == "x/y"
        with pytest.raises(ArgumentTypeError, match="~nobody-of-this-name/x cannot be written"):
            kind("~nobody-of-this-name/x")
        assert kind("~nobody-of-this-name") == "~nobody-of-this-name"
    assert file_or_standard_output("-") == "-"


def test_what_is_wrong_is_said_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(ArgumentTypeError, match="nothing can be made in"):
        output_place(str(tmp_path / "file" / "below" / "x"))
    with pytest.raises(ArgumentTypeError, match="is a folder; expected a file"):
        output_file(str(tmp_path))
    with pytest.raises(ArgumentTypeError, match="is a file; expected a folder"):
        output_folder(str(tmp_path / "file"))
    with pytest.raises(ArgumentTypeError, match="expected a name"):
        output_place("")
    # Whoever runs the tests may write everything.
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path / "file")
    with pytest.raises(ArgumentTypeError, match="file cannot be written: Permission denied"):
        output_file(str(tmp_path / "file"))


def test_a_device_may_lie_in_a_folder_that_may_not_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, _: str(path) == os.devnull)
    assert output_file(os.devnull) == os.devnull


@pytest.mark.parametrize(
    "verb",
    [
        ["report", "phantom/0", "--output"],
        ["compare", "phantom/0", "--output"],
        ["leaderboard", "--output"],
        ["gallery", "--output"],
        ["export", "phantom/0", "--to", "mesh", "--output"],
        ["export", "phantom/0", "--to", "colmap", "--output"],
        ["data", "show", "phantom/0", "--picture"],
        ["bench", "stability", "--figure"],
        ["bench", "pipeline", "phantom/0", "--output"],
        ["pretrain", "--output"],
        ["status", "--json"],
    ],
    ids=" ".join,
)
def test_every_verb_looks_before_it_begins(
    verb: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("x")
    assert main([*verb, str(tmp_path / "file" / "x.glb")]) == 2
    assert "cannot be written: nothing can be made in" in capsys.readouterr().err


def test_a_gallery_is_no_page_of_the_name_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other verbs write pages under `--output`; a folder of this name was made."""
    monkeypatch.chdir(tmp_path)
    for name in ("x.md", "new/x.HTML"):
        assert main(["gallery", "--output", name]) == 2
        assert f"{name} is the name of a page; expected a folder, into which" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []
    # One that is there is taken, and so is a version in a name.
    (tmp_path / "x.md").mkdir()
    for name in ("x.md", "gallery_v1.2"):
        assert main(["gallery", "--output", name, "--store", "nowhere"]) != 2
        assert "is the name of a page" not in capsys.readouterr().err


def test_folders_are_made_and_files_are_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "new" / "folder" / "x.json"
    write_output(str(file), "one")
    assert file.read_text() == "one"
    write_json([1], str(file))
    assert file.read_text() == "[\n 1\n]\n"
    write_json([1], "-")
    assert capsys.readouterr().out == "[\n 1\n]\n"
    assert write_page("<p>", str(file)) == str(file)
    monkeypatch.setattr(Path, "replace", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_page("<b>", str(file))
    assert file.read_text() == "<p>"
    assert os.listdir(file.parent) == ["x.json"]


def test_a_folder_that_stays_empty_is_taken_back(tmp_path: Path) -> None:
    def failing() -> None:
        with made_folder(tmp_path / "a" / "b"):
            assert (tmp_path / "a" / "b").is_dir()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    assert os.listdir(tmp_path) == []
    (tmp_path / "file").write_text("x")
    with pytest.raises(StoreError, match="file/x cannot be written"):
        write_output(str(tmp_path / "file" / "x"), "x")
