"""Which flow runs are alive: a lease for each, and the end of those that a power loss left `Running`.

A process that is killed tells no server. Its flow run would stay `Running` for ever, so whoever starts next
looks for such runs, and sets them to `Crashed` with their task runs (`settle_dead_runs`). A run is dead when

* its lease is free: a file in the store's state directory that the process of the run has locked with
  `flock(2)`, which the kernel releases however the process ends. That is known at once, but only on the
  machine that wrote it, since file systems of a network may lock per machine;
* or its heartbeat has stopped: Prefect emits one for each flow run (`PREFECT_FLOWS_HEARTBEAT_FREQUENCY`,
  180 s by default). That holds across machines. It is looked at twice, more than a period apart, because a
  server that was down itself has missed the heartbeats of the living.

A run that never had a heartbeat, and whose lease is not here, is left alone.
"""

from __future__ import annotations

import datetime
import fcntl
import json
import logging
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowFilter, FlowRunFilter, TaskRunFilter
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.context import FlowRunContext
from prefect.events.filters import (
    EventFilter,
    EventNameFilter,
    EventOccurredFilter,
    EventOrder,
    EventResourceFilter,
)
from prefect.exceptions import ObjectNotFound
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY
from prefect.states import Crashed

from extrags.errors import reason_of
from extrags.store import Store
from extrags.store.runs import FORGOTTEN_DAYS

if TYPE_CHECKING:
    from prefect.client.schemas.objects import State, TaskRun

__all__ = ["FLOWS", "HEARTBEAT", "is_inner_run", "run_lease", "second_look_seconds", "settle_dead_runs"]

log = logging.getLogger(__name__)

FLOWS = ("reconstruct-sequence", "reconstruct-dataset", "benchmark", "retention")
"""Flows of this project; runs of others are not ours to judge."""
HEARTBEAT = "prefect.flow-run.heartbeat"
UNENDED = (StateType.RUNNING, StateType.CANCELLING, StateType.PENDING)
DEFAULT_HEARTBEAT_SECONDS = 180
MISSED_BEATS = 3
"""So many must be missing."""
PENDING_HOURS = 1.0
"""A run that has been about to start for so long was lost with its worker."""
PAGE = 200
"""Runs asked for at once, as many as Prefect gives."""


@dataclass(frozen=True)
class _Lease:
    """A file that nobody holds any more."""

    path: Path
    flow_run: UUID
    host: str


def is_inner_run() -> bool:
    """Whether another flow run has started the current one, as a dataset does its sequences."""
    context = FlowRunContext.get()
    run = None if context is None else context.flow_run
    return run is not None and run.parent_task_run_id is not None


@contextmanager
def run_lease(root: str) -> Iterator[None]:
    """The current flow run is alive in this block; those that died are settled first.

    Nothing here fails a run: without locks, or without an answer of the server, there is a warning.

    Args:
        root: root of the store.
    """
    context = FlowRunContext.get()
    if context is None or context.flow_run is None:
        yield
        return
    folder = Store(root).state / "leases"
    descriptor = _take(folder, context.flow_run)
    try:
        # The runs inside a run need not look again.
        if not is_inner_run():
            _settle_beside_the_run(root)
        yield
    finally:
        if descriptor is not None:
            try:
                # Removed while it is still locked: nobody finds it free.
                (folder / _name(context.flow_run)).unlink(missing_ok=True)
            except OSError as error:
                lease = folder / _name(context.flow_run)
                log.warning("the lease of this run stays: %s: %s", lease, reason_of(error))
            finally:
                os.close(descriptor)


