"""Charts and views of a report, drawn once for equal content: they are most of what a page takes."""

from __future__ import annotations

import functools
import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import pytest

import extrags.report.build

__all__ = ["DRAWN", "drawn_anew", "drawn_once"]

DRAWN = ("gain_chart", "history_chart", "occupancy_slices", "scene_views", "views_chart")
"""What the page of a sequence draws, as `extrags.report.build` names it."""


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
        for name in DRAWN:
            draw = getattr(extrags.report.build, name)
            patched.enter_context(patch.object(extrags.report.build, name, once(draw)))
        yield


def drawn_anew(patched: pytest.MonkeyPatch) -> None:
    """Inside `drawn_once`, for a test of the drawing itself."""
    for name in DRAWN:
        patched.setattr(extrags.report.build, name, getattr(extrags.report.build, name).__wrapped__)
