"""A server that is away for a moment costs one sequence, and one that is gone ends the run in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from prefect.client.schemas.objects import State
from prefect.states import Completed

import flows.dataset
import flows.server_contact
from extrags.store import Store
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
