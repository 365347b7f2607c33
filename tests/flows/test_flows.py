"""The flows as Prefect runs them, on the tiny sequence."""

from __future__ import annotations

import gc
import threading
import traceback
import weakref
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
import yaml
from prefect.artifacts import Artifact
from prefect.client.schemas.objects import FlowRun
from prefect.context import FlowRunContext
from prefect.flows import Flow, load_flow_from_entrypoint
from prefect.task_runners import ThreadPoolTaskRunner

import extrags.cores
import flows.dataset
import tasks.progress
from extrags.errors import ArtefactGoneError, ConfigError, ExtragsError, StoreError
from extrags.stages import STAGES
from extrags.store import Store
from flows.dataset import reconstruct_dataset
from flows.limits import StageLimits
from flows.outcome import DatasetFailedError, SequenceFailedError, SequenceOutcome
from flows.outcome_records import outcome_records
from flows.sequence import open_store, reconstruct_sequence
from flows.settings import pipeline_config, task_runner
from tasks.run_page import artifact_key
from tests.flows.tiny import GIVEN, SEQUENCE, TINY

REPOSITORY = Path(__file__).parents[2]


def states(outcome: SequenceOutcome) -> dict[str, str]:
    return {row.stage: row.state for row in outcome.stages}


@pytest.mark.usefixtures("prefect_server")
class TestSequence:
    def test_finds_what_other_runners_made(self, finished: tuple[str, SequenceOutcome]) -> None:
        store, first = finished
        outcome = reconstruct_sequence(sequence=SEQUENCE, profile="quick", settings=TINY, store=store)
        assert states(outcome) == {**dict.fromkeys(STAGES, "cached"), **dict.fromkeys(GIVEN, "skipped")}
        assert outcome.digests == first.digests
        artifact: Any = Artifact.get(artifact_key("sequence", SEQUENCE))
        assert "| finetune | cached |" in artifact.data

    def test_makes_the_same_as_other_runners(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        _, first = finished
        store = str(tmp_path / "store")
        outcome = reconstruct_sequence(
            sequence=SEQUENCE, profile="quick", settings=TINY, store=store, until="evaluate"
        )
        assert set(states(outcome).values()) == {"ran", "skipped"}
        for stage in ("ingest", "coarse", "surface", "explore", "enhance", "finetune", "metrics_final"):
            assert outcome.digests[stage] == first.digests[stage], stage
        assert list((tmp_path / "store" / "locks").iterdir()) == []
        assert list((tmp_path / "store" / "scratch").iterdir()) == []

    def test_a_failure_is_the_runs_failure(self, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        state = reconstruct_sequence(
            sequence=str(tmp_path / "empty"), store=str(tmp_path / "store"), return_state=True
        )
        assert state.is_failed()
        failure = state.result(raise_on_failure=False)
        assert isinstance(failure, SequenceFailedError)
        assert states(failure.outcome)["ingest"] == "failed"
        assert Store(tmp_path / "store").ls() == []

    @pytest.mark.usefixtures("shared_data")
    def test_a_refusal_advises_nothing_that_the_method_sets(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The method needs weights of LPIPS, which are looked for before the memory."""
        monkeypatch.setattr("flows.memory_limit.usable_cores", lambda: 2)
        with pytest.raises(
            SequenceFailedError, match=r"it fits with --enhance\.max_views \d+ --ingest\.width"
        ):
            reconstruct_sequence(
                sequence=SEQUENCE,
                method="paper",
                settings={"ingest.width": 320, "ingest.max_frames": 6},
                store=str(tmp_path),
                limits=StageLimits(memory_gb=2.2),
            )

    def test_a_path_has_one_name_on_record(self, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        for spelling in ("empty", "empty/"):
            name = f"{tmp_path}/{spelling}"
            reconstruct_sequence(sequence=name, store=str(tmp_path / "store"), return_state=True)
        (record,) = outcome_records(Store(tmp_path / "store")).values()
        assert record["sequence"] == str(tmp_path / "empty")

    def test_a_store_that_cannot_be_written_stops_it_at_once(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("x")
        with pytest.raises(StoreError, match="cannot be written"):
            reconstruct_sequence(sequence=SEQUENCE, store=str(tmp_path / "file"))

    def test_a_wrong_setting_stops_it_at_once(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"did you mean coarse\.iterations"):
            reconstruct_sequence(
                sequence=SEQUENCE, settings={"coarse.iteration": 1}, store=str(tmp_path / "store")
            )


@pytest.mark.usefixtures("prefect_server")
class TestDataset:
    @pytest.mark.parametrize("at_once", [1, 2])
    def test_a_failure_does_not_stop_the_others(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, at_once: int
    ) -> None:
        store, first = finished
        (tmp_path / "empty").mkdir()
        found = reconstruct_dataset(
            sequences=[str(tmp_path / "empty"), SEQUENCE],
            profile="quick",
            settings=TINY,
            store=store,
            at_once=at_once,
            name=f"two-{at_once}",
        )
        assert [outcome.status for outcome in found.sequences] == ["failed", "ok"]
        assert found.sequences[1].digests == first.digests
        artifact: Any = Artifact.get(f"dataset-two-{at_once}")
        assert "ingest: " in artifact.data
        assert found.report is not None
        page = Path(found.report).read_text()
        assert SEQUENCE in page
        assert "empty" in page

    @pytest.mark.parametrize(("allowed", "fails"), [(None, True), (1.0, False)])
    def test_a_run_whose_sequences_all_failed_has_failed(
        self, tmp_path: Path, allowed: float | None, fails: bool
    ) -> None:
        folders = [tmp_path / "empty", tmp_path / "also-empty"]
        for folder in folders:
            folder.mkdir()
        share = {} if allowed is None else {"max_failed_share": allowed}
        state = reconstruct_dataset(
            sequences=[str(folder) for folder in folders],
            store=str(tmp_path / "store"),
            name=f"none-{allowed}",
            return_state=True,
            **share,
        )
        assert (state.is_failed(), state.is_completed()) == (fails, not fails)
        # Table and page have been written all the same, and the state says what happened.
        artifact: Any = Artifact.get(artifact_key("dataset", f"none-{allowed}"))
        assert "also-empty" in artifact.data
        assert [manifest.stage for manifest in Store(tmp_path / "store").ls()] == ["dataset-report"]
        if fails:
            assert "2 of 2 sequences failed" in state.message
            assert "the folder is empty" in state.message
            failure = state.result(raise_on_failure=False)
            assert isinstance(failure, DatasetFailedError)
            assert [outcome.status for outcome in failure.outcome.sequences] == ["failed", "failed"]


@pytest.mark.usefixtures("prefect_server")
def test_what_a_failed_sequence_had_in_memory_is_gone_when_the_next_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[weakref.ref[np.ndarray]] = []
    in_memory: list[int] = []

    def reconstruct(*_: object, **__: object) -> None:
        gc.collect()
        in_memory.append(sum(found() is not None for found in held))
        large = np.zeros(1 << 20)
        held.append(weakref.ref(large))
        try:
            raise ValueError(large.shape)
        except ValueError as error:
            raise ExtragsError("it diverged") from error

    monkeypatch.setattr("extrags.training.reconstruct", reconstruct)
    found = reconstruct_dataset(
        # Of one colon, which a process paints once, and as few frames as are read at once.
        sequences=[f"phantom/0@{setting}" for setting in ("sparse", "distanced", "covered")],
        profile="quick",
        settings={**TINY, "ingest.max_frames": 6},
        store=str(tmp_path),
        until="coarse",
        max_failed_share=1,
    )
    assert in_memory == [0, 0, 0]
    # What `--debug` shows is there all the same.
    for outcome in found.sequences:
        shown = "".join(traceback.format_exception(outcome.error))
        assert "raise ValueError(large.shape)" in shown
        assert "ExtragsError: it diverged" in shown


def test_an_interrupted_dataset_begins_no_more_sequences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted = threading.Event()
    monkeypatch.setattr(tasks.progress, "_interrupted", interrupted)
    sequences = [f"phantom/{number}@sparse" for number in range(6)]
    begun, told = [], []

    def one(*, sequence: str, **_: object) -> None:
        begun.append(sequence)
        if sequence == sequences[0]:
            raise KeyboardInterrupt
        told.append(interrupted.wait(5))
        raise KeyboardInterrupt

    class Started:
        def with_options(self, **_: object) -> Any:
            return one

    monkeypatch.setattr(flows.dataset, "reconstruct_sequence", Started())
    with pytest.raises(KeyboardInterrupt):
        reconstruct_dataset.fn(sequences, store=str(tmp_path), until="ingest", at_once=2)
    # The thread of the first may have begun another before it was known.
    assert len(begun) <= 3
    assert all(told)
    assert not interrupted.is_set(), "further runs of this process are not interrupted"


@pytest.mark.usefixtures("prefect_server")
def test_a_dataset_makes_each_stage_anew_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also what its runs share, and where the page of all of them meets damage."""
    slot, build = Store.slot, flows.dataset.dataset_page
    made: list[str] = []
    pages: list[Any] = []

    def counted(store: Store, *, key: str, **more: Any) -> Any:
        made.append(key)
        return slot(store, key=key, **more)

    def page(*given: Any) -> str:
        pages.append(given)
        if len(pages) == 1:
            raise ArtefactGoneError("it was removed meanwhile", "report-v1-00")
        return build(*given)

    monkeypatch.setattr(Store, "slot", counted)
    monkeypatch.setattr(flows.dataset, "dataset_page", page)
    found = reconstruct_dataset(
        sequences=[SEQUENCE],
        profile="quick",
        settings={**TINY, "coarse.iterations": 20},
        store=str(tmp_path),
        methods=["coarse", "3dgs"],
        refresh=True,
    )
    assert [outcome.status for outcome in found.sequences] == ["ok", "ok"]
    assert len(pages) == 2
    assert len(set(made)) == len(made) > 8
    assert sum(key.startswith("ingest-") for key in made) == 1
    # Made in the first pass, found in the second: of the run they are made.
    for outcome in found.sequences:
        coarse = outcome.row("coarse")
        assert coarse is not None
        assert coarse.state == "ran"
        assert coarse.spent_seconds == pytest.approx(coarse.made_seconds)
        assert outcome.seconds > coarse.spent_seconds > 0


@pytest.mark.parametrize("inner", [False, True])
def test_leftovers_are_looked_for_by_the_outer_run_alone(inner: bool, tmp_path: Path) -> None:
    (tmp_path / "scratch" / "left").mkdir(parents=True)
    run = FlowRun(flow_id=uuid4(), parent_task_run_id=uuid4() if inner else None)
    with FlowRunContext.model_construct(flow_run=run):
        open_store(str(tmp_path))
    assert (tmp_path / "scratch" / "left").exists() is inner


@pytest.mark.parametrize("step", ["Store.sweep", "sweep_locks", "file_killed", "sweep_unreadable"])
def test_leftovers_that_cannot_be_removed_end_no_run(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: object, **__: object) -> list[str]:
        raise StoreError("the server is busy")

    monkeypatch.setattr(f"flows.sequence.{step}", fails)
    (tmp_path / "scratch" / "left").mkdir(parents=True)
    assert open_store(str(tmp_path)).root == str(tmp_path)
    assert "could not all be removed: the server is busy" in caplog.text
    assert (tmp_path / "scratch" / "left").exists() is (step == "Store.sweep")


def test_a_store_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StoreError, match="cannot be written"):
        open_store(str(tmp_path / "file" / "store"))


class TestParameters:
    def test_seed_reaches_every_stage(self) -> None:
        config = pipeline_config("quick", None, 7)
        assert (config.coarse.seed, config.assess.seed, config.enhance.seed) == (7, 7, 7)

    def test_an_override_beats_the_seed(self) -> None:
        assert pipeline_config("quick", {"coarse.seed": 3}, 7).coarse.seed == 3

    @pytest.mark.parametrize("name", ["thread", "threads:2", "process", ""])
    def test_unknown_runners_are_refused(self, name: str) -> None:
        with pytest.raises(ConfigError, match="no task runner"):
            task_runner(name)

    def test_threads_are_no_more_than_a_containers_quota(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "cpu.max").write_text("50000 100000")
        monkeypatch.setattr(extrags.cores, "CONTROL_GROUP", tmp_path)
        assert task_runner("threads") == ThreadPoolTaskRunner(max_workers=1)


def deployments() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = yaml.safe_load((REPOSITORY / "prefect.yaml").read_text())["deployments"]
    return found


@pytest.mark.parametrize("deployment", deployments(), ids=lambda deployment: deployment["name"])
def test_deployments_name_flows_and_valid_parameters(
    deployment: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)
    flow: Flow[..., Any] = load_flow_from_entrypoint(deployment["entrypoint"])
    flow.validate_parameters(deployment["parameters"])
    for schedule in deployment.get("schedules", []):
        assert schedule["active"] is False
