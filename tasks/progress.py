"""Progress of stages, for the progress bars of the command line or for the log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from extrags.errors import ExtragsError
from extrags.events import Event, MetricRecorded, Progress, subscribed
from extrags.stages import all_tasks
from extrags.store import Ref

__all__ = [
    "IN_PARALLEL",
    "Observer",
    "Pace",
    "ProgressLog",
    "StageProgress",
    "TimeLimitError",
    "current_observer",
    "duration_text",
    "interrupt_stages",
    "notify",
    "observed",
    "rate_text",
    "reporting",
    "stages_interrupted",
]

log = logging.getLogger("extrags.progress")

LOG_EVERY_SECONDS = 30.0
"""Between two lines of the log on how far a sequence is."""

IN_PARALLEL = frozenset(task.name for task in all_tasks() if task.in_parallel)
"""Tasks of which several run at once: the count of one says nothing about the stage (`of_tasks` does)."""


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
    made: Mapping[str, Ref] = field(default_factory=dict)
    """When the stage has ended: what the sequence has, by the names of `extrags.stages.Part`."""
    expected: Mapping[str, Mapping[str, float]] | None = None
    """Seconds of the tasks of each stage, where the stage that has ended told more of them: the size of the
    frames, or the budgets of the plan."""
    of_tasks: bool = False
    """Whether it counts those of several tasks of a kind that have ended, not the steps of one."""

    @property
    def is_loop(self) -> bool:
        """Whether the count tells how far the stage is."""
        return bool(self.total) and (self.of_tasks or self.stage not in IN_PARALLEL)


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


@contextmanager
def stages_interrupted() -> Iterator[None]:
    """In this block the stages of this process end as by `interrupt_stages`; those that start after it run.

    For a process that may outlive its run, such as a notebook's.
    """
    for_good = _interrupted.is_set()
    interrupt_stages()
    try:
        yield
    finally:
        if not for_good:
            _interrupted.clear()


def notify(progress: StageProgress) -> None:
    """Send progress to the observer; without one it is logged. Nothing is said after an interruption."""
    if _interrupted.is_set():
        return
    (_observer.get() or _log_of_the_process)(progress)


def current_observer() -> Observer | None:
    """Who is told of the progress of stages here; None where it is logged."""
    return _observer.get()


def duration_text(seconds: float) -> str:
    """A duration as people say it: `40 s`, `12 min`, `3.5 h`."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def rate_text(steps_per_second: float) -> str:
    """How fast a loop goes: `12.5/s`, or the time of a step where that is longer than a second."""
    if steps_per_second < 1:
        seconds = 1 / steps_per_second
        return f"{seconds:.2g} s each" if seconds < 10 else f"{duration_text(seconds)} each"
    return f"{steps_per_second:.0f}/s" if steps_per_second >= 100 else f"{steps_per_second:.3g}/s"


def _value_text(value: float) -> str:
    """Counts as they are, measured values with four digits."""
    return f"{value:.0f}" if float(value).is_integer() and abs(value) < 1e9 else f"{value:.4g}"


def _metric_text(metric: MetricRecorded) -> str:
    """`judged_gain_over_classical_db` in words, its unit behind the number."""
    words = metric.name.split("_")
    unit = " dB" if words[-1] == "db" else ""
    return f"{' '.join(words[:-1] if unit else words)} {_value_text(metric.value)}{unit}"


class Pace:
    """How fast loops go, by sequence and stage; the owner sees to it that one thread asks at a time."""

    def __init__(self) -> None:
        self._first: dict[tuple[str, str], tuple[float, int, int]] = {}

    def rate(self, progress: StageProgress, now: float) -> float | None:
        """Steps per second since the first one that was seen; None before there are any.

        A count that falls, or of another total, is another loop of the same stage, and begins anew.
        """
        place = (progress.label, progress.stage)
        begun, first, total = self._first.setdefault(place, (now, progress.done, progress.total))
        if progress.done < first or progress.total != total:
            self._first[place] = (now, progress.done, progress.total)
            return None
        if progress.done == first or now <= begun:
            return None
        return (progress.done - first) / (now - begun)

    def seconds_left(self, progress: StageProgress, now: float) -> float | None:
        """What the rest of the loop takes at its rate; None before there is one, or at its end."""
        rate = self.rate(progress, now)
        left = progress.total - progress.done
        return None if not rate or left <= 0 else left / rate

    def forget(self, label: str) -> None:
        """A stage of the sequence has ended: its loops are over."""
        for place in [place for place in self._first if place[0] == label]:
            del self._first[place]


class ProgressLog:
    """Observer that logs the start and end of every stage, and between them how far it is, at long intervals.

    An interval is that of a sequence, whichever of its stages and tasks speaks, so that a stage of many
    short tasks says no more than one of a single long one. May be called from any thread, and often.

    Args:
        clock: seconds, from any origin.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._guard = threading.Lock()
        self._quiet_until: dict[str, float] = {}
        self._failed: set[str] = set()
        self._pace = Pace()

    def __call__(self, progress: StageProgress) -> None:
        """Log it, or leave it."""
        with self._guard:
            line = self._line(progress, self._clock())
        if line is not None:
            log.info("%s", line)

    def _line(self, progress: StageProgress, now: float) -> str | None:
        place = f"{progress.label} {progress.stage}:"
        if progress.state != "running":
            self._pace.forget(progress.label)
            if progress.state == "skipped" and progress.label in self._failed:
                # After a failure every further stage is announced as skipped, and why has been said.
                return None
            if progress.state == "failed":
                self._failed.add(progress.label)
            took = [] if progress.state in ("skipped", "cached") else [f"in {progress.seconds:.1f} s"]
            words = " ".join([place, progress.state, *took])
            return f"{words}: {progress.detail}" if progress.detail else words
        if not progress.total and not progress.detail:
            self._failed.discard(progress.label)
            self._quiet_until[progress.label] = now + LOG_EVERY_SECONDS
            return f"{place} starts"
        if progress.stage in IN_PARALLEL and not progress.of_tasks:
            return None
        parts = []
        if progress.total:
            parts.append(f"{progress.done} of {progress.total}")
            rate = self._pace.rate(progress, now)
            if rate is not None:
                parts.append(rate_text(rate))
            left = self._pace.seconds_left(progress, now)
            if left is not None:
                parts.append(f"about {duration_text(left)} left")
        # A sequence whose start nobody announced here, as in another process: its interval begins now.
        if now < self._quiet_until.setdefault(progress.label, now + LOG_EVERY_SECONDS):
            return None
        self._quiet_until[progress.label] = now + LOG_EVERY_SECONDS
        said = [", ".join(words) for words in (parts, progress.detail.split("  ")) if any(words)]
        return f"{place} {'; '.join(said)}"


_log_of_the_process = ProgressLog()


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

    def receive(event: Event) -> None:
        if _interrupted.is_set():
            # The thread of a stage can only end itself.
            raise KeyboardInterrupt
        taken_s = time.monotonic() - begun
        if time_limit_s is not None and taken_s > time_limit_s:
            raise TimeLimitError(
                f"{stage} of {label} took {taken_s:.1f} s; a stage may take {time_limit_s:g} s (time_limit_s)"
            )
        if isinstance(event, Progress):
            detail = "  ".join(f"{name} {_value_text(value)}" for name, value in event.values.items())
            notify(StageProgress(label, stage, "running", event.done, event.total, detail))
        elif isinstance(event, MetricRecorded):
            notify(StageProgress(label, stage, "running", detail=_metric_text(event)))

    with subscribed(receive):
        yield
