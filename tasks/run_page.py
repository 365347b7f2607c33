"""Artifacts on the page of a Prefect run, sent from a thread of their own.

Nothing here waits for the server or fails because of it: a run whose server refuses artifacts is a run
without them.
"""

from __future__ import annotations

import logging
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from typing import Any
from uuid import UUID

from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.context import FlowRunContext, TaskRunContext

from extrags.store import digest_of
from tasks.page_choice import page_chosen
from tasks.progress import (
    Pace,
    ProgressLog,
    StageProgress,
    current_observer,
    duration_text,
    observed,
)

__all__ = [
    "ArtifactSender",
    "StageBars",
    "artifact_key",
    "attempt",
    "page_wanted",
    "plain_letters",
    "stage_page",
]

log = logging.getLogger(__name__)

UPDATE_SECONDS = 5.0
"""Artifacts are updated no more often."""
AT_LEAST_SECONDS = 30.0
"""After this time the words beside an unchanged percentage are updated as well."""
LONG_SECONDS = 10.0
"""A stage that takes less has no bar of its own."""
CLOSE_SECONDS = 10.0
"""How long the end of a run waits for the last artifacts."""
MAX_FAILURES = 3
"""After so many in a row the server is left alone."""


def page_wanted() -> bool:
    """Whether the current run has a page to write on: in a flow or task, and not switched off."""
    in_a_run = FlowRunContext.get() is not None or TaskRunContext.get() is not None
    return in_a_run and page_chosen()


def artifact_key(kind: str, *names: str) -> str:
    """A key as Prefect wants it: lower-case letters, digits and dashes."""
    plain = (plain_letters(name.lower(), "a-z0-9") for name in (kind, *names))
    return "-".join(word for word in plain if word)


def plain_letters(name: str, allowed: str) -> str:
    """A name of these characters alone, with dashes for all others.

    Letters of other scripts tell names apart: a digest stands for them.

    Args:
        name: of a sequence, a stage or a run.
        allowed: what may stand between the brackets of a regular expression.
    """
    plain = re.sub(rf"[^{allowed}]+", "-", name).strip("-")
    return plain if name.isascii() else f"{plain}-{digest_of(name)[:8]}".strip("-")


def attempt(make: Callable[[], object]) -> bool:
    """Call it; an error is logged and goes no further, because no artifact is worth a run."""
    try:
        make()
    except Exception as error:
        log.warning("no artifact on the run's page: %s: %s", type(error).__name__, error)
        return False
    return True


@dataclass
class _Bar:
    percent: float
    text: str
    id: UUID | None = None
    sent_percent: int = -1
    sent_text: str = ""
    sent_at: float = -math.inf

    def due(self, now: float, *, last: bool) -> bool:
        """Whether the server should hear of it."""
        if self.sent_percent < 0 or int(self.percent) != self.sent_percent:
            return True
        return self.text != self.sent_text and (last or now - self.sent_at >= AT_LEAST_SECONDS)