def settle_dead_runs(root: str, suspects: frozenset[UUID] = frozenset()) -> tuple[list[FlowRun], set[UUID]]:
    """Set the flow runs that are certainly dead to `Crashed`, with their task runs.

    Args:
        root: root of the store that holds the leases.
        suspects: those that had missed their heartbeats before, more than a period ago. If they still have,
            they are dead.

    Returns:
        The runs that were settled, and those that now miss their heartbeats.
    """
    settled, missing = [], set()
    _sweep_unreadable(Store(root).state / "leases")
    free = {lease.flow_run: lease for lease in _free_leases(Store(root).state / "leases")}
    with get_client(sync_client=True) as client:
        for run in _unended(client):
            lease = free.pop(run.id, None)
            reason = ""
            if lease is not None and lease.host == _host():
                reason = "its process is gone"
            elif run.state_type == StateType.PENDING:
                if run.state is not None and _age_seconds(run.state.timestamp) > PENDING_HOURS * 3600:
                    reason = f"it did not start within {PENDING_HOURS:g} h"
            elif not _is_held(root, run) and _heart_has_stopped(client, run):
                missing.add(run.id)
                if run.id in suspects:
                    reason = "its heartbeat has stopped"
            if reason and _settle(client, run, reason):
                settled.append(run)
                missing.discard(run.id)
                if lease is not None:
                    lease.path.unlink(missing_ok=True)
        for lease in free.values():
            _forget(client, lease)
    return settled, missing


def _settle_beside_the_run(root: str) -> None:
    """Look now, and again in a thread after the time in which every living run has shown itself."""
    missing = _attempt(root, frozenset())
    if not missing:
        return

    def look_again() -> None:
        threading.Event().wait(second_look_seconds())
        _attempt(root, frozenset(missing))

    # It must not keep the process from ending: the next run looks again.
    threading.Thread(target=copy_context().run, args=(look_again,), name="dead-runs", daemon=True).start()


def _attempt(root: str, suspects: frozenset[UUID]) -> set[UUID]:
    try:
        return settle_dead_runs(root, suspects)[1]
    except Exception as error:
        log.warning("runs that died before could not be looked for: %s: %s", type(error).__name__, error)
        return set()


def _unended(client: SyncPrefectClient) -> Iterator[FlowRun]:
    known = {"name": {"any_": list(FLOWS)}}
    states = {"state": {"type": {"any_": [kind.value for kind in UNENDED]}}}
    found: list[FlowRun] = []
    while len(page := _page(client, known, states, len(found))) == PAGE:
        found += page
    yield from [*found, *page]


def _page(client: SyncPrefectClient, flows: Any, runs: Any, offset: int) -> list[FlowRun]:
    return client.read_flow_runs(
        flow_filter=FlowFilter.model_validate(flows),
        flow_run_filter=FlowRunFilter.model_validate(runs),
        limit=PAGE,
        offset=offset,
    )


def _heart_has_stopped(client: SyncPrefectClient, run: FlowRun) -> bool:
    """Whether it once had a heartbeat, and several are missing now."""
    now = datetime.datetime.now(datetime.UTC)
    name, resource = f"prefect.flow-run.{run.id}", EventResourceFilter
    page = client.read_events(
        EventFilter(
            event=EventNameFilter(name=[HEARTBEAT]),
            resource=resource(id=[name]),
            occurred=EventOccurredFilter(since=now - datetime.timedelta(days=FORGOTTEN_DAYS)),
            order=EventOrder.DESC,
        ),
        limit=1,
    )
    if not page.events:
        return False
    return _age_seconds(page.events[0].occurred) > MISSED_BEATS * _heartbeat_seconds()


def second_look_seconds() -> float:
    """After so long every run that lives has sent a heartbeat."""
    return 1.5 * _heartbeat_seconds()


def _heartbeat_seconds() -> float:
    chosen = PREFECT_FLOWS_HEARTBEAT_FREQUENCY.value()
    # Those that send them may have kept the default.
    return float(max(chosen or 0, DEFAULT_HEARTBEAT_SECONDS))


def _age_seconds(moment: datetime.datetime) -> float:
    return (datetime.datetime.now(datetime.UTC) - moment).total_seconds()


