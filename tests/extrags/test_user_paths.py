"""Home folders in paths, and names that look like one."""

from __future__ import annotations

from pathlib import Path

import pytest

from extrags.store import Store
from extrags.user_paths import absolute, expanded


def test_a_home_takes_the_place_of_its_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert expanded("~/frames") == expanded(Path("~/frames")) == tmp_path / "frames"
    assert expanded("frames/~") == Path("frames/~")


@pytest.mark.parametrize("name", ["~rec.mp4", "~nobody-of-this-name/frames"])
def test_where_there_is_no_such_home_it_is_a_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert expanded(name) == Path(name)
    assert Store(name).root == str(tmp_path / name)


def test_a_file_has_one_absolute_spelling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a" / "deep").mkdir(parents=True)
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "b")
    file = tmp_path / "a" / "k.ply"
    file.touch()
    for spelling in ("../a/k.ply", "./../a//k.ply", "~/a/k.ply", "~/a/../a/k.ply", file):
        assert absolute(spelling) == file
    assert absolute("../none/k.ply") == tmp_path / "none" / "k.ply"
    # Behind a link, what stands before `..` is not the folder it leads to.
    (tmp_path / "b" / "link").symlink_to(tmp_path / "a" / "deep")
    assert absolute("link/../k.ply").samefile(file)
