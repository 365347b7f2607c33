"""What the page and the log of a run through a lasting server hold."""

from __future__ import annotations

import asyncio
import base64
import io
import logging
import re
import threading
import time
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from prefect import flow, get_client
from prefect.client.schemas.filters import (
    ArtifactFilter,
    ArtifactFilterFlowRunId,
    LogFilter,
    LogFilterFlowRunId,
)
from prefect.logging.handlers import APILogHandler
from prefect.runtime import flow_run
from prefect.settings import PREFECT_API_URL, PREFECT_LOGGING_TO_API_ENABLED, temporary_settings

from extrags.events import Progress, emit
from extrags.store import Ref, Slot
from flows.outcome import SequenceOutcome
from flows.run_page import run_page
from flows.sequence import reconstruct_sequence
from tasks import run_page as senders
from tasks.page_choice import PAGE_VARIABLE
from tasks.run_log import RunLogHandler, run_log
from tasks.run_page import artifact_key, plain_letters
from tasks.stage import at, stage
from tests.flows.tiny import SEQUENCE, TINY, tiny_config


@stage("toy-long", version=1)
def long(slot: Slot, steps: int = 4, seed: int = 0) -> None:
    """A loop that is long enough for a bar, and says something."""
    logging.getLogger("extrags.toy").info("the library speaks, seed %d", seed)
    said = threading.Thread(
        target=logging.getLogger("data_catalog.toy").info, args=("from a thread without a run",)
    )
    said.start()
    said.join()
    for step in range(steps):
        emit(Progress("toy-long", step + 1, 2 * steps, {"loss": 0.5}))
        time.sleep(0.15)
    (slot.path / "number").write_text("1")


