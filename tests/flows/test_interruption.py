"""Ctrl-C, SIGTERM and SIGKILL of the command, in processes of its own with a temporary server."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from extrags.store import Store
from flows.commands.export import INTERRUPTED as EXPORT_INTERRUPTED
from flows.interruption import INTERRUPTED, RESUMABLE
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.flows.killing import wait_for
from tests.flows.tiny import SEQUENCE, TINY, tiny_config

SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]
PATIENCE_S = 60.0
END_S = 5.0
"""How soon a command must have ended."""

SWALLOWS = """
import subprocess, sys, time
from flows.interruption import interruptible
with interruptible():
    subprocess.Popen([sys.executable, "-c", sys.argv[1]])
    while True:
        try:
            time.sleep(99)
        except KeyboardInterrupt:
            pass
"""

EXPORTS = """
import sys, time
from flows.commands import export, export_scene
from flows.interruption import interruptible
from extrags.output_files import whole_file

def export_slowly(given):
    with whole_file(given.output) as partial:
        partial.write_text("half")
        print("begun", flush=True)
        time.sleep(99)

export_scene.export_scene = export_slowly
from flows.cli import main
with interruptible():
    main(["export", "phantom/0", "-o", sys.argv[1]])
"""

SERVES = """
import signal, threading
from flows.interruption import interruptible, until_told_to_stop

class Told(threading.Event):
    def wait(self, timeout=None):
        print("up", flush=True)
        return super().wait(timeout)

with interruptible():
    before = signal.getsignal(signal.SIGINT)
    threading.Event = Told
    until_told_to_stop()
    assert signal.getsignal(signal.SIGINT) == before
    print("closed", flush=True)
"""

STAYS = """
import os, signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print(os.getpid(), flush=True)
time.sleep(99)
"""

ONLY_A_SERVER = """
import sys, time
from pathlib import Path
from flows.environment import prepare
prepare(Path(sys.argv[1]))
from flows.temporary_server import _started, temporary_server
with temporary_server():
    print(*[process.pid for process in _started.values()], flush=True)
    time.sleep(99)
"""


@contextmanager
def started(*arguments: str, output: Path, home: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A process in a group of its own, as a shell starts it, with nothing said about a server."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    if home is not None:
        environment["PREFECT_HOME"] = str(home)
    with (
        output.open("wb") as stream,
        subprocess.Popen(
            [sys.executable, *arguments],
            stdout=stream,
            stderr=stream,
            env=environment,
            start_new_session=True,
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def children(parent: int) -> list[int]:
    said = subprocess.run(["ps", "-o", "pid=", "--ppid", str(parent)], capture_output=True, text=True)
    return [int(word) for word in said.stdout.split()]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Prefect's home for all servers here, since making its database takes longer than all else."""
    return tmp_path_factory.mktemp("prefect")


@pytest.fixture
def begun(finished: tuple[str, SequenceOutcome], tmp_path: Path) -> Path:
    """A store of the finished run in which the coarse scene is missing."""
    store = tmp_path / "store"
    shutil.copytree(finished[0], store)
    Store(store).rm("coarse")
    return store


@pytest.mark.parametrize(
    ("send", "code"),
    [
        pytest.param(lambda process: os.killpg(process.pid, signal.SIGINT), 130, id="Ctrl-C"),
        pytest.param(
            lambda process: process.send_signal(signal.SIGTERM), 143, marks=pytest.mark.slow, id="SIGTERM"
        ),
    ],
)
def test_an_interrupted_run_says_so_ends_at_once_and_resumes(
    send: Callable[[subprocess.Popen[bytes]], None],
    code: int,
    begun: Path,
    finished: tuple[str, SequenceOutcome],
    home: Path,
    tmp_path: Path,
) -> None:
    output = tmp_path / "output"
    command = ["-m", "flows.cli", "run", SEQUENCE, "--profile", "quick", "--until", "coarse", *SETTINGS]
    with started(*command, "--store", str(begun), output=output, home=home) as process:
        wait_for(
            lambda: "coarse: starts" in output.read_text() or process.poll() is not None,
            "the stage to start",
            PATIENCE_S,
        )
        server = children(process.pid)
        assert server
        send(process)
        signalled = time.monotonic()
        assert process.wait(PATIENCE_S) == code
        assert time.monotonic() - signalled < END_S
        assert not any(is_running(child) for child in server)
    said = [line for line in output.read_text().splitlines() if not re.match(r"\d\d:\d\d:\d\d ", line)]
    assert said == [f"extrags: {RESUMABLE}"]
    assert "coarse: cached" not in output.read_text()
    assert not [manifest for manifest in Store(begun).ls() if manifest.stage == "coarse"]
    assert list((begun / "scratch").iterdir()) == []
    assert list((begun / "locks").iterdir()) == []

    resumed = run_sequence(SEQUENCE, tiny_config(), str(begun), DirectRunner(str(begun)), until="coarse")
    states = {row.stage: row.state for row in resumed.stages}
    assert (states["ingest"], states["coarse"]) == ("cached", "ran")
    assert resumed.digests["coarse"] == finished[1].digests["coarse"]


def test_a_command_without_stages_says_what_its_interruption_means(tmp_path: Path) -> None:
    output = tmp_path / "output"
    with started("-c", EXPORTS, str(tmp_path / "a.ply"), output=output) as process:
        wait_for(lambda: "begun" in output.read_text(), "the file to be begun", PATIENCE_S)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 143
    assert output.read_text() == f"begun\nextrags: {EXPORT_INTERRUPTED}\n"
    assert [file.name for file in tmp_path.iterdir()] == ["output"]


def test_a_main_thread_that_does_not_end_is_ended_with_its_children(tmp_path: Path) -> None:
    output = tmp_path / "output"
    with started("-c", SWALLOWS, STAYS, output=output) as process:
        wait_for(lambda: output.read_text().endswith("\n"), "a line", PATIENCE_S)
        child = int(output.read_text())
        process.send_signal(signal.SIGINT)
        signalled = time.monotonic()
        assert process.wait(PATIENCE_S) == 130
        assert time.monotonic() - signalled < END_S
        assert not is_running(child)
    assert output.read_text() == f"{child}\nextrags: {INTERRUPTED}\n"


def test_the_server_of_a_killed_command_ends(home: Path, tmp_path: Path) -> None:
    output = tmp_path / "output"
    with started("-c", ONLY_A_SERVER, str(tmp_path), output=output, home=home) as process:
        wait_for(lambda: output.read_text().endswith("\n"), "a line", PATIENCE_S)
        server = int(output.read_text())
        assert os.getsid(server) == server
        process.kill()
        process.wait()
        wait_for(lambda: not is_running(server), "the server to end", END_S)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_serves_ends_well_when_it_is_told_to(number: signal.Signals) -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", SERVES], **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, "closed\n", "")
