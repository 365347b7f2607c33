"""A server that is away for a moment costs one sequence, and one that is gone ends the run in a sentence."""

from __future__ import annotations

import base64
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import pytest
from prefect.client.schemas.objects import State
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
from prefect.states import Completed

import flows.dataset
import flows.server_contact
from extrags.store import Store
from flows.cli import main
from flows.dataset import reconstruct_dataset
from flows.outcome import DatasetOutcome, SequenceOutcome
from flows.outcome_records import outcome_records
from flows.server_contact import ServerLostError, check_server

SEQUENCES = [f"phantom/{number}@sparse" for number in range(3)]
REFUSED = httpx.ConnectError("All connection attempts failed")


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which sequences are begun; the submission of the second one does not reach the server."""
    found: list[str] = []

    def one(*, sequence: str, **_: object) -> State[Any]:
        found.append(sequence)
        if sequence == SEQUENCES[1]:
            raise REFUSED
        return Completed(data=SequenceOutcome(sequence))

    class Started:
        def with_options(self, **_: object) -> Callable[..., State[Any]]:
            return one

    monkeypatch.setattr(flows.dataset, "reconstruct_sequence", Started())
    # It would start a server.
    monkeypatch.setattr(flows.dataset, "create_markdown_artifact", lambda *_, **__: None)
    return found


def run(store: Path, at_once: int = 1) -> DatasetOutcome:
    return reconstruct_dataset.fn(SEQUENCES, store=str(store), until="ingest", at_once=at_once)


@pytest.mark.parametrize("at_once", [1, 2])
def test_a_lost_submission_does_not_stop_the_others(
    at_once: int, begun: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = [REFUSED, None]
    monkeypatch.setattr(flows.server_contact, "_problem", lambda: answers.pop(0))
    monkeypatch.setattr(flows.server_contact, "POLL_SECONDS", 0.0)
    found = run(tmp_path, at_once)
    assert sorted(begun) == SEQUENCES
    assert [outcome.status for outcome in found.sequences] == ["ok", "failed", "ok"]
    assert found.sequences[1].error is REFUSED
    (record,) = outcome_records(Store(tmp_path)).values()
    assert (record["sequence"], record["status"]) == (SEQUENCES[1], "failed")
    assert "All connection attempts failed" in record["reason"]


def test_a_server_that_is_gone_ends_the_run_with_one_error(
    begun: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flows.server_contact, "_problem", lambda: REFUSED)
    monkeypatch.setattr(flows.server_contact, "PATIENCE_SECONDS", 0.0)
    with pytest.raises(ServerLostError, match=r"does not answer any more .*no other sequence can begin"):
        run(tmp_path)
    assert begun == SEQUENCES[:2]
    assert len(outcome_records(Store(tmp_path))) == 1


def test_other_errors_say_nothing_of_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flows.server_contact, "_problem", lambda: pytest.fail("asked"))
    check_server(RuntimeError("its task runner did not start"))


@pytest.mark.usefixtures("untouched_environment")
@pytest.mark.parametrize("verb", ["serve", "reconcile"])
@pytest.mark.parametrize("password", [None, "operator:not-this-one"])
def test_a_server_that_refuses_says_what_is_to_be_set(
    verb: str, password: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was an error of the client, with a link to what 401 means and a hint to the traceback."""
    given: list[str | None] = []

    class Refusing(BaseHTTPRequestHandler):
        def answer(self) -> None:
            given.append(self.headers.get("Authorization"))
            self.send_response(401)
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_GET = do_POST = answer

        def log_message(self, *_: object) -> None:
            """Says nothing."""

    with HTTPServer(("127.0.0.1", 0), Refusing) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        where = f"127.0.0.1:{server.server_port}"
        settings = {PREFECT_API_URL: f"http://{where}/api", PREFECT_API_AUTH_STRING: password}
        with temporary_settings(settings):
            assert main([verb, "--store", str(tmp_path)]) == 1
        server.shutdown()
    (said,) = capsys.readouterr().err.splitlines()
    assert f"the Prefect server at {where} refuses this command: 401" in said
    assert "set PREFECT_API_AUTH_STRING" in said
    assert "not-this-one" not in said
    sent = None if password is None else f"Basic {base64.b64encode(password.encode()).decode()}"
    assert set(given) == {sent}
