"""A Prefect server that lives as long as the command which needs it, and no longer.

Prefect's own temporary server belongs to the process group of its command, so that Ctrl-C ends it before the
command has told it how the runs ended, and it outlives a command that is killed. This one has a session of
its own, and its standard input is a pipe whose other end only the command holds. The kernel closes that end
however the command ends, SIGKILL included; the server reads the end of file and goes.

It starts while its command still imports and looks (`start_early`), and does not make its database anew for
every store: the first one on a machine is kept as a template, since Prefect's migrations take longer than all
else.

`python -m flows.temporary_server DESCRIPTOR` is the server; `temporary_server` starts it. With `own` as a
second argument Prefect's home is one of this project, where a damaged database gives way to a new one.
"""

from __future__ import annotations

import asyncio
import atexit
import errno
import logging
import os
import resource
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from importlib import metadata
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory
from typing import TYPE_CHECKING
from unittest.mock import patch
from urllib.parse import quote

from extrags.data_directories import cache_directory
from extrags.errors import ExtragsError
from extrags.user_paths import expanded

if TYPE_CHECKING:
    import uvicorn

__all__ = ["ServerError", "start_early", "stop_early", "temporary_server"]

POLL_SECONDS = 0.1
ROOM_BYTES = 1 << 20
"""Where so much cannot be written, a database cannot either."""
END_SECONDS = 2.0
"""How long the server may take to end by itself."""

DATABASE = "prefect.db"
"""In Prefect's home."""
SQLITE = "sqlite+aiosqlite:///"
"""Begin of the addresses of such databases."""
DAMAGED = f"{DATABASE}.damaged"
"""What a damaged one is called from then on; a former one of this name goes."""
BESIDE = ("-wal", "-shm", "")
"""What SQLite keeps beside a database, and last the database itself."""
OWN = "own"

_starting: dict[str, subprocess.Popen[bytes]] = {}
"""The server that was started early, by its address; at most one."""
_started: dict[str, subprocess.Popen[bytes]] = {}
"""The server of this process by its address; at most one."""


CORS_VARIABLES = ("PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS", "PREFECT_SERVER_CORS_ALLOWED_ORIGINS")
"""Both names of the setting that lets pages of other sites read what the server answers. By default, those of
all sites may: what any of them, open in a browser meanwhile, asked for the runs of this machine was told."""
TOKEN_VARIABLE = "PREFECT_SERVER_CSRF_PROTECTION_ENABLED"
"""The setting by which the server takes changes only from who has asked it for a token and read the answer.
Pages of other sites cannot read it, but send anything they may, and plain text is taken for JSON."""
TOKEN_OF_CLIENTS = "PREFECT_CLIENT_CSRF_SUPPORT_ENABLED"
"""Whether Prefect's clients ask for the token; by default they do."""


class ServerError(ExtragsError, RuntimeError):
    """The temporary server did not start, or cannot go on."""


def start_early() -> None:
    """Start the server and do not wait for it: before Prefect is imported, which takes as long.

    For who knows that it will be needed, and that Prefect's home is one of this project
    (`flows.environment.prepare`); where Prefect then knows another server, this one ends.
    """
    if not _starting and not _started and not os.environ.get("PREFECT_API_URL"):
        # Without room for its database it would end with a traceback; whoever comes to need it is told why.
        try:
            _check_room(Path(os.environ["PREFECT_HOME"]))
        except ServerError:
            return
        address, process = _launch({}, own=True)
        _starting[address] = process


def stop_early() -> None:
    """End the server that was started early, where nobody has come to need it."""
    while _starting:
        _stop(_starting.popitem()[1])


@contextmanager
def temporary_server() -> Iterator[None]:
    """Flow runs inside the block go to a server of this process; to the user's, where Prefect knows one.

    The server itself stays until the process ends, because Prefect sends its last events then.

    Raises:
        ServerError: when the server ends, or does not answer, before the time that Prefect's settings allow;
            and when it cannot write its database any more.
    """
    import httpx
    from prefect.exceptions import PrefectHTTPStatusError
    from prefect.settings import (
        PREFECT_API_URL,
        PREFECT_HOME,
        PREFECT_SERVER_EPHEMERAL_ENABLED,
        temporary_settings,
    )

    if PREFECT_API_URL.value() or not PREFECT_SERVER_EPHEMERAL_ENABLED.value():
        stop_early()
        yield
        return
    address = next((address for address, server in _started.items() if server.poll() is None), None)
    if address is None:
        address = _start()
    # The environment is for workers in other processes: each would start a server of its own.
    with temporary_settings({PREFECT_API_URL: address}), patch.dict(os.environ, PREFECT_API_URL=address):
        try:
            yield
        except PrefectHTTPStatusError as error:
            # All that it answers to a full disk.
            if error.response.status_code >= httpx.codes.INTERNAL_SERVER_ERROR:
                _check_room(PREFECT_HOME.value())
            raise


