"""The commit that is running: that of this package's own checkout, or none."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from extrags import source_commit as module
from extrags.source_commit import source_commit


def git(*arguments: str, folder: Path) -> str:
    who = ["-c", "user.name=Test", "-c", "user.email=test@example.org"]
    run = subprocess.run(["git", *who, *arguments], capture_output=True, text=True, check=True, cwd=folder)
    return run.stdout.strip()


def test_an_environment_inside_another_checkout_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    git("init", folder=tmp_path)
    git("commit", "--allow-empty", "-m", "something else", folder=tmp_path)
    own = tmp_path / "environment.py"
    own.write_text("")
    monkeypatch.setattr(module, "__file__", str(own))
    assert source_commit() is None
    git("add", "environment.py", folder=tmp_path)
    assert source_commit() == git("rev-parse", "HEAD", folder=tmp_path)


def test_without_git_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert source_commit() is None
