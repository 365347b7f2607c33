"""The only place where a Prefect server starts: once per test session, for the tests of flows."""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import pytest
from prefect.settings import (
    PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
    PREFECT_LOGGING_TO_API_ENABLED,
    PREFECT_SERVER_ANALYTICS_ENABLED,
    PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED,
    PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED,
    temporary_settings,
)

import flows.temporary_server
from extrags.cores import usable_cores
from extrags.raster import native
from extrags.sequence import EndoscopicSequence
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, FramesRead, images_of, spared, tiny_config

HERE = Path(__file__).parent
# As `flows.environment` has it, the server calls nobody; and it keeps no events, which no test asks for.
QUIET_SERVER = dict.fromkeys(
    (
        PREFECT_SERVER_ANALYTICS_ENABLED,
        PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED,
        PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED,
    ),
    False,
)
LEFT_TO_THE_COLLECTOR = "ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Prefect's clients leave sockets to the garbage collector, which may run in any later test."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.filterwarnings(LEFT_TO_THE_COLLECTOR))


@pytest.fixture(scope="package")
def prefect_server() -> Iterator[None]:
    # With the server's modules, which only the process that starts one has to load.
    from prefect.testing.utilities import prefect_test_harness

    with (
        temporary_settings(QUIET_SERVER),
        prefect_test_harness(server_startup_timeout=120),
        # The heartbeat costs a second per flow run; it cannot be switched off by environment.
        temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None, PREFECT_LOGGING_TO_API_ENABLED: False}),
    ):
        yield
    # While these tests' filter still holds; the tests of other packages treat every warning as an error.
    gc.collect()


@pytest.fixture(scope="package", autouse=True)
def little_work() -> Iterator[None]:
    """Runs of this package are about stages and their order, not about what a phantom looks like.

    Nor do commands start a server early: those that have one end it, and those that are refused leave it.
    """

    @functools.wraps(flows.temporary_server.start_early)
    def not_early() -> None: ...

    with spared(), patch.object(flows.temporary_server, "start_early", not_early):
        yield


@contextmanager
def threads_as_users_have_them() -> Iterator[None]:
    """Work is divided between the cores."""
    if not native.native_isa():
        yield
        return
    before = native.num_threads()
    native.set_num_threads(usable_cores())
    yield
    native.set_num_threads(before)


@pytest.fixture(scope="package")
def frames_read() -> FramesRead:
    """Filled while `finished` is made."""
    return FramesRead()


@pytest.fixture(scope="package")
def finished(
    little_work: None, frames_read: FramesRead, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, SequenceOutcome]:
    """A store in which the tiny sequence has gone through all stages.

    On all cores: other runs of these tests have one thread, and are compared with it bit by bit.
    """
    store = str(tmp_path_factory.mktemp("finished") / "store")
    read = EndoscopicSequence.load

    def noted(path: Path) -> EndoscopicSequence:
        found = read(path)
        frames_read.frames.append(found)
        frames_read.as_read.append({name: value.copy() for name, value in images_of(found).items()})
        return found

    with pytest.MonkeyPatch.context() as patched, threads_as_users_have_them():
        patched.setattr(EndoscopicSequence, "load", noted)
        outcome = run_sequence(SEQUENCE, tiny_config(), store, DirectRunner(store), profile="quick")
    if outcome.error is not None:
        raise outcome.error
    return store, outcome


@pytest.fixture
def untouched_environment() -> Iterator[None]:
    """The command sets up Prefect through the environment; put it back."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)
