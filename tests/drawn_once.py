"""Charts and views of a report, drawn once for equal content: they are most of what a page takes."""

from __future__ import annotations

import functools
import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any
from unittest.mock import patch

import pytest

import extrags.report.benchmark
import extrags.report.build

__all__ = ["DRAWN", "drawn_anew", "drawn_once"]

DRAWN: tuple[tuple[ModuleType, str], ...] = (
    *(
        (extrags.report.build, name)
        for name in ("gain_chart", "history_chart", "occupancy_slices", "scene_views", "views_chart")
    ),
    *((extrags.report.benchmark, name) for name in ("methods_chart", "pairs_chart", "trend_chart")),
)
"""What the pages of a sequence and of a benchmark draw, as their modules name it."""


@contextmanager
def drawn_once() -> Iterator[None]:
    """Pages share what they draw of equal content; each still asks for it, and writes it."""
    drawn: dict[bytes, Any] = {}

    def once(draw: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(draw)
        def known(*given: Any, **named: Any) -> Any:
            content = pickle.dumps((draw.__qualname__, given, sorted(named.items())))
            key = hashlib.sha256(content).digest()
            if key not in drawn:
                drawn[key] = draw(*given, **named)
            return drawn[key]

        return known

    with ExitStack() as patched:
        for module, name in DRAWN:
            patched.enter_context(patch.object(module, name, once(getattr(module, name))))
        yield


def drawn_anew(patched: pytest.MonkeyPatch) -> None:
    """Inside `drawn_once`, for a test of the drawing itself."""
    for module, name in DRAWN:
        patched.setattr(module, name, getattr(module, name).__wrapped__)
