"""A Prefect server that lives as long as the command which needs it, and no longer.

Prefect's own temporary server belongs to the process group of its command, so that Ctrl-C ends it before the
command has told it how the runs ended, and it outlives a command that is killed. This one has a session of
its own, and its standard input is a pipe whose other end only the command holds. The kernel closes that end
however the command ends, SIGKILL included; the server reads the end of file and goes.

`python -m flows.temporary_server DESCRIPTOR` is the server; `temporary_server` starts it.
"""

from __future__ import annotations

import atexit
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from extrags.errors import ExtragsError

__all__ = ["ServerError", "temporary_server"]

POLL_SECONDS = 0.1
END_SECONDS = 2.0
"""How long the server may take to end by itself."""

_started: dict[str, subprocess.Popen[bytes]] = {}
"""The server of this process by its address; at most one."""


class ServerError(ExtragsError, RuntimeError):
    """The temporary server did not start."""


@contextmanager
def temporary_server() -> Iterator[None]:
    """Flow runs inside the block go to a server of this process; to the user's, where Prefect knows one.

    The server itself stays until the process ends, because Prefect sends its last events then.

    Raises:
        ServerError: when the server ends, or does not answer, before the time that Prefect's settings allow.
    """
    from prefect.settings import PREFECT_API_URL, PREFECT_SERVER_EPHEMERAL_ENABLED, temporary_settings

    if PREFECT_API_URL.value() or not PREFECT_SERVER_EPHEMERAL_ENABLED.value():
        yield
        return
    address = next((address for address, server in _started.items() if server.poll() is None), None)
    if address is None:
        address = _start()
    # The environment is for workers in other processes: each would start a server of its own.
    with temporary_settings({PREFECT_API_URL: address}), patch.dict(os.environ, PREFECT_API_URL=address):
        yield


def _start() -> str:
    from prefect.settings import PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS, get_current_settings

    root = str(Path(__file__).resolve().parents[1])
    environment = {
        **os.environ,
        **get_current_settings().to_environment_variables(exclude_unset=True),
        # As Prefect starts its own temporary server.
        "PREFECT_UI_ENABLED": "0",
        "PREFECT__SERVER_EPHEMERAL": "1",
        "PREFECT__SERVER_FINAL": "1",
        "PYTHONPATH": os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    # The port is taken here and handed over, so that nobody else can take it meanwhile.
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{listener.getsockname()[1]}/api"
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "flows.temporary_server", str(listener.fileno())],
            stdin=subprocess.PIPE,
            env=environment,
            pass_fds=[listener.fileno()],
            start_new_session=True,
        )
    # Registered before Prefect's own, hence run after them: they send the last events.
    atexit.register(_stop, process)
    _wait(process, address, PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS.value())
    _started.clear()
    _started[address] = process
    return address


def _wait(process: subprocess.Popen[bytes], address: str, limit_s: float) -> None:
    import httpx

    end = time.monotonic() + limit_s
    with httpx.Client() as client:
        while time.monotonic() < end:
            if process.poll() is not None:
                raise ServerError(f"Prefect's temporary server ended at once with code {process.returncode}")
            try:
                if client.get(f"{address}/health").status_code == httpx.codes.OK:
                    return
            except httpx.TransportError:
                # Nobody listens yet.
                pass
            time.sleep(POLL_SECONDS)
    _stop(process)
    raise ServerError(
        f"Prefect's temporary server did not answer within {limit_s:g} s; "
        "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS is how long it may take"
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(timeout=2 * END_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _serve(descriptor: int) -> None:
    """Serve on a bound socket until standard input ends."""
    ended = threading.Event()

    def watch() -> None:
        while os.read(0, 1):
            pass
        ended.set()
        # Nobody is left to talk to: whatever still hinders the server is not waited for.
        time.sleep(END_SECONDS)
        os._exit(0)

    threading.Thread(target=watch, daemon=True, name="end-with-the-command").start()
    # After the thread has started: this takes seconds.
    import uvicorn

    server = uvicorn.Server(
        uvicorn.Config("prefect.server.api.server:create_app", factory=True, log_level="error", lifespan="on")
    )

    def leave() -> None:
        ended.wait()
        server.should_exit = True

    threading.Thread(target=leave, daemon=True, name="leave").start()
    server.run(sockets=[socket.socket(fileno=descriptor)])


if __name__ == "__main__":
    _serve(int(sys.argv[1]))
