"""The temporary server: its database, which is copied from a template, and what it says when it fails."""

from __future__ import annotations

import resource
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing
from importlib import metadata
from pathlib import Path

import httpx
import pytest
from prefect.exceptions import PrefectHTTPStatusError
from prefect.settings import (
    PREFECT_API_DATABASE_CONNECTION_URL,
    PREFECT_API_URL,
    PREFECT_HOME,
    PREFECT_SERVER_EPHEMERAL_ENABLED,
    temporary_settings,
)

from flows import temporary_server as server_module
from flows.temporary_server import DATABASE, ServerError, copy_database, database_address, temporary_server


@pytest.fixture(autouse=True)
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server starts early as it does for users, and not in other tests of flows."""
    monkeypatch.setattr(server_module, "start_early", server_module.start_early.__wrapped__)


def made(path: Path, word: str = "whole") -> Path:
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("CREATE TABLE words (word TEXT)")
        database.execute("INSERT INTO words VALUES (?)", (word,))
    return path


def words(path: Path) -> list[tuple[str]]:
    with closing(sqlite3.connect(path)) as database:
        return database.execute("SELECT word FROM words").fetchall()


def test_a_copy_is_whole_and_nothing_lies_beside_it(tmp_path: Path) -> None:
    target = tmp_path / "home" / "prefect.db"
    assert copy_database(made(tmp_path / "template.db"), target)
    assert [path.name for path in target.parent.iterdir()] == ["prefect.db"]
    assert words(target) == [("whole",)]


def test_a_database_that_is_there_stays(tmp_path: Path) -> None:
    target = made(tmp_path / "prefect.db", "mine")
    assert not copy_database(made(tmp_path / "template.db"), target)
    assert words(target) == [("mine",)]


def test_without_a_sound_template_there_is_no_copy(tmp_path: Path) -> None:
    target = tmp_path / "prefect.db"
    assert not copy_database(tmp_path / "absent.db", target)
    broken = tmp_path / "broken.db"
    broken.write_bytes(b"no database" * 1000)
    assert not copy_database(broken, target)
    assert list(tmp_path.iterdir()) == [broken]


@pytest.mark.parametrize("folder", ["a%20b", "100%", "why?", "%3F", "plain", "two words", "[é]#1"])
def test_the_server_opens_the_database_in_its_home_whatever_that_is_called(
    folder: str, tmp_path: Path
) -> None:
    from sqlalchemy import make_url

    home = tmp_path / folder / "prefect"
    home.mkdir(parents=True)
    given = database_address({"PREFECT_HOME": str(home)})
    # Without a variable, Prefect puts the path into the address as it is.
    (address,) = given.values() or (f"sqlite+aiosqlite:///{home / DATABASE}",)
    url = make_url(address)
    (opened,), options = url.get_dialect()().create_connect_args(url)
    with closing(sqlite3.connect(opened, uri=options.get("uri", False))) as database:
        database.execute("CREATE TABLE words (word TEXT)")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [DATABASE]
    assert (home / DATABASE).is_file()
    assert set(given) <= {"PREFECT_SERVER_DATABASE_CONNECTION_URL"}


def test_a_database_that_somebody_chose_stays() -> None:
    chosen = {"PREFECT_HOME": "/a%20b", "PREFECT_API_DATABASE_CONNECTION_URL": "postgresql://host/runs"}
    assert database_address(chosen) == {}
    assert database_address({}) == {}


@pytest.mark.parametrize(("status", "told"), [(500, ServerError), (404, PrefectHTTPStatusError)])
def test_a_server_that_fails_because_it_cannot_write_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int, told: type[Exception]
) -> None:
    server = subprocess.Popen(["sleep", "60"])
    monkeypatch.setattr("flows.temporary_server._started", {"http://127.0.0.1:9/api": server})
    request = httpx.Request("POST", "http://127.0.0.1:9/api/flow_runs")
    error = PrefectHTTPStatusError("", request=request, response=httpx.Response(status, request=request))
    # A home that is not there cannot be written, whoever asks.
    settings = {
        PREFECT_API_URL: None,
        PREFECT_SERVER_EPHEMERAL_ENABLED: True,
        PREFECT_HOME: tmp_path / "gone",
    }
    try:
        with temporary_settings(settings), pytest.raises(told) as raised, temporary_server():
            raise error
    finally:
        server.kill()
        server.wait()
    if told is ServerError:
        assert "cannot be written (No such file or directory)" in str(raised.value)


def test_a_database_as_large_as_a_file_may_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others can still be written beside it: the limit alone tells why the server fails."""
    (tmp_path / DATABASE).write_bytes(bytes(1000))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (server_module.ROOM_BYTES + 1000, 1 << 30))
    server_module._check_room(tmp_path)
    (tmp_path / f"{DATABASE}-wal").write_bytes(bytes(2000))
    with pytest.raises(ServerError, match=r"\(File too large: no more than 1049576 bytes .* ulimit -f\)"):
        server_module._check_room(tmp_path)


