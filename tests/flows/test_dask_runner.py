"""Dask workers and the server of their run."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import dask
import distributed
import pytest
from prefect.settings import PREFECT_API_URL, temporary_settings

import flows.dask_runner
from extrags.config import CoarseConfig, DepthConfig, profile_config
from flows.dask_runner import ClusterTaskRunner, needed_resources
from flows.settings import task_runner
from tests.flows.tiny import SEQUENCE, TINY

SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]
NOBODY = "http://127.0.0.1:9/api"

CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


class Health(BaseHTTPRequestHandler):
    """Says that all is well."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nobody reads it."""


@pytest.fixture
def server() -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Health) as served:
        Thread(target=served.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{served.server_port}/api"
        served.shutdown()


@pytest.fixture(autouse=True)
def no_runs(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    runs: dict[str, str] = {}
    monkeypatch.setattr(flows.dask_runner, "_servers", runs)
    return runs


def test_a_worker_that_does_not_reach_the_server_says_what_to_do() -> None:
    said = flows.dask_runner._reason(NOBODY)
    assert "cannot reach the Prefect server of this run at http://127.0.0.1:9/api" in said
    assert "set PREFECT_API_URL" in said


def test_a_worker_serves_one_server_at_a_time(server: str, no_runs: dict[str, str]) -> None:
    assert flows.dask_runner._reason(server) == ""
    no_runs["other"] = server
    assert flows.dask_runner._reason(server) == ""
    assert f"works for a run on another Prefect server ({server})" in flows.dask_runner._reason(NOBODY)


def test_a_run_whose_server_is_gone_is_forgotten(server: str, no_runs: dict[str, str]) -> None:
    no_runs["killed"] = NOBODY
    assert flows.dask_runner._reason(server) == ""
    assert no_runs == {}


@pytest.mark.parametrize(
    ("tasks", "at_once", "threads"), [(1, 1, 8), (2, 1, 4), (5, 1, 1), (1, 4, 2), (99, 9, 1)]
)
def test_kernel_threads_are_never_more_than_cores(tasks: int, at_once: int, threads: int) -> None:
    runner = ClusterTaskRunner(workers=8, at_once=at_once)
    assert runner.threads_for(tasks) == threads
    assert runner.duplicate().threads_for(tasks) == threads
    assert ClusterTaskRunner("tcp://127.0.0.1:1", 8).threads_for(tasks) is None


def test_messages_of_dask_are_those_of_something_wrong() -> None:
    """Its import sets levels of its own, by which each stream that is closed was told."""
    code = (
        "import logging\n"
        "from flows.commands.common import set_up_logging\n"
        "set_up_logging(debug=False, terminal=False)\n"
        "import flows.dask_runner\n"
        "log = logging.getLogger('distributed.core')\n"
        "log.info(\"Received 'close-stream' from %s; closing.\", 'tcp://127.0.0.1:1')\n"
        "log.error('a task failed')\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr
    assert "close-stream" not in said
    assert "a task failed" in said


def test_runners_by_name() -> None:
    assert isinstance(task_runner("dask"), ClusterTaskRunner)
    assert task_runner("dask:tcp://127.0.0.1:8786").address == "tcp://127.0.0.1:8786"


@pytest.mark.slow
def test_each_run_on_a_lasting_cluster_reaches_its_own_server(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    log = tmp_path / "workers.log"
    with (
        log.open("wb") as stream,
        subprocess.Popen(
            [sys.executable, str(script)],
            env={**environment, "PREFECT_HOME": str(tmp_path / "workers")},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stream,
            text=True,
        ) as cluster,
    ):
        assert cluster.stdout is not None
        address = cluster.stdout.readline().strip()
        for name in ("first", "second"):
            store = tmp_path / name
            command = [sys.executable, "-m", "flows.cli", "run", SEQUENCE, "--profile", "quick", *SETTINGS]
            command += ["--store", str(store), "--until", "coarse", "--runner", f"dask:{address}"]
            ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            assert ended.returncode == 0, ended.stderr
            assert "failed to process" not in ended.stderr
            # Each server has heard of the ends of its own tasks: ingest, training frames, coarse.
            with sqlite3.connect(store / "prefect" / "prefect.db") as database:
                rows = database.execute("SELECT state_type FROM task_run").fetchall()
            database.close()
            assert [row for row in rows if row != ("COMPLETED",)] == []
            assert len(rows) >= 3
        # The workers have no server of their own: it would have made a database.
        assert not (tmp_path / "workers" / "prefect.db").exists()
        cluster.communicate()
    assert "failed to process" not in log.read_text()


class TestResources:
    def test_tasks_take_what_workers_declare(self) -> None:
        on_gpu = {"config": DepthConfig(device="cuda"), "seed": 3}
        plain = {"config": DepthConfig(device="cpu")}
        declared = {"GPU": 1.0, "MEMORY": 4e9}
        assert needed_resources(on_gpu, lambda: None, declared) == {"GPU": 1.0}
        assert needed_resources(plain, lambda: None, declared) == {}
        assert needed_resources(plain, lambda: 1000.0, declared) == {"MEMORY": 1000 * 2**20}
        assert needed_resources(plain, lambda: 9000.0, declared) == {"MEMORY": 4e9}

    def test_what_no_worker_declares_is_not_asked_for(self) -> None:
        def unasked() -> float:
            raise AssertionError("the store is not read")

        assert needed_resources({"config": DepthConfig(device="cuda")}, unasked, {}) == {}

    def test_a_device_deep_in_the_settings_counts(self) -> None:
        enhance = profile_config("quick").with_overrides({"enhance.pretrained.device": "cuda"}).enhance
        assert needed_resources({"config": enhance}, lambda: None, {"GPU": 1.0}) == {"GPU": 1.0}

    def test_a_task_is_told_its_device(self) -> None:
        inputs = {"config": CoarseConfig(), "device": "cuda"}
        assert needed_resources(inputs, lambda: None, {"GPU": 1.0}) == {"GPU": 1.0}
        assert needed_resources({**inputs, "device": "cpu"}, lambda: None, {"GPU": 1.0}) == {}

    def test_the_page_of_a_run_on_a_gpu_needs_none(self) -> None:
        whole = profile_config("quick").with_overrides({"device": "cuda", "depth.device": "cuda"})
        assert needed_resources({"config": whole}, lambda: None, {"GPU": 1.0}) == {}

    def test_workers_are_asked(self, server: str) -> None:
        with (
            distributed.LocalCluster(
                n_workers=1,
                threads_per_worker=2,
                processes=False,
                dashboard_address=":0",
                resources={"GPU": 1},
            ) as cluster,
            temporary_settings({PREFECT_API_URL: server}),
            ClusterTaskRunner(cluster.scheduler_address) as runner,
        ):
            assert runner.resources == {"GPU": 1}
            with runner.placed({"config": DepthConfig(device="cuda")}, lambda: None):
                assert dask.get_annotations() == {"resources": {"GPU": 1.0}}
            with runner.placed({"config": DepthConfig(device="cpu")}, lambda: None):
                assert dask.get_annotations() == {}