def _check_room(home: Path) -> None:
    """Write into the folder of the database as much as would be missed.

    Raises:
        ServerError: when that cannot be written, or the database has grown to what a file may hold, with the
            reason.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    largest = 0
    with suppress(OSError):
        largest = max((file.stat().st_size for file in home.glob(f"{DATABASE}*")), default=0)
    try:
        if limit != resource.RLIM_INFINITY and largest + ROOM_BYTES > limit:
            said = f"{os.strerror(errno.EFBIG)}: no more than {limit} bytes are allowed, see ulimit -f"
            raise OSError(errno.EFBIG, said)
        with NamedTemporaryFile(dir=home) as probe:
            probe.write(bytes(ROOM_BYTES))
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        reason = error.strerror or error
        raise ServerError(
            f"the run cannot go on: Prefect's database in {home} cannot be written ({reason}); "
            "what is finished stays in the store, and the same command goes on from there once there is room"
        ) from error


def _database() -> Path | None:
    """The database in Prefect's home; None where Prefect is to use another one, such as Postgres."""
    from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL, PREFECT_HOME

    database = PREFECT_HOME.value() / DATABASE
    address = str(PREFECT_API_DATABASE_CONNECTION_URL.value())
    return database if address in (f"{SQLITE}{database}", _address(database)) else None


def _check_home() -> None:
    """As `_check_room`, where Prefect's home holds the database, and is there.

    Raises:
        ServerError: when it cannot be written.
    """
    database = _database()
    if database is not None and database.parent.is_dir():
        _check_room(database.parent)


def _start() -> str:
    from prefect.settings import PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS, get_current_settings

    limit_s = PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS.value()
    if _starting:
        address, process = _starting.popitem()
    else:
        _check_home()
        address, process = _launch(get_current_settings().to_environment_variables(exclude_unset=True))
    _wait(process, address, limit_s)
    _started.clear()
    _started[address] = process
    return address