def _settle(client: SyncPrefectClient, run: FlowRun, reason: str) -> bool:
    said = f"Ended unexpectedly: {reason}. What was finished is in the store; a new run resumes there."
    state: State[None] = Crashed(message=said)
    tasks = TaskRunFilter.model_validate(
        {
            "flow_run_id": {"any_": [str(run.id)]},
            "state": {"type": {"any_": [kind.value for kind in UNENDED]}},
        }
    )
    # All are asked for before the first is changed: it would not be among those of the next page any more.
    unended: list[TaskRun] = []
    while len(page := client.read_task_runs(task_run_filter=tasks, limit=PAGE, offset=len(unended))) == PAGE:
        unended += page
    for task in [*unended, *page]:
        client.set_task_run_state(task.id, state, force=True)
    # Not by force: it may have ended meanwhile, and what the server keeps for it is released.
    client.set_flow_run_state(run.id, state)
    after = client.read_flow_run(run.id)
    crashed = after.state_type == StateType.CRASHED
    if crashed:
        log.warning("the run %s (%s) is set to Crashed: %s", run.name, run.id, reason)
    return crashed


def _forget(client: SyncPrefectClient, lease: _Lease) -> None:
    """Remove the lease of a run that has ended, on any machine, or that is old.

    After `FORGOTTEN_DAYS` it goes whatever the server knows of its run. A run that this server does not know
    may be another server's, which settles it by its lease.
    """
    try:
        written = datetime.datetime.fromtimestamp(lease.path.stat().st_mtime, datetime.UTC)
    except FileNotFoundError:
        return
    if _age_seconds(written) < FORGOTTEN_DAYS * 86400:
        try:
            run = client.read_flow_run(lease.flow_run)
        except ObjectNotFound:
            return
        # That its lease is free says nothing elsewhere: locks may hold per machine.
        if lease.host != _host() and not (run.state is not None and run.state.is_final()):
            return
    lease.path.unlink(missing_ok=True)


# The files.


def _name(run: FlowRun) -> str:
    return f"{run.id}.lease"


def _host() -> str:
    """This machine; a name alone may be that of several containers."""
    with suppress(OSError):
        return f"{socket.gethostname()} {Path('/etc/machine-id').read_text().strip()}".strip()
    return socket.gethostname()


def _take(folder: Path, run: FlowRun) -> int | None:
    """Write and lock the lease of a run; its descriptor."""
    path = folder / _name(run)
    said = json.dumps({"flow_run": str(run.id), "name": run.name, "host": _host(), "process": os.getpid()})
    # Locked under another name first: under its own it is never free while the run lives.
    part = path.with_suffix(".part")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(descriptor, said.encode())
            part.rename(path)
        except BaseException:
            os.close(descriptor)
            with suppress(OSError):
                part.unlink(missing_ok=True)
            raise
    except OSError as error:
        log.warning("this run has no lease: %s: %s", path, reason_of(error))
        return None
    return descriptor


def _free_leases(folder: Path) -> Iterator[_Lease]:
    """Those that no process holds."""
    for path in sorted(folder.glob("*.lease")):
        with suppress(OSError, ValueError, KeyError, TypeError):
            if not _is_locked(path):
                said = json.loads(path.read_bytes())
                yield _Lease(path, UUID(said["flow_run"]), str(said["host"]))


def _sweep_unreadable(folder: Path) -> None:
    """Remove what a process that died while it wrote its lease has left, once it is old.

    Of whose run it was, and on which machine, nothing tells: `settle_dead_runs` can make nothing of it.
    """
    readable = {lease.path for lease in _free_leases(folder)}
    for path in sorted({*folder.glob("*.lease"), *folder.glob("*.part")} - readable):
        try:
            written = datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC)
            if _age_seconds(written) < FORGOTTEN_DAYS * 86400:
                continue
            # Of what this user may not open, the age alone decides.
            with suppress(PermissionError):
                if _is_locked(path):
                    continue
            path.unlink(missing_ok=True)
            log.info("the lease %s cannot be read and is old: it is removed", path)
        except FileNotFoundError:
            continue
        except OSError as error:
            log.warning("the lease %s cannot be read, nor removed: %s", path, error.strerror)


def _is_held(root: str, run: FlowRun) -> bool:
    """Whether a process has the lease of this run: then it lives, whatever its heartbeat."""
    with suppress(FileNotFoundError):
        return _is_locked(Store(root).state / "leases" / _name(run))
    return False


def _is_locked(path: Path) -> bool:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
