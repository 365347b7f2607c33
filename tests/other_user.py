"""Folders of another user, whose permissions refuse everybody else: also for tests that run as root."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

__all__ = ["give_to_another_user"]


def give_to_another_user(monkeypatch: pytest.MonkeyPatch, *folders: Path) -> None:
    """Refuse what the system calls of Python ask of folders with mode 700, and of what is below them.

    Args:
        monkeypatch: takes the refusal back.
        folders: existing ones.
    """

    def refusing(call: Callable[..., Any], *, of_the_folder: bool) -> Callable[..., Any]:
        def refused(path: Any, *args: Any, **options: Any) -> Any:
            # What is asked relative to a descriptor of a folder has opened that before.
            if isinstance(path, str | os.PathLike) and options.get("dir_fd") is None:
                asked = Path(path)
                if any(folder in asked.parents or (of_the_folder and asked == folder) for folder in folders):
                    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return call(path, *args, **options)

        return refused

    for name in ("open", "scandir", "listdir", "rename"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name), of_the_folder=True))
    for name in ("stat", "lstat", "unlink"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name), of_the_folder=False))
