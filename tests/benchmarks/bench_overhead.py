"""What a command costs beside its stages: `python -m tests.benchmarks.bench_overhead [--rounds N]`.

The tiny sequence of the tests goes through all stages without anything in the store, in turns

* `direct`: plain calls in one process, no server (`flows.runners.DirectRunner`),
* `running`: `extrags run` with a Prefect server that is up already,
* `temporary`: `extrags run` with a server of its own, and a store that has no database of Prefect's yet,
* `again`: the same in a store that holds nothing but that database.

`--runner` names the task runner of the last three. The overhead is the wall time of the process less the time
in which any stage was at work (`Manifest.seconds` up to the time its manifest was written); importing torch
and the kernels is part of it, since somebody waits for that as well.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from extrags.store import Store
from extrags.store.manifest import MANIFEST
from tests.flows.tiny import SEQUENCE, TINY

SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]
WAYS = ("direct", "running", "temporary", "again")
START_SECONDS = 120.0


def run_once(way: str, store: Path, runner: str, environment: dict[str, str]) -> tuple[float, float, float]:
    """Wall time of one process, the seconds its stages took, and its processor time, its server included."""
    if way == "direct":
        command = ["-m", "tests.flows.tiny", str(store)]
    else:
        command = ["-m", "flows.cli", "run", SEQUENCE, "--profile", "quick", *SETTINGS]
        command += ["--store", str(store), "--runner", runner]
    clock, processor = time.monotonic(), _children_seconds()
    ended = subprocess.run([sys.executable, *command], env=environment, capture_output=True, check=False)
    seconds = time.monotonic() - clock
    if ended.returncode:
        raise SystemExit(ended.stderr.decode())
    return seconds, _at_work(store), _children_seconds() - processor


def _children_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _at_work(store: Path) -> float:
    """Seconds in which at least one stage was at work."""
    intervals = []
    for manifest in Store(store).ls():
        end = (store / "artefacts" / manifest.key / MANIFEST).stat().st_mtime
        intervals.append((end - manifest.seconds, end))
    covered, last = 0.0, 0.0
    for begin, end in sorted(intervals):
        covered += max(0.0, end - max(begin, last))
        last = max(last, end)
    return covered


@contextmanager
def running_server(place: Path, environment: dict[str, str]) -> Iterator[str]:
    """A server that lasts, with a home of its own; its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    address = f"http://127.0.0.1:{port}/api"
    command = [sys.executable, "-m", "prefect", "server", "start", "--host", "127.0.0.1", "--port", port]
    with (place / "server.log").open("wb") as log:
        server = subprocess.Popen(
            command, env={**environment, "PREFECT_HOME": str(place / "home")}, stdout=log, stderr=log
        )
        try:
            end = time.monotonic() + START_SECONDS
            while time.monotonic() < end:
                try:
                    if httpx.get(f"{address}/health").status_code == httpx.codes.OK:
                        break
                except httpx.TransportError:
                    time.sleep(0.2)
            yield address
        finally:
            server.terminate()
            server.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runner", default="threads")
    parser.add_argument("--ways", default=",".join(WAYS))
    given = parser.parse_args()
    ways = given.ways.split(",")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment |= {"PREFECT_SERVER_ANALYTICS_ENABLED": "false", "DO_NOT_TRACK": "1"}
    found: dict[str, list[tuple[float, float, float]]] = {way: [] for way in ways}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        with running_server(place, environment) as address:
            lasting = {
                **environment,
                "PREFECT_API_URL": address,
                "PREFECT_HOME": str(place / "client"),
            }
            for index in range(given.rounds):
                for way in ways:
                    store = place / f"{way}{index}"
                    if way == "again":
                        shutil.copytree(place / f"temporary{index}" / "prefect", store / "prefect")
                    took = run_once(way, store, given.runner, lasting if way == "running" else environment)
                    found[way].append(took)
                    print(_line(way, *took), file=sys.stderr)
                for left in place.glob("*[0-9]"):
                    shutil.rmtree(left)
    for way, rounds in found.items():
        overhead = statistics.median(seconds - stages for seconds, stages, _ in rounds)
        print(f"{_line(way, *map(statistics.median, zip(*rounds, strict=True)))}  overhead {overhead:6.2f} s")


def _line(way: str, seconds: float, stages: float, processor: float) -> str:
    return f"{way:10} wall {seconds:6.2f} s  stages {stages:6.2f} s  processor {processor:6.2f} s"


if __name__ == "__main__":
    main()