def _launch(settings: dict[str, str], *, own: bool = False) -> tuple[str, subprocess.Popen[bytes]]:
    """Start the server: its address, at which nobody answers yet, and its process.

    Args:
        settings: of Prefect, beside those of the environment.
        own: whether Prefect's home is one of this project.
    """
    root = str(Path(__file__).resolve().parents[1])
    environment = {
        **os.environ,
        **settings,
        # As Prefect starts its own temporary server.
        "PREFECT_UI_ENABLED": "0",
        "PREFECT__SERVER_EPHEMERAL": "1",
        "PREFECT__SERVER_FINAL": "1",
        # Nobody asks this server for events, automations or blocks.
        "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
        "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
        "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
        # It would be noted as done for the servers to come.
        "PREFECT_SERVER_MEMOIZE_BLOCK_AUTO_REGISTRATION": "false",
        "PYTHONPATH": os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    if environment.get(TOKEN_OF_CLIENTS, "true").lower() in ("1", "true", "yes", "on", "t", "y"):
        environment[TOKEN_VARIABLE] = "true"
    environment |= database_address(environment)
    # The port is taken here and handed over, so that nobody else can take it meanwhile.
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        origin = f"http://127.0.0.1:{listener.getsockname()[1]}"
        address = f"{origin}/api"
        environment |= dict.fromkeys(CORS_VARIABLES, origin)
        process = subprocess.Popen(
            [
                *(sys.executable, "-P", "-m", "flows.temporary_server", str(listener.fileno())),
                *([OWN] if own else []),
            ],
            stdin=subprocess.PIPE,
            env=environment,
            pass_fds=[listener.fileno()],
            start_new_session=True,
        )
    # Registered before Prefect's own, hence run after them: they send the last events.
    atexit.register(_stop, process)
    return address, process


def _wait(process: subprocess.Popen[bytes], address: str, limit_s: float) -> None:
    import httpx

    end = time.monotonic() + limit_s
    with httpx.Client() as client:
        while time.monotonic() < end:
            if process.poll() is not None:
                _check_home()
                database = _database()
                hint = f"; it keeps runs, and no results, in {database}" if database is not None else ""
                raise ServerError(
                    f"Prefect's temporary server ended at once with code {process.returncode}{hint}"
                )
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


def copy_database(source: Path, target: Path) -> bool:
    """Copy an SQLite database that others may be using; whether `target` is now a sound copy.

    A target that is there stays as it is, and so does everything when something fails: then there is merely
    nothing to be copied the next time.
    """
    if not source.is_file():
        return False
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        address = f"file:{quote(str(source))}?mode=ro"
        with (
            closing(sqlite3.connect(address, uri=True)) as one,
            closing(sqlite3.connect(part)) as other,
        ):
            one.backup(other)
            # No files of a log beside it.
            other.execute("PRAGMA journal_mode=DELETE")
            sound = bool(other.execute("PRAGMA quick_check").fetchall() == [("ok",)])
        if sound:
            os.link(part, target)
        return sound
    except (OSError, sqlite3.Error):
        return False
    finally:
        part.unlink(missing_ok=True)


def _set_aside_if_damaged(database: Path) -> None:
    """Rename a database that SQLite finds damaged, which no server could use, and say so."""
    try:
        with closing(sqlite3.connect(f"file:{quote(str(database))}?mode=ro", uri=True)) as opened:
            if opened.execute("PRAGMA quick_check").fetchall() == [("ok",)]:
                return
    except sqlite3.OperationalError:
        return  # It is locked, or not for this user to read: nothing is known of it.
    except sqlite3.DatabaseError:
        pass
    # What is beside it first: left to a new database, its log would be taken for the log of that one.
    for suffix in BESIDE:
        with suppress(FileNotFoundError):
            os.replace(f"{database}{suffix}", f"{database.with_name(DAMAGED)}{suffix}")
    print(
        f"extrags: Prefect's database {database} was damaged, and is now {DAMAGED} beside a new one; it held "
        "runs, and no results",
        file=sys.stderr,
        flush=True,
    )


def _address(path: Path) -> str:
    """The address of a database: SQLAlchemy takes a path as it is, but ends it at `?`, unlike a URI's."""
    return f"{SQLITE}file:{quote(str(path))}?uri=true" if "?" in str(path) else f"{SQLITE}{path}"


def database_address(environment: Mapping[str, str]) -> dict[str, str]:
    """The variable that names the database in Prefect's home where Prefect itself would name another place.

    Prefect puts the path of its home into the address as it is. Nothing is said where that is right, or
    where somebody has chosen a database.
    """
    home = environment.get("PREFECT_HOME")
    chosen = ("PREFECT_SERVER_DATABASE_", "PREFECT_API_DATABASE_")
    if home is None or any(name.startswith(chosen) for name in environment):
        return {}
    database = expanded(home) / DATABASE
    address = _address(database)
    if address == f"{SQLITE}{database}":
        return {}
    return {"PREFECT_SERVER_DATABASE_CONNECTION_URL": address}


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(timeout=2 * END_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _serve(descriptor: int, *, own: bool) -> None:
    """Serve on a bound socket until standard input ends.

    Args:
        descriptor: of the socket.
        own: whether Prefect's home is one of this project.
    """
    serving: list[uvicorn.Server] = []

    def watch() -> None:
        while os.read(0, 1):
            pass
        # Connections that are cancelled on the way down are nobody's error, and the command has had its say.
        logging.disable(logging.CRITICAL)
        # Nobody is left to talk to: whatever still hinders the server is not waited for, and one that has
        # not started has nothing to end.
        for server in serving:
            server.should_exit = True
            time.sleep(END_SECONDS if server.started else 0)
        os._exit(0)

    threading.Thread(target=watch, daemon=True, name="end-with-the-command").start()
    # After the thread has started: this takes seconds.
    import uvicorn

    _provide_database(own=own)
    config = uvicorn.Config(
        "prefect.server.api.server:create_app", factory=True, log_level="error", lifespan="on"
    )
    serving.append(uvicorn.Server(config))
    serving[0].run(sockets=[socket.socket(fileno=descriptor)])
    # All is written. What Python would clear up takes seconds, for which the command would wait.
    os._exit(0)


def _provide_database(*, own: bool) -> None:
    """See to it that Prefect's home has a database: a copy of the template, which is made if need be.

    Args:
        own: whether the home is one of this project, where a damaged database gives way to a new one.
    """
    from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL, PREFECT_HOME, temporary_settings

    database = PREFECT_HOME.value() / DATABASE
    address = str(PREFECT_API_DATABASE_CONNECTION_URL.value())
    # Another database, such as Postgres, is whose it is.
    if address != _address(database):
        return
    if own and database.exists():
        _set_aside_if_damaged(database)
    if database.exists():
        return
    template = cache_directory() / f"prefect-{metadata.version('prefect')}.db"
    if copy_database(template, database):
        return
    from prefect.server.database.alembic_commands import alembic_upgrade
    from prefect.server.database.dependencies import temporary_database_config
    from prefect.utilities.asyncutils import run_sync_in_worker_thread

    # Elsewhere first: a command that is killed meanwhile leaves no half of a database.
    database.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=database.parent) as folder:
        made = Path(folder) / DATABASE
        with (
            temporary_settings({PREFECT_API_DATABASE_CONNECTION_URL: _address(made)}),
            # Else the server would go on with this one.
            temporary_database_config(None),
        ):
            asyncio.run(run_sync_in_worker_thread(alembic_upgrade))
        copy_database(made, template)
        copy_database(made, database)


if __name__ == "__main__":
    _serve(int(sys.argv[1]), own=OWN in sys.argv[2:])