class ArtifactSender:
    """Sends artifacts of the current run from a thread of its own; make it inside the run."""

    def __init__(self) -> None:
        self._bars: dict[str, _Bar] = {}
        self._others: deque[Callable[[], object]] = deque()
        self._guard = threading.Lock()
        self._wake = threading.Event()
        self._ended = False
        self._failures = 0
        # The context names the run that the artifacts belong to. A daemon: a server that does not answer
        # must not keep the process from ending.
        self._thread = threading.Thread(
            target=copy_context().run, args=(self._serve,), name="artifacts", daemon=True
        )
        self._thread.start()

    def progress(self, key: str, percent: float, text: str) -> None:
        """Set a progress bar; costs nothing, and the latest word is the one that is sent."""
        with self._guard:
            bar = self._bars.setdefault(key, _Bar(percent, text))
            bar.percent, bar.text = min(100.0, max(0.0, percent)), text

    def add(self, make: Callable[[], object]) -> None:
        """Have something called that creates an artifact."""
        self._others.append(make)
        self._wake.set()

    def close(self, *, wait: bool = True) -> None:
        """Send what is left, and wait for it a few seconds."""
        self._ended = True
        self._wake.set()
        if wait:
            self._thread.join(CLOSE_SECONDS)

    def _serve(self) -> None:
        while True:
            self._wake.wait(UPDATE_SECONDS)
            self._wake.clear()
            ended = self._ended
            self._send(last=ended)
            if ended or self._failures >= MAX_FAILURES:
                return

    def _send(self, *, last: bool) -> None:
        while self._others and self._failures < MAX_FAILURES:
            self._count(attempt(self._others.popleft()))
        now = time.monotonic()
        with self._guard:
            due = [(key, bar, bar.percent, bar.text) for key, bar in self._bars.items()]
        for key, bar, percent, text in due:
            if self._failures >= MAX_FAILURES:
                return
            # An artifact that was added wakes the thread between two updates.
            soon = now - bar.sent_at < UPDATE_SECONDS / 2
            if (last or not soon) and bar.due(now, last=last):
                self._count(attempt(partial(self._update, key, bar, percent, text)))

    def _update(self, key: str, bar: _Bar, percent: float, text: str) -> None:
        if bar.id is None:
            made: Any = create_progress_artifact(percent, key=key, description=text)
            bar.id = made
        else:
            update_progress_artifact(bar.id, percent, description=text)
        bar.sent_percent, bar.sent_text, bar.sent_at = int(percent), text, time.monotonic()

    def _count(self, well: bool) -> None:
        self._failures = 0 if well else self._failures + 1


class StageBars:
    """Observer that gives every long stage a progress bar, with what is left at its rate.

    Args:
        sender: sends them.
    """

    def __init__(self, sender: ArtifactSender) -> None:
        self._sender = sender
        self._guard = threading.Lock()
        self._begun: dict[tuple[str, str], float] = {}
        self._pace = Pace()
        self._shown: dict[tuple[str, str], str] = {}

    def __call__(self, progress: StageProgress) -> None:
        """Take note of a step; may be called from any thread, and often."""
        place = (progress.label, progress.stage)
        now = time.monotonic()
        with self._guard:
            if progress.state != "running":
                self._end(progress)
                return
            if not progress.is_loop:
                return
            begun = self._begun.setdefault(place, now)
            left = self._pace.seconds_left(progress, now)
            if now - begun < LONG_SECONDS and place not in self._shown:
                return
            key = self._shown.setdefault(place, artifact_key("progress", *place))
        words = [f"{progress.stage} of {progress.label}: {progress.done} of {progress.total}"]
        if progress.detail:
            words.append(", ".join(progress.detail.split("  ")))
        if left is not None:
            words.append(f"about {duration_text(left)} left")
        self._sender.progress(key, 100 * progress.done / progress.total, "; ".join(words))

    def _end(self, progress: StageProgress) -> None:
        """The stage has ended: full bars where it went well, else the reason beside the last share."""
        place = (progress.label, progress.stage)
        self._pace.forget(progress.label)
        self._begun.pop(place, None)
        key = self._shown.pop(place, None)
        if key is not None and progress.state in ("ran", "cached"):
            took = duration_text(progress.seconds)
            self._sender.progress(key, 100, f"{progress.stage} of {progress.label}: done in {took}")


@contextmanager
def stage_page() -> Iterator[None]:
    """Progress bars of a stage whose flow is in another process (Dask); otherwise the flow has them."""
    if current_observer() is not None or TaskRunContext.get() is None or not page_wanted():
        yield
        return
    sender = ArtifactSender()
    bars, lines = StageBars(sender), ProgressLog()

    def show(progress: StageProgress) -> None:
        bars(progress)
        lines(progress)

    try:
        with observed(show):
            yield
    except Exception:
        sender.close()
        raise
    except BaseException:
        sender.close(wait=False)
        raise
    sender.close()
