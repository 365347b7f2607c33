"""Tasks on Dask workers that know the server of their run.

A Dask worker is a process of its own with Prefect settings of its own. Left alone, each would start a server,
keep the address of the first run for all runs to come, and send the last events of a run to a server that is
gone. So each run tells all workers its server and its settings before the first task, has them say whether
they reach it, and has them send what they still hold before it ends.
"""

from __future__ import annotations

import asyncio
import atexit
import logging
import os
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen
from uuid import uuid4

import dask
import distributed
from distributed.diagnostics.plugin import WorkerPlugin
from prefect.settings import PREFECT_API_URL
from prefect_dask import DaskTaskRunner

from extrags.errors import ConfigError, reason_of
from tasks.machine import asks_for_gpu
from tasks.page_choice import PAGE_VARIABLE

__all__ = ["ClusterTaskRunner", "needed_resources"]

log = logging.getLogger(__name__)

# Importing it has set the level anew: each connection, and each stream that a client closes, would be told.
if logging.getLogger("distributed").level == logging.INFO:
    logging.getLogger("distributed").setLevel(logging.WARNING)

PASSED_ON = (
    "PREFECT_API_URL",
    "PREFECT_API_KEY",
    "PREFECT_API_AUTH_STRING",
    "PREFECT_LOGGING_LEVEL",
    "PREFECT_LOGGING_TO_API_ENABLED",
    PAGE_VARIABLE,
    "EXTRAGS_VERIFY",
)
"""Variables that are the same on all workers as in the process of the run, or absent."""
REACH_SECONDS = 5.0
"""How long a worker tries to reach the server."""
DRAIN_SECONDS = 10.0
"""How long a worker may take to send the last events of a run."""

CLOSE_SECONDS = 1.0
"""How long the workers of this process may take to end; Prefect's threads would keep them for seconds."""

_cluster: distributed.LocalCluster | None = None
_cluster_guard = threading.Lock()

_servers: dict[str, str] = {}
"""On a worker: address of the server of each run it works for."""


class ClusterTaskRunner(DaskTaskRunner):  # type: ignore[misc]
    """Prefect's task runner for Dask, with workers that use the server of the run.

    Args:
        address: of a scheduler that is already up; else a cluster of this machine that the process keeps.
        workers: how many processes that has, each with one task at a time.
        at_once: how many runs share them.
    """

    def __init__(self, address: str | None = None, workers: int = 1, at_once: int = 1) -> None:
        super().__init__(address=address)
        self._given = address
        self._workers = workers
        self._at_once = at_once
        self._run = f"extrags-{uuid4()}"
        self._adopted = False
        self._resources: dict[str, float] | None = None

    def duplicate(self) -> ClusterTaskRunner:
        """As Prefect does for each flow run."""
        return type(self)(self._given, self._workers, self._at_once)

    @property
    def client(self) -> Any:
        """The Dask client; made, and the workers told of the run, at the first use.

        Raises:
            ConfigError: when the workers cannot be used for this run.
        """
        if self._client is None:
            if self._given is None:
                self.address = _local_cluster(self._workers).scheduler_address
            _adopt(DaskTaskRunner.client.fget(self), self._run)
            self._adopted = True
        return self._client

    def __exit__(self, *args: Any) -> None:
        """Let the workers send what they hold while the server is there."""
        if self._adopted:
            try:
                self._client.unregister_worker_plugin(self._run)
            except Exception as error:
                log.warning("could not tell the Dask workers that the run has ended: %s", reason_of(error))
        super().__exit__(*args)

    def threads_for(self, tasks: int) -> int | None:
        """Threads for each of some tasks that are submitted together, so that there are as many as cores.

        None on a cluster of somebody else, who has decided that.
        """
        return None if self._given is not None else max(1, self._workers // (tasks * self._at_once))

    def placed(
        self, inputs: Mapping[str, Any], peak_mib: Callable[[], float | None]
    ) -> AbstractContextManager[object]:
        """What is submitted inside the block goes where there is what it needs (`needed_resources`)."""
        needed = needed_resources(inputs, peak_mib, self.resources) if self.resources else {}
        return dask.annotate(resources=needed) if needed else nullcontext()

    @property
    def resources(self) -> dict[str, float]:
        """The largest amount of each resource that a worker declares (`dask worker --resources GPU=1`)."""
        if self._resources is None:
            self._resources = {}
            for worker in self.client.scheduler_info(n_workers=-1)["workers"].values():
                for name, amount in (worker.get("resources") or {}).items():
                    self._resources[name] = max(amount, self._resources.get(name, 0.0))
        return self._resources


def needed_resources(
    inputs: Mapping[str, Any], peak_mib: Callable[[], float | None], declared: Mapping[str, float]
) -> dict[str, float]:
    """What a task takes of the resources that workers declare; nothing of those that none does.

    `GPU`: 1 for a task whose device, or one in its settings, is `cuda`. `MEMORY`, in bytes: what such
    tasks took before, and no more than the largest worker has, since a task that needs more would wait for
    ever.

    Args:
        inputs: of the task.
        peak_mib: looks up the largest memory of such a task before, None where there was none.
        declared: see `ClusterTaskRunner.resources`.
    """
    needed = {}
    if "GPU" in declared and asks_for_gpu(inputs):
        needed["GPU"] = 1.0
    before = peak_mib() if "MEMORY" in declared else None
    if before is not None:
        needed["MEMORY"] = min(before * 2**20, declared["MEMORY"])
    return needed


def _local_cluster(workers: int) -> distributed.LocalCluster:
    """The cluster of this process: starting one takes seconds, so all runs of the process share it."""
    global _cluster
    with _cluster_guard:
        if _cluster is None:
            # Told no port, Dask takes 8787 for its metrics, and warns where another cluster has it.
            _cluster = distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=":0"
            )
            atexit.register(_close, _cluster)
        return _cluster


