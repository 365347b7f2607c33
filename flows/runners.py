"""Three ways to obtain artefacts: Prefect task runs, plain calls, or lookup in the store.

The wiring of a sequence uses the protocol `Runner`. `PrefectRunner` is used in flows; `DirectRunner` calls
the same stages in the current thread without a server; `StoreRunner` runs nothing and finds out whether all
artefacts exist.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, Protocol

from prefect import Task
from prefect.context import FlowRunContext
from prefect.futures import PrefectFuture

from data_catalog.names import path_of
from extrags.errors import ExtragsError
from extrags.store import Ref, Store
from flows.limits import StageLimits
from tasks.progress import IN_PARALLEL, StageProgress, notify
from tasks.stage import at, refreshing, stage_key

__all__ = [
    "Call",
    "DirectRunner",
    "NotInStoreError",
    "PrefectRunner",
    "Result",
    "Runner",
    "StoreRunner",
    "WorkerLostError",
    "refreshed_once",
]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Call:
    """One task with its inputs."""

    task: Task[..., Ref]
    inputs: dict[str, Any]


@dataclass(frozen=True)
class Result:
    """The artefact of a call and how it was obtained."""

    ref: Ref
    state: Literal["ran", "cached"]


class NotInStoreError(ExtragsError, LookupError):
    """An artefact would have to be made, but nothing may run."""


class WorkerLostError(ExtragsError, RuntimeError):
    """A worker died; its task never reached a final state."""


class Runner(Protocol):
    """Obtains artefacts, concurrently if possible."""

    def run(self, calls: Sequence[Call], label: str) -> list[Result]:
        """Make the artefacts of all calls, in their order.

        Args:
            calls: independent of each other.
            label: name of the sequence.

        Raises:
            Exception: what the first failing call raised, after all have ended.
        """
        ...


_shared: ContextVar[set[str] | None] = ContextVar("extrags_refreshed", default=None)


def _known_as_refreshed() -> set[str]:
    shared = _shared.get()
    return set() if shared is None else shared


@contextmanager
def refreshed_once() -> Iterator[None]:
    """What one of the runners that are made inside the block has made anew, no other one makes anew."""
    token = _shared.set(set())
    try:
        yield
    finally:
        _shared.reset(token)


@dataclass(frozen=True)
class PrefectRunner:
    """Task runs of the current flow, on its task runner.

    Args:
        store: root of the store.
        refresh: run stages although their artefacts are there; each once, also where several runs that go
            through this runner share it, or through others inside a block (`refreshed_once`).
        limits: retries and time limits of each task.
    """

    store: str
    refresh: bool = False
    limits: StageLimits = field(default_factory=StageLimits)
    _refreshed: set[str] = field(default_factory=_known_as_refreshed, repr=False, compare=False)
    """Keys of what this runner has made anew."""

    def run(self, calls: Sequence[Call], label: str) -> list[Result]:
        """Submit all, wait for all; a task whose worker was lost is submitted again."""
        threads = _threads_for(len(calls))
        futures = [self._submit(call, label, threads) for call in calls]
        for ended, future in enumerate(futures, start=1):
            future.wait()
            _tell(calls, label, ended)
        results = []
        for call, submitted in zip(calls, futures, strict=True):
            future = submitted
            for delay_s in self.limits.delays_s():
                if future.state.is_final():
                    break
                log.warning("%s %s: submitted again, since its worker was lost", call.task.name, label)
                time.sleep(delay_s)
                future = self._submit(call, label, threads)
                future.wait()
            state = future.state
            if not state.is_final():
                # Dask retries a task whose worker died and leaves Prefect's state as it was (#21638).
                raise WorkerLostError(
                    f"the worker of {call.task.name} was lost; its task is still {state.name}"
                )
            ref = state.result()
            if self.refresh:
                self._refreshed.add(stage_key(call.task, call.inputs))
            results.append(Result(ref, "cached" if state.name == "Cached" else "ran"))
        return results

    def _submit(self, call: Call, label: str, threads: int | None) -> PrefectFuture[Ref]:
        refresh = self.refresh and stage_key(call.task, call.inputs) not in self._refreshed
        task = at(self.limits.applied_to(call.task), self.store, refresh=refresh)
        with self._resources(call):
            future: PrefectFuture[Ref] = task.submit(
                store=self.store,
                label=label,
                place=path_of(label) or "",
                time_limit_s=self.limits.time_limit_s,
                threads=threads,
                **call.inputs,
            )
        return future

    def _resources(self, call: Call) -> AbstractContextManager[object]:
        """Where Dask workers declare a GPU or their memory, tasks are placed by what they need."""
        placed = getattr(_task_runner(), "placed", None)
        if placed is None:
            return nullcontext()
        found: AbstractContextManager[object] = placed(
            call.inputs, lambda: _peak_mib(self.store, call.task.name)
        )
        return found


def _tell(calls: Sequence[Call], label: str, ended: int) -> None:
    """How many have ended, where each by itself tells nothing of how far the stage is."""
    stage = calls[0].task.name
    if len(calls) > 1 and stage in IN_PARALLEL:
        notify(StageProgress(label, stage, "running", ended, len(calls), of_tasks=True))


@cache
def _peak_mib(store: str, stage: str) -> float | None:
    """The largest memory that a stage took before, in any sequence of the store."""
    peaks = [item.counts.get("peak_mib") for item in Store(store).ls(stage)]
    return max((float(peak) for peak in peaks if peak is not None), default=None)


def _task_runner() -> object:
    context = FlowRunContext.get()
    return context.task_runner if context is not None else None


def _threads_for(tasks: int) -> int | None:
    """Threads for each task, where tasks run in processes that share the cores; None in this process."""
    share = getattr(_task_runner(), "threads_for", None)
    return share(tasks) if share is not None else None


@dataclass(frozen=True)
class DirectRunner:
    """Plain calls in this thread; no server, no flow.

    Args:
        store: root of the store.
        refresh: make artefacts although they are there; each is replaced when the new one is finished.
    """

    store: str
    refresh: bool = False

    def run(self, calls: Sequence[Call], label: str) -> list[Result]:
        """One after the other."""
        store = Store(self.store)
        results = []
        for call in calls:
            key = stage_key(call.task, call.inputs)
            found = None if self.refresh else store.find_or_set_aside(key)
            # What is there stays until the new one takes its place: making it may be interrupted, or fail.
            with refreshing() if self.refresh else nullcontext():
                ref = found or call.task.fn(
                    store=self.store, label=label, place=path_of(label) or "", **call.inputs
                )
            results.append(Result(ref, "ran" if found is None else "cached"))
            _tell(calls, label, len(results))
        return results


@dataclass(frozen=True)
class StoreRunner:
    """Only what is in the store already.

    Args:
        store: root of the store.
    """

    store: str

    def run(self, calls: Sequence[Call], label: str) -> list[Result]:
        """Look up all.

        Raises:
            NotInStoreError: at the first artefact that is missing.
            DamagedArtefactError: at the first one that is damaged; it stays where it is.
        """
        store = Store(self.store)
        results = []
        for call in calls:
            key = stage_key(call.task, call.inputs)
            found = store.find(key)
            if found is None:
                raise NotInStoreError(f"{label}: {key} is not in the store")
            results.append(Result(found, "cached"))
        return results
