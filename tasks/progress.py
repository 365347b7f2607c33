"""Progress of stages, for the progress bars of the command line or for the log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from extrags.errors import ExtragsError
from extrags.events import Event, MetricRecorded, Progress, subscribed

__all__ = [
    "Observer",
    "StageProgress",
    "TimeLimitError",
    "current_observer",
    "interrupt_stages",
    "log_progress",
    "notify",
    "observed",
    "reporting",
]

log = logging.getLogger("extrags.progress")

LOG_EVERY_SECONDS = 15.0


@dataclass(frozen=True, slots=True)
class StageProgress:
    """Progress of one stage of one sequence."""

    label: str
    """Name of the sequence."""
    stage: str
    state: str
    """`running`, or how it ended: `ran`, `cached`, `skipped`, `failed`, `interrupted`."""
    done: int = 0
    total: int = 0
    detail: str = ""
    """Loss, count or reason, ready to be shown."""
    seconds: float = 0.0


Observer = Callable[[StageProgress], None]


class TimeLimitError(ExtragsError, TimeoutError):
    """A stage took longer than it may."""


_interrupted = threading.Event()
_observer: ContextVar[Observer | None] = ContextVar("extrags_stage_observer", default=None)


@contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """Send the progress of all stages that start inside the block, also on other threads, to `observer`.

    Stages in other processes (Dask) cannot reach it; they log instead.
    """
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def interrupt_stages() -> None:
    """Make every stage of this process end by KeyboardInterrupt at its next event, and say nothing more."""
    _interrupted.set()


def notify(progress: StageProgress) -> None:
    """Send progress to the observer; without one it is logged. Nothing is said after an interruption."""
    if _interrupted.is_set():
        return
    observer = _observer.get()
    if observer is not None:
        observer(progress)
        return
    log_progress(progress)


def current_observer() -> Observer | None:
    """Who is told of the progress of stages here; None where it is logged."""
    return _observer.get()


def log_progress(progress: StageProgress) -> None:
    """One line in the log."""
    words = [progress.label, f"{progress.stage}:"]
    if progress.state != "running":
        words += [progress.state, f"in {progress.seconds:.1f} s"]
    elif progress.total:
        words.append(f"{progress.done}/{progress.total}")
    elif not progress.detail:
        words.append("starts")
    log.info("%s", " ".join([*words, progress.detail]).rstrip())


@contextmanager
def reporting(label: str, stage: str, time_limit_s: float | None = None) -> Iterator[None]:
    """Convert events of the library inside the block into progress of one stage.

    Args:
        label: name of the sequence.
        stage: name of the stage.
        time_limit_s: how long the block may take. It is looked at with each event, because the thread of a
            stage can only end itself: a stage that emits none is not ended.

    Raises:
        TimeLimitError: from inside the block, at the first event after the limit.
    """
    begun = time.monotonic()
    quiet_until = 0.0

    def receive(event: Event) -> None:
        nonlocal quiet_until
        if _interrupted.is_set():
            # The thread of a stage can only end itself.
            raise KeyboardInterrupt
        taken_s = time.monotonic() - begun
        if time_limit_s is not None and taken_s > time_limit_s:
            raise TimeLimitError(
                f"{stage} of {label} took {taken_s:.1f} s; a stage may take {time_limit_s:g} s (time_limit_s)"
            )
        if _observer.get() is None:
            # Loops may emit thousands of events; the log gets only some of them.
            now = time.monotonic()
            if now < quiet_until:
                return
            quiet_until = now + LOG_EVERY_SECONDS
        if isinstance(event, Progress):
            detail = "  ".join(f"{name} {value:.4g}" for name, value in event.values.items())
            notify(StageProgress(label, stage, "running", event.done, event.total, detail))
        elif isinstance(event, MetricRecorded):
            notify(StageProgress(label, stage, "running", detail=f"{event.name} {event.value:.4g}"))

    with subscribed(receive):
        yield
