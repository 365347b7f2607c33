"""Retries of what can pass, time limits of stages, lost workers."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed, Pending

from extrags.errors import (
    CaptureError,
    ConfigError,
    DamagedArtefactError,
    DivergedError,
    ExtragsError,
    SourceNotFoundError,
    StoreError,
    WeightsError,
)
from extrags.events import Progress, emit
from extrags.store import Slot, Store
from flows.limits import StageLimits, can_pass
from flows.runners import Call, PrefectRunner, WorkerLostError
from tasks.progress import TimeLimitError, reporting
from tasks.stage import stage
from tests.tasks.toy import source

AT_ONCE = StageLimits(retry_delay_s=0)
KINDS = {
    "store": OSError(errno.EIO, "input/output error"),
    "capture": CaptureError("too few frames"),
}


@stage("flaky", version=1)
def flaky(slot: Slot, tries: str, kind: str, failures: int) -> None:
    """Fail a number of times, counting in a file."""
    with Path(tries).open("a") as stream:
        stream.write("x")
    if len(Path(tries).read_text()) <= failures:
        raise KINDS[kind]
    (slot.path / "number").write_text("1")


@flow(name="runner")
def run_in_flow(runner: PrefectRunner, calls: list[Call]) -> list[str]:
    return [result.state for result in runner.run(calls, "toy")]


def caused(error: ExtragsError, cause: Exception) -> ExtragsError:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EIO, "input/output error"),
        OSError(errno.ESTALE, "stale file handle"),
        ConnectionResetError("peer"),
        TimeoutError("no answer"),
        httpx.ConnectError("refused"),
        StoreError("key is being replaced by others again and again"),
        caused(StoreError("s3://bucket/key cannot be read"), OSError(errno.EBUSY, "slow down")),
    ],
    ids=repr,
)
def test_what_can_pass(error: Exception) -> None:
    assert can_pass(error)


@pytest.mark.parametrize(
    "error",
    [
        CaptureError("too few frames"),
        ConfigError("unknown setting"),
        SourceNotFoundError("missing", file="a.png"),
        WeightsError("no weights"),
        DivergedError("iteration 7"),
        TimeLimitError("too long"),
        DamagedArtefactError("a file is missing"),
        caused(StoreError("the store cannot be written"), OSError(errno.ENOSPC, "no space left")),
        caused(StoreError("the store cannot be written"), PermissionError(errno.EACCES, "denied")),
        FileNotFoundError(errno.ENOENT, "no such file"),
        OSError("cannot identify image file"),
        ValueError("shape"),
        MemoryError(),
    ],
    ids=repr,
)
def test_what_fails_again(error: Exception) -> None:
    assert not can_pass(error)


def test_delays_double() -> None:
    assert StageLimits(retries=3, retry_delay_s=2).delays_s() == [2, 4, 8]


def test_a_stage_ends_at_the_first_event_after_its_time_limit() -> None:
    with reporting("phantom/0", "coarse", 60):
        emit(Progress("coarse", 1, 2))

    def overdue() -> None:
        with reporting("phantom/0", "coarse", 0.05):
            emit(Progress("coarse", 1, 3))
            time.sleep(0.1)
            emit(Progress("coarse", 2, 3))

    with pytest.raises(TimeLimitError, match=r"coarse of phantom/0 took 0\.\d s; a stage may take 0\.05 s"):
        overdue()


@pytest.mark.usefixtures("prefect_server")
class TestInRuns:
    def test_an_error_that_passes_is_tried_again(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        tries = tmp_path / "tries"
        call = Call(flaky, {"tries": str(tries), "kind": "store", "failures": 2})
        runner = PrefectRunner(str(tmp_path / "store"), limits=AT_ONCE)
        assert run_in_flow(runner, [call]) == ["ran"]
        assert tries.read_text() == "xxx"
        said = [record.getMessage() for record in caplog.records if record.name == "flows.limits"]
        assert said == ["flaky toy: tried again after OSError: [Errno 5] input/output error"] * 2
        assert list((tmp_path / "store" / "scratch").iterdir()) == []

    @pytest.mark.parametrize(("kind", "tried"), [("store", 3), ("capture", 1)])
    def test_tries_end_and_wrong_input_has_one(self, tmp_path: Path, kind: str, tried: int) -> None:
        tries = tmp_path / "tries"
        call = Call(flaky, {"tries": str(tries), "kind": kind, "failures": 9})
        with pytest.raises(type(KINDS[kind])):
            run_in_flow(PrefectRunner(str(tmp_path / "store"), limits=AT_ONCE), [call])
        assert len(tries.read_text()) == tried

    def test_the_time_limit_reaches_the_stage_and_not_its_key(self, tmp_path: Path) -> None:
        @stage("slow", version=1)
        def slow(slot: Slot, steps: int) -> None:
            for step in range(steps):
                emit(Progress("slow", step, steps))
                time.sleep(0.05)

        call, store = Call(slow, {"steps": 4}), str(tmp_path / "store")
        with pytest.raises(TimeLimitError):
            run_in_flow(PrefectRunner(store, limits=StageLimits(time_limit_s=0.01)), [call])
        assert Store(store).ls() == []
        assert run_in_flow(PrefectRunner(store, limits=StageLimits(time_limit_s=60)), [call]) == ["ran"]
        assert run_in_flow(PrefectRunner(store), [call]) == ["cached"]


class _Lost:
    """As of a Dask worker that died; the first `losses` of them."""

    losses = 0
    submitted = 0

    def __init__(self, store: str) -> None:
        type(self).submitted += 1
        self._lost = self.submitted <= self.losses
        self._store = store

    @property
    def state(self) -> State[Any]:
        if self._lost:
            return Pending()
        return Completed(data=source.fn(store=self._store, seed=1))

    def wait(self, timeout: float | None = None) -> None:
        """It has ended."""


@pytest.mark.parametrize(("losses", "submitted"), [(2, 3), (9, 3)])
def test_a_task_of_a_lost_worker_is_submitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, losses: int, submitted: int
) -> None:
    store = str(tmp_path / "store")

    class Lost(_Lost):
        pass

    Lost.losses = losses
    monkeypatch.setattr(PrefectRunner, "_submit", lambda self, call, label, threads: Lost(store))
    runner = PrefectRunner(store, limits=AT_ONCE)
    if losses == 2:
        assert [result.state for result in runner.run([Call(source, {"seed": 1})], "toy")] == ["ran"]
    else:
        with pytest.raises(WorkerLostError, match="toy-source was lost"):
            runner.run([Call(source, {"seed": 1})], "toy")
    assert Lost.submitted == submitted
