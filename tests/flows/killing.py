"""Kill runs, Dask workers and servers, and see what is left, and what is made in the end.

`python -m tests.flows.killing runs|workers|servers COUNT [--seed N] [--keep FOLDER]` does to the tiny
sequence, through `extrags run` and a Prefect server that lasts, what power cuts and operators do to larger
ones:

* runs: the artefacts of one stage are removed, a command is started, killed with its whole process group at a
  random moment of that stage, and started again. Every stage has its turn.
* workers: the same with a Dask cluster; what is killed is the worker that has the stage in work.
* servers: the server is killed in the middle of a stage and comes back; its command goes on meanwhile.

After each of them the artefacts must be those of an undisturbed run, bit by bit, and nothing may be left.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from extrags.store import Store
from tests.flows.tiny import SEQUENCE, TINY, spared

T = TypeVar("T")

PATIENCE_S = 300.0
SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]


@dataclass
class Command:
    """`extrags run` of the tiny sequence, as a process group of its own.

    It is forked from this process, which has loaded everything: loading would take most of the time.

    Args:
        store: its store.
        runner: `threads` or `dask:ADDRESS`.
        log: what it prints goes here.
    """

    store: Path
    runner: str
    log: Path
    pid: int = field(default=0, init=False)
    code: int | None = field(default=None, init=False)

    def start(self) -> Command:
        self.code = None
        self.pid = os.fork()
        if self.pid == 0:
            os.setsid()
            out = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(out, 1)
            os.dup2(out, 2)
            from flows.cli import main

            sys.argv = ["extrags", "run", SEQUENCE, "--profile", "quick", *SETTINGS]
            sys.argv += ["--store", str(self.store), "--runner", self.runner]
            code = 70
            try:
                code = main()
            finally:
                os._exit(code)
        return self

    def ended(self) -> bool:
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is not None

    def wait(self) -> int:
        wait_for(self.ended, "the command to end")
        assert self.code is not None
        return self.code

    def kill(self) -> None:
        if not self.ended():
            os.killpg(self.pid, signal.SIGKILL)
            self.wait()


def wait_for(ready: Callable[[], T], what: str, seconds: float = PATIENCE_S, *, every_s: float = 0.002) -> T:
    """What is found, as soon as it counts as true."""
    begun = time.monotonic()
    while not (found := ready()):
        if time.monotonic() - begun > seconds:
            raise TimeoutError(f"{what}: not within {seconds:g} s")
        time.sleep(every_s)
    return found


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


class Server:
    """A Prefect server that can be killed and comes back at the same place, with the same database."""

    def __init__(self, port: int, log: Path) -> None:
        self._port, self._log = port, log
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        arguments = ["-m", "prefect", "server", "start", "--host", "127.0.0.1", "--port", str(self._port)]
        # Its database lies beside the log, and so with the trials.
        environment = os.environ | {"PREFECT_HOME": str(self._log.with_name("prefect"))}
        with self._log.open("ab") as stream:
            self._process = subprocess.Popen(
                [sys.executable, *arguments, "--no-ui"],
                stdout=stream,
                stderr=stream,
                env=environment,
                start_new_session=True,
            )
        wait_for(self._answers, "the server to answer")

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/api/health", timeout=2) as answer:
                return bool(answer.status == 200)
        except OSError:
            time.sleep(0.1)
            return False

    def kill(self) -> None:
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def unfinished(self) -> int:
        """Flow runs that it takes for running."""
        body = json.dumps({"flow_runs": {"state": {"type": {"any_": ["RUNNING", "PENDING", "CANCELLING"]}}}})
        request = urllib.request.Request(
            f"http://127.0.0.1:{self._port}/api/flow_runs/count",
            body.encode(),
            {"Content-Type": "application/json"},
        )
        with urllib.request.urlopen(request, timeout=30) as answer:
            return int(json.load(answer))


@contextmanager
def dask_workers(count: int, log: Path) -> Iterator[str]:
    """A scheduler and workers of one thread, restarted by their nanny when they die; yields the address."""
    address = f"tcp://127.0.0.1:{free_port()}"
    with log.open("ab") as stream, ExitStack() as stack:
        for arguments in (
            ["scheduler", "--host", address, "--no-dashboard"],
            ["worker", address, "--nworkers", str(count), "--nthreads", "1", "--no-dashboard"],
        ):
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments],
                stdout=stream,
                stderr=stream,
                start_new_session=True,
            )
            stack.callback(os.killpg, process.pid, signal.SIGKILL)
        yield address


def holder(folder: Path) -> int | None:
    """The process that has a scratch directory locked."""
    try:
        inode = folder.stat().st_ino
    except FileNotFoundError:
        return None
    for line in Path("/proc/locks").read_text().splitlines():
        *_, process, file, _, _ = line.split()
        if "FLOCK" in line and file.rpartition(":")[2] == str(inode):
            return int(process)
    return None


@dataclass
class Trials:
    """The tiny sequence in one store, disturbed again and again.

    Args:
        folder: for the store and the logs.
        runner: of its commands.
        seed: of the moments.
    """

    folder: Path
    runner: str = "threads"
    seed: int = 0

    def __post_init__(self) -> None:
        self.store = Store(str(self.folder / "store"))
        self.chance = random.Random(self.seed)
        self.command = Command(self.folder / "store", self.runner, self.folder / "commands.log")
        self.counts: Counter[str] = Counter()
        self.hits: Counter[str] = Counter()
        # Twice: at first workers load what they need, and times of that run would put kills after the commit.
        for _ in range(2):
            self.store.rm("*")
            assert self.command.start().wait() == 0, f"see {self.command.log}"
        manifests = self.store.ls()
        self.undisturbed = {manifest.key: manifest.digest for manifest in manifests}
        stages = sorted(manifests, key=lambda manifest: manifest.started)
        self.stages = list(dict.fromkeys(manifest.stage for manifest in stages))
        self.seconds = {
            stage: max(manifest.seconds for manifest in manifests if manifest.stage == stage)
            for stage in self.stages
        }

    def begin(self, stage: str) -> Path | None:
        """Start a command and wait for a random moment of a stage; its scratch directory, if it has one."""
        self.store.rm(stage)
        self.command.start()

        def scratch() -> Path | None:
            return next(iter((self.folder / "store" / "scratch").glob(f"{stage}-v*")), None)

        wait_for(lambda: scratch() is not None or self.command.ended(), f"{stage} to begin")
        found = scratch()
        # A little longer than it takes, for kills at and just after the commit.
        time.sleep(self.chance.uniform(0.0, 1.05 * self.seconds[stage]))
        return found

    def judge(self, stage: str, code: int) -> None:
        """Compare what is in the store with the undisturbed run, and look for what was left."""
        self.counts["trials"] += 1
        self.counts[f"exit code {code}"] += 1
        manifests = self.store.ls()
        # The first run was slow: it loaded what its workers need.
        self.seconds[stage] = min([self.seconds[stage], *(m.seconds for m in manifests if m.stage == stage)])
        found = {manifest.key: manifest.digest for manifest in manifests}
        other = [key for key in {**found, **self.undisturbed} if found.get(key) != self.undisturbed.get(key)]
        damaged = [key for key in found if self.store.examine(key) is not None]
        root = self.folder / "store"
        left = [
            str(path.relative_to(root))
            for path in itertools.chain(
                *(root.glob(f"{name}/*") for name in ("scratch", "damaged", "failed"))
            )
        ]
        for name, wrong in (("other artefacts", other), ("damaged", damaged), ("left behind", left)):
            self.counts[name] += bool(wrong)
            if wrong:
                print(f"{stage}: {name}: {', '.join(wrong)}", flush=True)

    def kill_run(self, stage: str) -> None:
        """Kill the whole command in a stage; then run it again."""
        scratch = self.begin(stage)
        inside = scratch is not None and scratch.is_dir()
        self.command.kill()
        self.hits[stage] += inside
        self.counts["killed before the stage's artefact was there"] += inside
        every = self.store.keys()
        half = [key for key in every if self.store.examine(key) is not None]
        self.counts["half-written artefacts"] += len(half)
        self.judge(stage, self.command.start().wait())
        where = "inside" if inside else "outside"
        print(f"{self.counts['trials']} {stage} {where}", file=sys.stderr, flush=True)

    def kill_worker(self, stage: str) -> None:
        """Kill the Dask worker that has the stage in work."""
        scratch = self.begin(stage)
        worker = holder(scratch) if scratch is not None else None
        if worker is not None:
            os.kill(worker, signal.SIGKILL)
            self.hits[stage] += 1
        self._to_the_end(stage)

    def kill_server(self, stage: str, server: Server) -> None:
        """Kill the server in a stage, and start it again."""
        scratch = self.begin(stage)
        self.hits[stage] += scratch is not None and scratch.is_dir()
        server.kill()
        time.sleep(self.chance.uniform(0.0, 2.0))
        server.start()
        self._to_the_end(stage)

    def _to_the_end(self, stage: str) -> None:
        code = self.command.wait()
        if code != 0:
            self.counts["had to be run again"] += 1
            code = self.command.start().wait()
        self.judge(stage, code)

    def report(self) -> dict[str, Any]:
        return {"counts": dict(self.counts), "hits by stage": {s: self.hits[s] for s in self.stages}}


def campaign(kind: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """So many kills of one kind, evenly over the stages."""
    with ExitStack() as stack:
        port = int(os.environ["PREFECT_API_URL"].rpartition(":")[2].partition("/")[0])
        server = Server(port, folder / "server.log")
        server.start()
        stack.callback(server.kill)
        runner = "threads"
        if kind == "workers":
            runner = f"dask:{stack.enter_context(dask_workers(2, folder / 'dask.log'))}"
        else:
            stack.enter_context(spared())
        import flows.commands.run
        import flows.dataset  # noqa: F401  (what forked commands need is loaded once)

        trials = Trials(folder, runner, seed)
        for stage in itertools.islice(itertools.cycle(trials.stages), count):
            match kind:
                case "runs":
                    trials.kill_run(stage)
                case "workers":
                    trials.kill_worker(stage)
                case "servers":
                    trials.kill_server(stage, server)
        return {**trials.report(), "flow runs that the server takes for running": server.unfinished()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=("runs", "workers", "servers"))
    parser.add_argument("count", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep store and logs here")
    given = parser.parse_args()
    if "PREFECT_API_URL" not in os.environ:
        # Prefect reads its settings when it is loaded, and what is imported above has loaded it.
        os.environ["PREFECT_API_URL"] = f"http://127.0.0.1:{free_port()}/api"
        os.environ["PREFECT_SERVER_ANALYTICS_ENABLED"] = "false"
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        os.execv(sys.executable, [sys.executable, "-m", "tests.flows.killing", *sys.argv[1:]])
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        begun = time.monotonic()
        found = campaign(given.kind, given.count, given.seed, folder)
        print(json.dumps({**found, "seconds": round(time.monotonic() - begun)}, indent=1))


if __name__ == "__main__":
    main()