def test_a_server_that_has_no_room_from_the_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would end with a traceback, and its code says nothing."""
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    monkeypatch.setattr(server_module, "_started", {})
    monkeypatch.setattr(server_module, "_launch", lambda settings: pytest.fail("it was started"))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1000, 1000))
    server_module.start_early()
    settings = {
        PREFECT_API_URL: None,
        PREFECT_SERVER_EPHEMERAL_ENABLED: True,
        PREFECT_HOME: tmp_path,
        PREFECT_API_DATABASE_CONNECTION_URL: f"sqlite+aiosqlite:///{tmp_path / DATABASE}",
    }
    with (
        temporary_settings(settings),
        pytest.raises(ServerError, match="cannot be written"),
        temporary_server(),
    ):
        pytest.fail("there is no server")


def test_a_server_that_ends_at_once_for_want_of_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = subprocess.Popen(["false"])
    server.wait()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1000, 1000))
    settings = {
        PREFECT_HOME: tmp_path,
        PREFECT_API_DATABASE_CONNECTION_URL: f"sqlite+aiosqlite:///{tmp_path / DATABASE}",
    }
    with temporary_settings(settings), pytest.raises(ServerError, match="cannot be written"):
        server_module._wait(server, "http://127.0.0.1:9/api", 5)
    with (
        temporary_settings({**settings, PREFECT_HOME: tmp_path / "another"}),
        pytest.raises(ServerError, match=r"ended at once with code 1$"),
    ):
        server_module._wait(server, "http://127.0.0.1:9/api", 5)


def test_a_server_that_ends_at_once_names_its_database(tmp_path: Path) -> None:
    server = subprocess.Popen(["false"])
    server.wait()
    database = tmp_path / DATABASE
    settings = {
        PREFECT_HOME: tmp_path,
        PREFECT_API_DATABASE_CONNECTION_URL: f"sqlite+aiosqlite:///{database}",
    }
    with (
        temporary_settings(settings),
        pytest.raises(ServerError, match=rf"code 1; it keeps runs, and no results, in {database}$"),
    ):
        server_module._wait(server, "http://127.0.0.1:9/api", 5)


class TestDamaged:
    """Databases of which a part has been overwritten, in a home of this project."""

    @pytest.fixture
    def home(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
        cache = tmp_path / "cache"
        cache.mkdir()
        monkeypatch.setattr(server_module, "cache_directory", lambda: cache)
        made(cache / f"prefect-{metadata.version('prefect')}.db", "new")
        home = tmp_path / "home"
        home.mkdir()
        database = home / DATABASE
        settings = {
            PREFECT_HOME: home,
            PREFECT_API_DATABASE_CONNECTION_URL: f"sqlite+aiosqlite:///{database}",
        }
        with temporary_settings(settings):
            yield home

    @pytest.mark.parametrize("begin", [0, 4096])
    def test_a_new_one_takes_its_place(
        self, home: Path, begin: int, capsys: pytest.CaptureFixture[str]
    ) -> None:
        database = made(home / DATABASE, "old")
        with database.open("r+b") as file:
            file.seek(begin)
            file.write(b"x" * 4096)
        damaged = database.read_bytes()
        (home / f"{DATABASE}-wal").write_bytes(b"its log")
        server_module._provide_database(own=True)
        assert words(database) == [("new",)]
        assert (home / "prefect.db.damaged").read_bytes() == damaged
        assert (home / "prefect.db.damaged-wal").exists() or begin
        assert f"{database} was damaged, and is now prefect.db.damaged" in capsys.readouterr().err
        server_module._provide_database(own=True)
        assert capsys.readouterr().err == ""

    def test_that_of_somebody_elses_home_stays(self, home: Path) -> None:
        (home / DATABASE).write_bytes(b"no database" * 1000)
        server_module._provide_database(own=False)
        assert [file.name for file in home.iterdir()] == [DATABASE]

    def test_one_that_is_in_use_stays(self, home: Path) -> None:
        with closing(sqlite3.connect(made(home / DATABASE, "old"))) as other:
            other.execute("PRAGMA locking_mode=EXCLUSIVE")
            other.execute("INSERT INTO words VALUES ('more')")
            server_module._provide_database(own=True)
            other.commit()
        assert words(home / DATABASE) == [("old",), ("more",)]


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The environment of a server that is launched, but not started."""
    found: dict[str, str] = {}

    class Process:
        def __init__(self, command: list[str], *, env: dict[str, str], **_: object) -> None:
            found.update(env, command=" ".join(command))

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(server_module.atexit, "register", lambda *_: None)
    return found


def test_pages_of_other_sites_are_told_nothing(
    given: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect.settings import get_current_settings

    # As somebody's own server is told to.
    address, _ = server_module._launch({"PREFECT_SERVER_CORS_ALLOWED_ORIGINS": "*"})
    for name in server_module.CORS_VARIABLES:
        monkeypatch.setenv(name, given[name])
    allowed = type(get_current_settings())().server.api.cors_allowed_origins
    assert allowed == address.removesuffix("/api")


def test_a_home_of_this_project_is_known_to_its_server(
    given: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(server_module, "_started", {})
    monkeypatch.setattr(server_module, "_starting", {})
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    server_module.start_early()
    assert given["command"].endswith(f" {server_module.OWN}")
    server_module._launch({})
    assert not given["command"].endswith(server_module.OWN)


@pytest.mark.parametrize("support", ["true", "false"])
def test_pages_of_other_sites_change_nothing(
    given: dict[str, str], monkeypatch: pytest.MonkeyPatch, support: str
) -> None:
    """Where clients ask for no token, the server cannot ask for one."""
    from prefect.settings import get_current_settings

    for name in (server_module.TOKEN_VARIABLE, server_module.TOKEN_OF_CLIENTS):
        monkeypatch.delenv(name, raising=False)
    assert get_current_settings().client.csrf_support_enabled
    server_module._launch({} if support == "true" else {server_module.TOKEN_OF_CLIENTS: support})
    for name in {server_module.TOKEN_VARIABLE, server_module.TOKEN_OF_CLIENTS} & given.keys():
        monkeypatch.setenv(name, given[name])
    found = type(get_current_settings())()
    assert (
        found.server.api.csrf_protection_enabled == found.client.csrf_support_enabled == (support == "true")
    )
