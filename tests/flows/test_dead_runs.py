"""Flow runs whose process is gone, on a real server; the living are left alone."""

from __future__ import annotations

import datetime
import errno
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun, State, StateType, TaskRun
from prefect.context import FlowRunContext
from prefect.exceptions import ObjectNotFound
from prefect.settings import PREFECT_API_URL
from prefect.states import Completed, Pending, Scheduled

import flows.leases
from extrags.store import Store
from flows.automation import NAME, dead_run_automation, provide_automation
from flows.leases import PAGE, run_lease, settle_dead_runs
from tests.flows.killing import wait_for

pytestmark = pytest.mark.usefixtures("prefect_server")

# Named as the flow of this project, since no others are looked at.
RUN = """
import sys, time
from prefect import flow, task
from prefect.context import get_run_context
from flows.leases import run_lease

@task
def stage():
    print(get_run_context().task_run.flow_run_id, flush=True)
    time.sleep(300)

@flow(name=sys.argv[2])
def run(store):
    with run_lease(store):
        stage()

run(sys.argv[1])
"""
PATIENCE_S = 90.0


@contextmanager
def running(store: Path, *names: str) -> Iterator[list[tuple[subprocess.Popen[str], UUID]]]:
    """Processes with a flow run each, at work in a task."""
    environment = {**os.environ, "PREFECT_API_URL": str(PREFECT_API_URL.value())}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", RUN, str(store), name], env=environment, stdout=subprocess.PIPE, text=True
        )
        for name in names
    ]
    try:
        yield [(process, UUID(said_by(process))) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def said_by(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def state_of(run: UUID) -> StateType | None:
    with get_client(sync_client=True) as client:
        return client.read_flow_run(run).state_type


def task_states(run: UUID) -> set[StateType | None]:
    from prefect.client.schemas.filters import TaskRunFilter

    chosen = TaskRunFilter.model_validate({"flow_run_id": {"any_": [str(run)]}})
    with get_client(sync_client=True) as client:
        return {task.state_type for task in client.read_task_runs(task_run_filter=chosen)}


def test_a_killed_run_is_crashed_at_the_next_start_and_the_living_are_left_alone(tmp_path: Path) -> None:
    with running(tmp_path, "reconstruct-sequence", "reconstruct-dataset", "of-another-project") as runs:
        (killed, dead), (_, living), (stranger, foreign) = runs
        # Task runs reach the server a moment after they begin.
        wait_for(lambda: task_states(dead) == {StateType.RUNNING}, "the task to run", PATIENCE_S, every_s=0.2)
        assert settle_dead_runs(str(tmp_path)) == ([], set())
        for process in (killed, stranger):
            process.send_signal(signal.SIGKILL)
            process.wait()
        assert state_of(dead) == StateType.RUNNING

        settled, missing = settle_dead_runs(str(tmp_path))

        assert ([run.id for run in settled], missing) == ([dead], set())
        with get_client(sync_client=True) as client:
            run = client.read_flow_run(dead)
        assert run.state_type == StateType.CRASHED
        assert run.state is not None
        assert run.state.message == (
            "Ended unexpectedly: its process is gone. What was finished is in the store; a new run resumes "
            "there."
        )
        assert task_states(dead) == {StateType.CRASHED}
        assert state_of(living) == StateType.RUNNING
        assert state_of(foreign) == StateType.RUNNING
        left = {path.stem for path in (tmp_path / "leases").iterdir()}
        assert str(dead) not in left
        assert str(living) in left
        assert settle_dead_runs(str(tmp_path)) == ([], set())


def silent(monkeypatch: pytest.MonkeyPatch, run: FlowRun, *, last_beat_s: float | None) -> None:
    """The server has this run alone, and its last heartbeat is so long ago."""
    monkeypatch.setattr(flows.leases, "_unended", lambda _: iter([run]))

    class Page:
        events: tuple[Any, ...] = ()

    class Beat:
        occurred = datetime.datetime.now(datetime.UTC) - datetime.timedelta(seconds=last_beat_s or 0)

    class Client:
        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing to close."""

        def read_events(self, *_: object, **__: object) -> Page:
            page = Page()
            page.events = () if last_beat_s is None else (Beat(),)
            return page

    monkeypatch.setattr(flows.leases, "get_client", lambda **_: Client())
    monkeypatch.setattr(flows.leases, "_settle", lambda *_: True)


def test_all_tasks_of_a_dead_run_are_settled_however_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect tells of so many at once."""
    running = [TaskRun(task_key="stage", dynamic_key=str(index)) for index in range(2 * PAGE + 1)]
    settled: list[UUID] = []

    class Client:
        def read_task_runs(self, *, task_run_filter: Any, limit: int, offset: int = 0) -> list[TaskRun]:
            left = [task for task in running if task.id not in settled]
            return left[offset : offset + limit]

        def set_task_run_state(self, task: UUID, state: State[Any], *, force: bool) -> None:
            settled.append(task)

        def set_flow_run_state(self, *_: Any) -> None: ...

        def read_flow_run(self, run: UUID) -> FlowRun:
            return FlowRun(id=run, flow_id=uuid4(), state_type=StateType.CRASHED)

    client: Any = Client()
    assert flows.leases._settle(client, FlowRun(flow_id=uuid4(), name="dead"), "its process is gone")
    assert sorted(settled) == sorted(task.id for task in running)


@pytest.mark.parametrize(("last_beat_s", "dead"), [(None, False), (400.0, False), (600.0, True)])
def test_a_run_of_another_machine_is_judged_by_its_heartbeat_twice(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, last_beat_s: float | None, dead: bool
) -> None:
    run = FlowRun(id=uuid4(), flow_id=uuid4(), name="elsewhere", state_type=StateType.RUNNING)
    silent(monkeypatch, run, last_beat_s=last_beat_s)
    settled, missing = settle_dead_runs(str(tmp_path))
    assert (settled, missing) == ([], {run.id} if dead else set())
    settled, missing = settle_dead_runs(str(tmp_path), frozenset(missing))
    assert (settled, missing) == ([run] if dead else [], set())


def test_a_lease_that_another_machine_wrote_says_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run = FlowRun(id=uuid4(), flow_id=uuid4(), name="elsewhere", state_type=StateType.RUNNING)
    silent(monkeypatch, run, last_beat_s=1.0)
    monkeypatch.setattr(flows.leases, "_host", lambda: "another")
    descriptor = flows.leases._take(tmp_path / "leases", run)
    assert descriptor is not None
    os.close(descriptor)
    monkeypatch.undo()
    silent(monkeypatch, run, last_beat_s=1.0)
    assert settle_dead_runs(str(tmp_path)) == ([], set())


def test_a_lease_that_cannot_be_locked_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refusing(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    open_before = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(fcntl, "flock", refusing)
    assert flows.leases._take(tmp_path / "leases", FlowRun(flow_id=uuid4())) is None
    assert "this run has no lease" in caplog.text
    assert list((tmp_path / "leases").iterdir()) == []
    assert len(os.listdir("/proc/self/fd")) == open_before


DAY_S = 86400.0


@pytest.mark.parametrize(
    ("state", "here", "days", "kept"),
    [
        (Completed(), False, 0, False),
        (Completed(), True, 0, False),
        (Scheduled(), False, 0, True),
        (Scheduled(), True, 0, False),
        (Scheduled(), False, 31, False),
        (None, False, 0, True),
        (None, True, 0, True),
        (None, False, 31, False),
        (None, True, 31, False),
        # A clock was ahead, here or there: how old it is, nobody knows.
        (None, False, -400, True),
        (Completed(), False, -400, False),
    ],
    ids=lambda value: value.name if isinstance(value, State) else str(value),
)
def test_leases_of_runs_that_ended_go_wherever_they_ran(
    state: State[Any] | None,
    here: bool,
    days: float,
    kept: bool,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """None is a run that this server does not know: another one may."""
    run = FlowRun(flow_id=uuid4(), state=state)
    if not here:
        monkeypatch.setattr(flows.leases, "_host", lambda: "another")
    descriptor = flows.leases._take(tmp_path / "leases", run)
    assert descriptor is not None
    os.close(descriptor)
    monkeypatch.undo()
    (lease,) = (tmp_path / "leases").iterdir()
    os.utime(lease, (time.time() - days * DAY_S,) * 2)

    class Client:
        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing to close."""

        def read_flow_run(self, _: UUID) -> FlowRun:
            if state is None:
                raise ObjectNotFound(LookupError())
            return run

    monkeypatch.setattr(flows.leases, "_unended", lambda _: iter([]))
    monkeypatch.setattr(flows.leases, "get_client", lambda **_: Client())
    assert settle_dead_runs(str(tmp_path)) == ([], set())
    assert lease.exists() is kept


@pytest.mark.parametrize(
    ("name", "content", "days", "held", "kept"),
    [
        ("a.part", '{"flow_run": "', 31, False, False),
        ("a.part", '{"flow_run": "', -400, False, True),
        ("a.part", '{"flow_run": "', 29, False, True),
        ("a.part", '{"flow_run": "', 31, True, True),
        ("a.lease", "", 31, False, False),
        ("a.lease", '{"host": "here"}', 31, False, False),
        ("a.lease", "[]", 29, False, True),
    ],
)
def test_leases_that_nobody_can_read_go_when_they_are_old(
    name: str,
    content: str,
    days: float,
    held: bool,
    kept: bool,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Whether or not a server answers."""

    def gone(**_: object) -> None:
        raise ConnectionError("no server")

    monkeypatch.setattr(flows.leases, "get_client", gone)
    caplog.set_level("INFO")
    lease = tmp_path / "leases" / name
    lease.parent.mkdir()
    lease.write_text(content)
    os.utime(lease, (time.time() - days * DAY_S,) * 2)
    with lease.open() as file:
        if held:
            fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(ConnectionError):
            settle_dead_runs(str(tmp_path))
    assert lease.exists() is kept
    assert ("cannot be read and is old: it is removed" in caplog.text) is not kept


def test_a_run_that_never_started_is_dead_after_an_hour(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for hours, dead in ((0.5, False), (2.0, True)):
        state = Pending(timestamp=datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=hours))
        run = FlowRun(id=uuid4(), flow_id=uuid4(), state=state, state_type=StateType.PENDING)
        silent(monkeypatch, run, last_beat_s=None)
        assert settle_dead_runs(str(tmp_path))[0] == ([run] if dead else [])


def test_a_store_that_is_gone_at_the_end_fails_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def gone(path: Path, **_: object) -> None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    monkeypatch.setattr("flows.leases._settle_beside_the_run", lambda _: None)
    run = FlowRun(flow_id=uuid4())
    before = len(os.listdir("/proc/self/fd"))
    with (
        FlowRunContext.model_construct(flow_run=run),
        monkeypatch.context() as patched,
        run_lease(str(tmp_path)),
    ):
        patched.setattr(Path, "unlink", gone)
    (lease,) = (Store(tmp_path).state / "leases").iterdir()
    assert f"the lease of this run stays: {lease}: {os.strerror(errno.ESTALE)}" in caplog.text
    assert len(os.listdir("/proc/self/fd")) == before


def test_outside_a_run_there_is_no_lease(tmp_path: Path) -> None:
    with run_lease(str(tmp_path)):
        assert not (Store(tmp_path).state / "leases").exists()


def test_the_automation_is_made_once() -> None:
    assert provide_automation() == "created"
    assert provide_automation() == "unchanged"
    assert provide_automation(dead_run_automation(3600)) == "updated"
    with get_client(sync_client=True) as client:
        (automation,) = client.read_automations_by_name(NAME)
        assert automation.trigger.within == datetime.timedelta(hours=1)
        client.delete_automation(automation.id)
