"""One look at a whole store: done, missing, failed, running; fast, and without reading an artefact."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from extrags.errors import UnknownSequenceError
from extrags.stages import STAGES
from extrags.store import Store, digest_of
from extrags.store.runs import recorded_run
from flows.cases import SequenceCase, record_outcome, selected
from flows.cli import main
from flows.expectation import expectations
from flows.outcome import SequenceOutcome, StageRow
from flows.outcome_records import outcome_records
from flows.runners import DirectRunner
from flows.store_status import StageStatus, StatusRow, StoreStatus, store_status
from flows.wiring import run_sequence
from tests.flows.tiny import GIVEN, SEQUENCE, TINY, tiny_config

CASE = SequenceCase(SEQUENCE, profile="quick", settings=TINY)


@pytest.fixture
def store(finished: tuple[str, SequenceOutcome], tmp_path: Path) -> Store:
    root, outcome = finished
    # Tests of flows add to that store: other artefacts, and records of their runs.
    for key in {key for row in outcome.stages for key in row.made}:
        shutil.copytree(Path(root) / "artefacts" / key, tmp_path / "store" / "artefacts" / key)
    made = Store(tmp_path / "store")
    record_outcome(made, CASE, outcome, "report", tiny_config())
    return made


def test_a_finished_sequence(store: Store, finished: tuple[str, SequenceOutcome]) -> None:
    found = store_status(store)
    (row,) = found.rows
    assert (row.sequence, row.variant, row.state) == (SEQUENCE, "quick", "done")
    assert {stage for stage, item in row.stages.items() if item.state == "skipped"} == set(GIVEN)
    assert row.psnr == pytest.approx(finished[1].metrics["final"]["psnr"])
    assert row.seconds == pytest.approx(sum(stage.made_seconds for stage in finished[1].stages), rel=1e-3)
    assert found.unrecorded == 0
    assert found.bytes == sum(sum(stage.made.values()) for stage in finished[1].stages)
    assert found.artefacts == len(store.ls())


def test_pages_of_several_sequences_are_of_no_run(store: Store) -> None:
    for key in ("dataset-report-v7-x", "coarse-v1-x"):
        with store.slot(stage=key.rpartition("-v")[0], version=7, key=key, label="a dataset") as slot:
            (slot.path / "page.html").write_text("a page")
    found = store_status(store)
    # The scene is of a run with other settings.
    assert (found.artefacts, found.unrecorded) == (len(store.ls()), 1)


def test_what_was_removed_is_missing(store: Store) -> None:
    store.rm("finetune*")
    (row,) = store_status(store).rows
    assert row.state == "missing"
    assert [stage for stage, item in row.stages.items() if item.state == "missing"] == ["finetune"]


@pytest.mark.parametrize("record", [[], {}, {"sequence": SEQUENCE}, "a stage lacks its artefacts"])
def test_a_damaged_record_hides_no_other(
    store: Store, record: object, caplog: pytest.LogCaptureFixture
) -> None:
    whole = next(iter(outcome_records(store).values()))
    if isinstance(record, str):
        record = whole | {"stages": [{**whole["stages"][0], "artefacts": None}]}
    store.backend.write_record("outcome.damaged.json", json.dumps(record).encode())
    (row,) = store_status(store).rows
    assert (row.sequence, row.state) == (SEQUENCE, "done")
    assert f"the record outcome.damaged.json of {store.root} is damaged and skipped" in caplog.text
    (found,) = expectations([CASE], store.root, "report")
    assert found.seconds == 0
    assert selected([CASE], "failed", store.root, "report") == []


def test_what_is_being_made(store: Store) -> None:
    with store.slot(stage="enhance-restore", version=1, key="enhance-restore-v1-x", label=SEQUENCE):
        (row,) = store_status(store).rows
        assert (row.state, row.stages["enhance"].state) == ("running", "running")
    with store.slot(stage="ingest", version=1, key="ingest-v1-x", label="phantom/3@sparse"):
        rows = store_status(store).rows
        assert [(row.sequence, row.state) for row in rows][1] == ("phantom/3@sparse", "running")


def test_what_another_process_makes(store: Store) -> None:
    """However that process ends."""
    code = (
        "import sys, time\n"
        "from extrags.store import Store\n"
        "from extrags.store.runs import recorded_run\n"
        "store = Store(sys.argv[1])\n"
        "slot = store.slot(stage='ingest', version=1, key='ingest-v1-x', label='phantom/3@sparse')\n"
        "with recorded_run(store, 'phantom/3@sparse'), slot:\n"
        "    print('makes it', flush=True)\n"
        "    time.sleep(600)\n"
    )
    command = [sys.executable, "-c", code, store.root]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "makes it\n"
            states = {row.sequence: row.state for row in store_status(store).rows}
            assert states == {SEQUENCE: "done", "phantom/3@sparse": "running"}
        finally:
            other.kill()
    assert "running" not in {row.state for row in store_status(store).rows}


def half_a_run(store: Store, finished: tuple[str, SequenceOutcome]) -> set[str]:
    """Keys of a run that came as far as the restorer, in a store that has no record of it."""
    for record in (Path(store.root) / "records").glob("outcome.*"):
        record.unlink()
    stages = [row for row in finished[1].stages if STAGES.index(row.stage) < STAGES.index("enhance")]
    made = {key for row in finished[1].stages if row.stage == "enhance" for key in row.made}
    return {key for row in stages for key in row.made} | {key for key in made if "train" in key}


def test_a_first_run_that_is_going_on(store: Store, finished: tuple[str, SequenceOutcome]) -> None:
    keys = half_a_run(store, finished)
    with recorded_run(store, SEQUENCE) as record:
        assert record is not None
        record.add(keys)
        found = store_status(store)
    (row,) = found.rows
    assert row.state == "running"
    assert [row.stages[stage].state for stage in STAGES] == [
        "done",
        *["skipped"] * 2,
        *["done"] * 5,
        *["missing"] * 4,
    ]
    assert row.stages["coarse"].seconds > 0
    assert found.unrecorded == found.artefacts - len(keys)
    assert found.bytes == sum(store.manifest(ref).bytes for ref in map(store.find, keys) if ref is not None)


def test_a_first_run_that_was_interrupted(store: Store, finished: tuple[str, SequenceOutcome]) -> None:
    keys = half_a_run(store, finished)

    def interrupted() -> None:
        with recorded_run(store, SEQUENCE) as record:
            assert record is not None
            record.add(keys)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    (row,) = store_status(store).rows
    assert (row.state, row.stages["explore"].state, row.stages["enhance"].state) == (
        "stopped",
        "done",
        "missing",
    )
    assert main(["status", "--store", store.root]) == 0


def test_a_run_with_other_settings_is_not_the_one_on_record(
    store: Store, finished: tuple[str, SequenceOutcome]
) -> None:
    keys = {key for row in finished[1].stages if row.stage == "ingest" for key in row.made}
    with (
        recorded_run(store, SEQUENCE, "other") as record,
        store.slot(stage="coarse", version=1, key="coarse-v1-other", label=SEQUENCE),
    ):
        assert record is not None
        record.add(keys)
        other, done = store_status(store).rows
    assert (done.variant, done.state, done.stages["coarse"].state) == ("quick", "done", "done")
    assert (other.variant, other.state) == ("other settings", "running")
    assert [other.stages[stage].state for stage in ("ingest", "coarse")] == ["done", "running"]
    with (
        recorded_run(store, SEQUENCE, digest_of(tiny_config())),
        store.slot(stage="coarse", version=1, key="coarse-v1-again", label=SEQUENCE),
    ):
        (row,) = store_status(store).rows
    assert (row.state, row.stages["coarse"].state) == ("running", "running")


def test_a_run_notes_the_settings_that_its_record_will_have(
    finished: tuple[str, SequenceOutcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    noted: list[str] = []

    @contextmanager
    def noting(store: Store, sequence: str, config: str, place: str) -> Iterator[None]:
        noted.append(config)
        yield None

    monkeypatch.setattr("flows.cached_stages.recorded_run", noting)
    root, config = finished[0], CASE.config()
    run_sequence(SEQUENCE, config, root, DirectRunner(root), profile="quick", until="ingest")
    assert noted == [digest_of(config)]


@pytest.mark.parametrize("stage", ["benchmark-report", "dataset-report"])
def test_a_page_of_several_sequences_is_no_sequence(store: Store, stage: str) -> None:
    with store.slot(stage=stage, version=1, key=f"{stage}-v1-x", label="benchmark"):
        assert [row.sequence for row in store_status(store).rows] == [SEQUENCE]


def test_frames_for_a_later_stage_do_not_make_it_done(
    store: Store, finished: tuple[str, SequenceOutcome]
) -> None:
    keys = half_a_run(store, finished)
    with recorded_run(store, SEQUENCE) as record:
        assert record is not None
        record.add(key for key in keys if key.startswith(("ingest-", "training-frames-")))
        (row,) = store_status(store).rows
    assert {stage for stage, item in row.stages.items() if item.state == "done"} == {"ingest"}
    assert row.stages["coarse"].state == "missing"


def test_a_name_that_is_nothing_is_refused(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnknownSequenceError):
        store_status(store, ["nosuch"])
    assert main(["status", "nosuch", "--store", store.root]) != 0
    assert "nosuch" in capsys.readouterr().err


def test_a_failure_says_why(store: Store) -> None:
    rows = [StageRow("ingest", "failed", reason="no pictures"), StageRow("poses", "skipped")]
    broken = SequenceCase("phantom/1@sparse", method="3dgs", seed=2, changed={"coarse.seed": 1})
    record_outcome(store, broken, SequenceOutcome(broken.sequence, "failed", rows), "coarse", tiny_config())
    row = store_status(store).rows[1]
    assert (row.state, row.reason) == ("failed", "ingest: no pictures")
    assert row.variant == "balanced, 3dgs, seed 2, coarse.seed = 1"
    assert [row.stages[stage].state for stage in STAGES[:4]] == ["failed", "skipped", "missing", "missing"]


def test_what_failed_and_is_tried_again(store: Store, finished: tuple[str, SequenceOutcome]) -> None:
    rows = [
        StageRow("ingest", "failed", reason="no frames"),
        StageRow("coarse", "skipped", reason="as before"),
    ]
    failed = SequenceOutcome(SEQUENCE, "failed", rows)
    keys = half_a_run(store, finished)
    record_outcome(store, CASE, failed, "report", tiny_config())
    with recorded_run(store, SEQUENCE, digest_of(tiny_config())) as record:
        assert record is not None
        # Before its first artefact, too.
        assert [row.state for row in store_status(store).rows] == ["running"]
        record.add(keys)
        (row,) = store_status(store).rows
        assert (row.state, row.variant, row.reason) == ("running", "quick", "")
        assert [row.stages[stage].state for stage in ("ingest", "coarse", "finetune")] == [
            "done",
            "done",
            "missing",
        ]
        assert main(["status", "--store", store.root]) == 0
    with recorded_run(store, SEQUENCE, "other"):
        assert "failed" in store_status(store).counts


def test_patterns_show_what_was_never_run_as_well(store: Store) -> None:
    rows = store_status(store, ["phantom/[01]@sparse"]).rows
    assert [(row.sequence, row.state) for row in rows] == [
        (SEQUENCE, "done"),
        ("phantom/1@sparse", "missing"),
    ]
    with pytest.raises(UnknownSequenceError):
        store_status(store, ["nothing/*"])


def test_the_command(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "--store", store.root, "--json", str(tmp_path / "status.json")]) == 0
    said = capsys.readouterr().out
    assert SEQUENCE in said
    assert "1 run: 1 done" in said
    found = json.loads((tmp_path / "status.json").read_text())
    assert found["sequences"][0]["stages"]["coarse"]["state"] == "done"
    assert main(["status", "--store", str(tmp_path / "none")]) == 1
    assert "there is no store" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("width", [40, 80, 200])
def test_names_are_there_however_narrow_the_terminal(
    store: Store, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    monkeypatch.setattr("flows.terminal.console", lambda *_given, **_named: Console(width=width))
    assert main(["status", "--store", store.root]) == 0
    said = capsys.readouterr().out
    assert SEQUENCE in said
    assert ("ended" in said) == (width == 200)


def test_a_store_with_brackets_in_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = tmp_path / "run[" / "old]"
    place.mkdir(parents=True)
    assert main(["status", "--store", str(place)]) == 0
    assert "run[/old]" in capsys.readouterr().out.replace("\n", "")


def test_what_sequences_share_took_its_time_once() -> None:
    coarse, first, second = (
        StageStatus("done", seconds, artefacts=frozenset({key}))
        for seconds, key in ((40.0, "a"), (30.0, "b"), (5.0, "c"))
    )
    rows = [
        StatusRow(name, "", "done", "", "", None, {"coarse": coarse, "evaluate": own})
        for name, own in (("phantom/0@sparse", first), ("phantom/0@distanced", second))
    ]
    assert [row.seconds for row in rows] == [70, 45]
    assert StoreStatus("", rows, 3, 0, 0).seconds == 75


@pytest.mark.parametrize("root", ["nowhere", "memory://nowhere/store"])
def test_a_store_that_is_not_there_is_no_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], root: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["status", "--store", root]) == 1
    assert "there is no store" in capsys.readouterr().err


def test_every_sequence_with_a_record_has_a_row(store: Store) -> None:
    (record,) = (Path(store.root) / "records").glob("outcome.*")
    text = record.read_text()
    for number in range(200):
        (record.parent / f"outcome.{number:04d}.json").write_text(
            text.replace(SEQUENCE, f"phantom/{number}@distanced")
        )
    assert len(store_status(store).rows) == 201
