"""Which commit of this package is running."""

from __future__ import annotations

import subprocess
from pathlib import Path

__all__ = ["source_commit"]


def source_commit() -> str | None:
    """The commit of a checkout that this package is imported from; None where it is installed."""
    own = Path(__file__)
    # An environment may lie inside a checkout of something else, which does not know this file.
    asked = ["git", "log", "-1", "--format=%H", "HEAD"]
    known = ["git", "ls-files", "--error-unmatch", own.name]
    try:
        for command in (known, asked):
            found = subprocess.run(command, capture_output=True, text=True, check=False, cwd=own.parent)
            if found.returncode:
                return None
    except OSError:  # No git on this machine.
        return None
    return found.stdout.strip() or None
