"""Two machines that sweep one object store at the same time."""

from __future__ import annotations

from typing import Any

import pytest

from extrags.store import Store

__all__ = ["swept_by_other_first"]


def swept_by_other_first(
    monkeypatch: pytest.MonkeyPatch, store: Store, other: Store, moment: str
) -> list[str]:
    """Let another store sweep when `store` first gets to a moment.

    Args:
        monkeypatch: takes it back.
        store: whose sweep comes second.
        other: of the same place.
        moment: `find`, once it has listed what is there, or `rm`, before it removes.

    Returns:
        "begun" and what the other has swept; empty until then.
    """
    backend: Any = store.backend
    call, swept = getattr(backend.fs, moment), list[str]()

    def other_first(*args: Any, **options: Any) -> Any:
        listed = call(*args, **options) if moment == "find" else None
        if not swept:
            swept.append("begun")
            swept.extend(other.sweep(older_than_hours=-0.1))
        return listed if moment == "find" else call(*args, **options)

    monkeypatch.setattr(backend.fs, moment, other_first)
    return swept
