"""Many sequences through a real deployment: `python -m tests.benchmarks.bench_deployment FOLDER`.

A Prefect server, a process work pool and its workers are started as docs/running_at_scale.md says; small
phantoms go through the deployment `reconstruct-dataset/nightly`, shared out evenly where there are two
workers, each of which has a core of its own. While they run, the sizes of Prefect's database and of the
store, and the memory of server and flow processes are recorded whenever a sequence has ended.

*Overhead* is the share of a worker's time, from the start of its flow run to the end, in which no stage was
at work. What it takes to get a run to a worker (its poll, and the start of Python) is told apart.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from extrags.store import Manifest, Store
from extrags.store.manifest import MANIFEST
from tests.flows.killing import free_port, wait_for

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = {
    "ingest.width": 96,
    "ingest.height": 80,
    "coarse.iterations": 400,
    "finetune.iterations": 200,
    "explore.trajectories": 4,
    "enhance.train_iterations": 40,
    "enhance.max_views": 24,
}


def resident_mib(process: int) -> float:
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        return 0.0
    return next(
        (int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS")), 0.0
    )


def descendants(process: int) -> list[int]:
    said = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True)
    children = [int(word) for word in said.stdout.split()]
    return [*children, *(below for child in children for below in descendants(child))]


def busy_seconds(store: Path, manifests: Sequence[Manifest], begun: float, ended: float) -> float:
    """Time within which at least one stage was at work."""
    spans = []
    for manifest in manifests:
        # When it was written: `started` has whole seconds only, which would make gaps where there are none.
        end = (store / "artefacts" / manifest.key / MANIFEST).stat().st_mtime
        spans.append((end - manifest.seconds, end))
    busy, reached = 0.0, begun
    for start, end in sorted(spans):
        busy += max(0.0, min(end, ended) - max(start, reached))
        reached = max(reached, min(end, ended))
    return busy


def files_in(folder: Path) -> int:
    return sum(len(files) for _, _, files in os.walk(folder))


def slope(points: Sequence[float]) -> float:
    """Growth per sequence, least squares, of what was recorded after the first quarter."""
    later = points[len(points) // 4 :]
    if len(later) < 2:
        return 0.0
    return statistics.linear_regression(range(len(later)), later).slope


class Site:
    """Server, pool and workers in a folder, for `workers` deployed runs over all sequences."""

    def __init__(self, folder: Path, workers: int, cores: Sequence[int]) -> None:
        self.folder, self.workers, self.cores = folder, workers, cores
        self.store = folder / "store"
        self.address = f"http://127.0.0.1:{free_port()}/api"
        self.environment = {
            **os.environ,
            "PREFECT_HOME": str(folder / "prefect"),
            "PREFECT_API_URL": self.address,
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "EXTRAGS_STORE": str(self.store),
            "OMP_WAIT_POLICY": "passive",
            "PREFECT_CLI_PROMPT": "false",
        }
        self.stack = ExitStack()

    def start(self, *arguments: str, log: str, core: int | None = None) -> subprocess.Popen[bytes]:
        pinned = [] if core is None else ["taskset", "--cpu-list", str(core)]
        with (self.folder / log).open("ab") as stream:
            process = subprocess.Popen(
                [*pinned, sys.executable, "-m", "prefect", *arguments],
                stdout=stream,
                stderr=stream,
                env=self.environment,
                cwd=ROOT,
                start_new_session=True,
            )
        self.stack.callback(process.wait)
        self.stack.callback(os.killpg, process.pid, signal.SIGKILL)
        return process

    def prefect(self, *arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "prefect", *arguments],
            capture_output=True,
            text=True,
            env=self.environment,
            cwd=ROOT,
        )
        if done.returncode:
            raise RuntimeError(done.stdout + done.stderr)
        return done.stdout

    def api(self, path: str, body: dict[str, Any]) -> Any:
        import httpx

        answer = httpx.post(f"{self.address}/{path}", json=body, timeout=60)
        answer.raise_for_status()
        return answer.json()

    def ready(self) -> bool:
        import httpx

        try:
            return httpx.get(f"{self.address}/health", timeout=2).status_code == 200
        except httpx.TransportError:
            time.sleep(0.2)
            return False


def run(folder: Path, sequences: Sequence[str], workers: int, cores: Sequence[int]) -> dict[str, Any]:
    """All sequences on so many workers; figures."""
    folder.mkdir(parents=True)
    site = Site(folder, workers, cores)
    with site.stack:
        port = site.address.rpartition(":")[2].partition("/")[0]
        server = site.start(
            "server", "start", "--host", "127.0.0.1", "--port", port, "--no-ui", log="server.log"
        )
        wait_for(site.ready, "the server to answer")
        site.prefect("work-pool", "create", "local", "--type", "process")
        site.prefect("--no-prompt", "deploy", "--all")
        [deployment] = site.api("deployments/filter", {"deployments": {"name": {"any_": ["nightly"]}}})
        # The deployment lets one run work at a time: here each worker has one.
        import httpx

        httpx.patch(
            f"{site.address}/deployments/{deployment['id']}", json={"concurrency_limit": workers}, timeout=60
        ).raise_for_status()
        pool = [
            site.start("worker", "start", "--pool", "local", "--type", "process", "--limit", "1",
                       "--name", f"worker-{index}", log=f"worker-{index}.log", core=cores[index])
            for index in range(workers)
        ]  # fmt: skip
        submitted = time.time()
        runs = [
            site.api(
                f"deployments/{deployment['id']}/create_flow_run",
                {
                    "name": f"part-{index}",
                    "state": {"type": "SCHEDULED"},
                    "parameters": {
                        **deployment["parameters"],
                        "sequences": list(sequences[index::workers]),
                        "profile": "quick",
                        "settings": SETTINGS,
                        "store": str(site.store),
                        "name": f"part-{index}",
                    },
                },
            )["id"]
            for index in range(workers)
        ]
        samples: list[dict[str, float]] = []

        def ended() -> bool:
            time.sleep(1.0)
            reports = len(list((site.store / "artefacts").glob("report-v*")))
            if reports > len(samples):
                flows = [resident_mib(child) for process in pool for child in descendants(process.pid)]
                database = sum(file.stat().st_size for file in (folder / "prefect").glob("prefect.db*"))
                samples.append(
                    {
                        "sequences": reports,
                        "seconds": time.time() - submitted,
                        "database_kib": database / 1024,
                        "files": files_in(site.store),
                        "flow_mib": max(flows, default=0.0),
                        "server_mib": sum(map(resident_mib, [server.pid, *descendants(server.pid)])),
                    }
                )
            states = site.api("flow_runs/filter", {"flow_runs": {"id": {"any_": runs}}})
            return all(state["state"]["type"] in ("COMPLETED", "FAILED", "CRASHED") for state in states)

        wait_for(ended, "the runs to end", 3600)
        finished = site.api("flow_runs/filter", {"flow_runs": {"id": {"any_": runs}}})
    manifests = Store(str(site.store)).ls()
    per_run = []
    for state in finished:
        index = int(state["name"].rpartition("-")[2])
        begun = datetime.datetime.fromisoformat(state["start_time"]).timestamp()
        end = datetime.datetime.fromisoformat(state["end_time"]).timestamp()
        mine = {*sequences[index::workers], state["name"]}
        busy = busy_seconds(site.store, [item for item in manifests if item.label in mine], begun, end)
        per_run.append(
            {
                "state": state["state"]["name"],
                "to_the_worker_s": begun - submitted,
                "seconds": end - begun,
                "overhead_share": 1 - busy / (end - begun),
            }
        )
    wall = max(item["seconds"] + item["to_the_worker_s"] for item in per_run)
    done = len([item for item in manifests if item.stage == "report"])
    return {
        "workers": workers,
        "sequences": done,
        "seconds": wall,
        "sequences_per_hour": 3600 * done / wall,
        "runs": per_run,
        "growth_per_sequence": {
            name: slope([sample[name] for sample in samples])
            for name in ("database_kib", "files", "flow_mib", "server_mib")
        },
        "samples": samples,
        "digests": {f"{item.label} {item.key}": item.digest for item in manifests if item.label in sequences},
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sequences", type=int, default=24)
    given = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    sequences = [f"phantom/{100 + number}@sparse" for number in range(given.sequences)]
    found = []
    for workers in given.workers:
        place = given.folder / f"workers-{workers}"
        shutil.rmtree(place, ignore_errors=True)
        found.append(run(place, sequences, workers, cores))
    same = all(one["digests"] == found[0]["digests"] for one in found)
    for one in found:
        del one["digests"]
    print(json.dumps({"runs": found, "same_artefacts": same}, indent=1))


if __name__ == "__main__":
    main()