def _close(cluster: distributed.LocalCluster) -> None:
    """All tasks are done and their events sent: nothing is left to wait for, nor to be told."""
    for name in ("distributed.nanny", "distributed.scheduler", "distributed.worker", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # What has not ended by then is killed with the process.
    with suppress(TimeoutError):
        cluster.close(timeout=CLOSE_SECONDS)


def _adopt(client: distributed.Client, run: str) -> None:
    """Tell all workers, those to come as well, of a run.

    Raises:
        ConfigError: when one of them cannot work for it.
    """
    settings = {name: os.environ.get(name) for name in PASSED_ON}
    # From a profile or a file as well.
    settings["PREFECT_API_URL"] = PREFECT_API_URL.value()
    try:
        client.register_plugin(RunOnWorker(run, settings), name=run)
        problems = client.run(_problem, settings["PREFECT_API_URL"])
    except ImportError as error:
        raise ConfigError(
            f"the Dask workers have no extrags, or another one ({error}); start them with the Python of this "
            "installation"
        ) from error
    for worker, problem in problems.items():
        if problem:
            client.unregister_worker_plugin(run)
            raise ConfigError(f"the Dask worker {worker} {problem}")


class RunOnWorker(WorkerPlugin):  # type: ignore[misc]
    """Gives a worker the settings of a run, for as long as it goes on.

    Args:
        run: name of the run.
        settings: variables of the environment; None where it has none.
    """

    def __init__(self, run: str, settings: dict[str, str | None]) -> None:
        self.run = run
        self.settings = settings

    async def setup(self, worker: distributed.Worker) -> None:
        """The worker starts, or the run does."""
        # Does not refuse: the plugin of a process that was killed stays, and workers must still start.
        await asyncio.to_thread(self._take)

    async def teardown(self, worker: distributed.Worker) -> None:
        """The run ends."""
        await asyncio.to_thread(_drain)
        _servers.pop(self.run, None)

    def _take(self) -> None:
        address = self.settings["PREFECT_API_URL"] or ""
        if _other_server(address):
            return
        _servers[self.run] = address
        for name, value in self.settings.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        # Whatever happens, a worker has no server of its own.
        os.environ["PREFECT_SERVER_EPHEMERAL_ENABLED"] = "false"
        import prefect.context

        # What sends events and log lines belongs to the process, not to a task: it takes these.
        prefect.context.GLOBAL_SETTINGS_CONTEXT = prefect.context.root_settings_context()
        # What they hold is for the server of a run before.
        _drain()
        # Now, all workers at once, rather than in the first task of each.
        import flows.wiring  # noqa: F401


def _drain() -> None:
    """Send what is held, and end what sends it: the next run may have another server."""
    from prefect.events.worker import EventsWorker
    from prefect.logging.handlers import APILogWorker

    for service in (EventsWorker, APILogWorker):
        service.drain_all(timeout=DRAIN_SECONDS, at_exit=False)


def _other_server(address: str) -> str:
    """The server of another run that this worker still works for; empty if there is none."""
    for run, other in list(_servers.items()):
        if other != address:
            if _answers(other):
                return other
            # Its process was killed, and its server went with it.
            del _servers[run]
    return ""


async def _problem(address: str | None) -> str:
    """On a worker: why it cannot work for a run, with what to do; empty if it can."""
    return await asyncio.to_thread(_reason, address or "")


def _reason(address: str) -> str:
    other = _other_server(address)
    if other:
        return (
            f"works for a run on another Prefect server ({other}); wait until that has ended, or use one "
            "server for both"
        )
    if not _answers(address):
        return (
            f"cannot reach the Prefect server of this run at {address}; start `prefect server start --host "
            "0.0.0.0` where all workers reach it, and set PREFECT_API_URL to its address"
        )
    return ""


def _answers(address: str) -> bool:
    try:
        with urlopen(f"{address}/health", timeout=REACH_SECONDS) as response:
            return bool(response.status == 200)
    except (URLError, OSError, ValueError):
        return False