@flow(name="toy-page")
def toy_page(store: str, seed: int = 0) -> tuple[str, Ref]:
    """One long stage with a page."""
    run_id = str(flow_run.id)
    with run_page("toy run", tiny_config(), "report"):
        ref = at(long, store).submit(store=store, label="some/scene", seed=seed).result()
    return run_id, ref


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every stage is long, and the server hears of it at once."""
    monkeypatch.setattr(senders, "UPDATE_SECONDS", 0.1)
    monkeypatch.setattr(senders, "LONG_SECONDS", 0.0)


def artifacts_of(run_id: str) -> dict[str, Any]:
    with get_client(sync_client=True) as client:
        found = client.read_artifacts(
            artifact_filter=ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=[run_id]))  # type: ignore[list-item]
        )
    return {str(item.key): item for item in found}


def log_lines_of(run_id: str) -> list[tuple[int, str]]:
    asyncio.run(APILogHandler.aflush())

    async def read() -> list[tuple[int, str]]:
        async with get_client() as client:
            logs = await client.read_logs(
                LogFilter(flow_run_id=LogFilterFlowRunId(any_=[run_id]))  # type: ignore[list-item]
            )
            return [(line.level, line.message) for line in logs]

    return asyncio.run(read())


@pytest.mark.usefixtures("prefect_server", "often")
class TestProgress:
    def test_a_long_stage_has_a_bar_with_its_share(self, tmp_path: Path) -> None:
        run_id, _ = toy_page(str(tmp_path / "store"))
        bar = artifacts_of(run_id)["progress-some-scene-toy-long"]
        assert bar.type == "progress"
        assert bar.data == 50.0
        assert "4 of 8" in bar.description
        assert "loss 0.5" in bar.description
        assert "left" in bar.description

    def test_the_run_has_one_too(self, tmp_path: Path) -> None:
        run_id, _ = toy_page(str(tmp_path / "store"))
        assert artifacts_of(run_id)["progress-toy-run"].type == "progress"

    def test_nothing_where_it_is_switched_off(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv(PAGE_VARIABLE, "0")
        run_id, _ = toy_page(str(tmp_path / "store"))
        assert artifacts_of(run_id) == {}

    @pytest.mark.filterwarnings("ignore::FutureWarning")
    def test_a_server_that_refuses_does_not_fail_the_run(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        calls = []

        def refuse(*_: object, **__: object) -> None:
            calls.append(1)
            raise ConnectionError("artifacts are refused")

        for name in ("create_progress_artifact", "update_progress_artifact"):
            monkeypatch.setattr(senders, name, refuse)
        _, ref = toy_page(str(tmp_path / "store"))
        assert (Path(ref.uri) / "number").read_text() == "1"
        assert 0 < len(calls) <= senders.MAX_FAILURES
        assert "artifacts are refused" in caplog.text

    def test_a_server_that_hangs_slows_nothing(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        released = threading.Event()
        monkeypatch.setattr(senders, "create_progress_artifact", lambda *_, **__: released.wait(30))
        monkeypatch.setattr(senders, "CLOSE_SECONDS", 0.1)
        begun = time.monotonic()
        toy_page(str(tmp_path / "store"))
        taken = time.monotonic() - begun
        released.set()
        assert taken < 10


@pytest.mark.usefixtures("prefect_server")
def test_names_in_other_scripts_have_pages_of_their_own() -> None:
    names = ["患者一", "患者二", "scans/Müller", "scans/Möller", "left", ""]
    keys = [artifact_key("progress", name) for name in names]
    assert len(set(keys)) == len(names)
    assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", key) for key in keys)
    assert keys[4:] == ["progress-left", "progress"]
    assert keys[2].startswith("progress-scans-m-ller-")
    assert artifact_key("preview", SEQUENCE) == "preview-phantom-0-sparse"
    # As a part of the name of a file.
    pictures = [plain_letters(name, "A-Za-z0-9@.") for name in (*names[:4], SEQUENCE)]
    assert len(set(pictures)) == len(pictures)
    assert pictures[-1] == "phantom-0@sparse"


class TestLog:
    def test_the_librarys_lines_reach_the_runs_log(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        # Prefect's own level, which another test's command line may have raised in this process.
        level = caplog.at_level(logging.INFO, logger="prefect.task_runs")
        with level, temporary_settings({PREFECT_LOGGING_TO_API_ENABLED: True}):
            run_id, _ = toy_page(str(tmp_path / "store"), seed=7)
            lines = log_lines_of(run_id)
        assert (logging.INFO, "the library speaks, seed 7") in lines
        assert (logging.INFO, "from a thread without a run") in lines
        assert any(message.startswith("toy-long some/scene: finished in state") for _, message in lines)

    def test_a_thread_without_a_run_sends_to_the_runs_server(self, monkeypatch: pytest.MonkeyPatch) -> None:
        sent: list[tuple[str, str]] = []
        monkeypatch.setattr(
            "prefect.logging.handlers.emit_api_log",
            lambda log: sent.append((log["message"], PREFECT_API_URL.value())),
        )
        address = "http://localhost:1/of-the-block/api"
        with temporary_settings({PREFECT_LOGGING_TO_API_ENABLED: True, PREFECT_API_URL: address}):
            handler = RunLogHandler(uuid4())
        record = logging.LogRecord("extrags.toy", logging.INFO, "toy.py", 1, "words", None, None)
        thread = threading.Thread(target=handler.emit, args=(record,))
        thread.start()
        thread.join()
        assert sent == [("words", address)]

    def test_levels_and_handlers_are_as_before(self, tmp_path: Path) -> None:
        before = [(logging.getLogger(name).level, list(logging.getLogger(name).handlers)) for name in LOGGED]
        with temporary_settings({PREFECT_LOGGING_TO_API_ENABLED: True}):
            toy_page(str(tmp_path / "store"))
        after = [(logging.getLogger(name).level, list(logging.getLogger(name).handlers)) for name in LOGGED]
        assert after == before

    def test_outside_a_run_nothing_changes(self) -> None:
        with run_log():
            assert logging.getLogger("data_catalog").level == logging.NOTSET


LOGGED = ("extrags", "data_catalog", "tasks", "flows")


@pytest.mark.usefixtures("prefect_server")
def test_pictures_and_report_are_on_the_page(finished: tuple[str, SequenceOutcome]) -> None:
    from PIL import Image
    from prefect.artifacts import Artifact

    store, _ = finished
    outcome = reconstruct_sequence(sequence=SEQUENCE, profile="quick", settings=TINY, store=store)
    picture: Any = Artifact.get(artifact_key("preview", SEQUENCE))
    assert picture.type == "image"
    head, _, content = picture.data.partition(";base64,")
    assert head in ("data:image/png", "data:image/jpeg")
    assert len(picture.data) <= 30_000
    width, height = Image.open(io.BytesIO(base64.b64decode(content))).size
    # Four views of 48 x 40 pixels side by side.
    assert (width, height) == (192, 40)
    assert "recorded, coarse scene, final scene, the same, restored" in picture.description
    link: Any = Artifact.get(artifact_key("report", SEQUENCE))
    assert outcome.report is not None
    assert outcome.report in link.data
    assert Path(outcome.report).as_uri() in link.data
    progress: Any = Artifact.get(artifact_key("progress", SEQUENCE))
    assert progress.data == 100.0


@pytest.mark.usefixtures("prefect_server")
def test_a_sequence_without_artifacts_is_still_a_result(
    finished: tuple[str, SequenceOutcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ConnectionError("artifacts are refused")

    monkeypatch.setattr("prefect.client.orchestration.SyncPrefectClient.create_artifact", refuse)
    store, _ = finished
    outcome = reconstruct_sequence(sequence=SEQUENCE, profile="quick", settings=TINY, store=store)
    assert outcome.status == "ok"
