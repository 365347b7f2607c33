"""Retention beside a run, as a flow, and from the command line."""

from __future__ import annotations

import datetime
import json
import os
import shutil
import threading
import time
from pathlib import Path

import pytest

from extrags.errors import StoreError
from extrags.store import Store
from extrags.store.retention import Policy, apply_policy, planned_removals
from extrags.store.runs import active_runs, recorded_run, runs_of
from flows.cli import main
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner, StoreRunner
from flows.wiring import run_sequence
from tests.documented_json import undocumented, undocumented_items
from tests.flows.tiny import SEQUENCE, tiny_config


@pytest.fixture
def store(finished: tuple[str, SequenceOutcome], tmp_path: Path) -> Store:
    """A copy of the finished store that nobody used for forty days."""
    shutil.copytree(Path(finished[0]) / "artefacts", tmp_path / "store" / "artefacts")
    moment = time.time() - 40 * 86400
    for place in (tmp_path / "store" / "artefacts").iterdir():
        os.utime(place, (moment, moment))
    return Store(tmp_path / "store")


def test_a_tiny_sequence_is_few_files_and_one_record(finished: tuple[str, SequenceOutcome]) -> None:
    root, whole = finished
    store = Store(root)
    assert active_runs(store) == []
    # Other tests run in this store as well.
    parts = {Path(uri).name for uri in whole.artefacts.values()}
    run = min((run for run in runs_of(store) if run.keys >= parts), key=lambda run: len(run.keys))
    assert {key.partition("-v")[0] for key in run.keys} >= {"explore-branch", "finetune-judge"}
    # Keyframes are on here, but off by default.
    usual = [key for key in run.keys if not key.startswith("enhance-keyframes")]
    files = [path for key in usual for path in (Path(root) / "artefacts" / key).rglob("*") if path.is_file()]
    assert 40 < len(files) < 70


def test_a_run_that_only_finds_everything_uses_everything(
    store: Store, finished: tuple[str, SequenceOutcome]
) -> None:
    run_sequence(SEQUENCE, tiny_config(), store.root, StoreRunner(store.root), profile="quick")
    removals = planned_removals(store, Policy(older_than_s=30 * 86400.0), now=time.time() + 3600.0).removed
    made = {key for row in finished[1].stages for key in row.made}
    assert not made & {item.key for item in removals}


@pytest.mark.parametrize(
    "until",
    ["coarse", pytest.param("report", marks=pytest.mark.slow)],
)
def test_removal_beside_a_run_changes_nothing_in_it(
    finished: tuple[str, SequenceOutcome], store: Store, until: str
) -> None:
    _, whole = finished
    over = threading.Event()
    removed: list[str] = []

    def collect() -> None:
        while not over.is_set():
            removed.extend(
                item.key for item in apply_policy(store, Policy(older_than_s=3600.0, max_bytes=0)).removed
            )
            store.gc()

    beside = threading.Thread(target=collect)
    beside.start()
    try:
        outcome = run_sequence(
            SEQUENCE,
            tiny_config(),
            store.root,
            DirectRunner(store.root),
            profile="quick",
            until=until,  # type: ignore[arg-type]
        )
    finally:
        over.set()
        beside.join()
    assert outcome.status == "ok", outcome.error
    expected = {part: whole.digests[part] for part in outcome.digests}
    assert outcome.digests == expected
    assert removed


@pytest.mark.usefixtures("prefect_server")
def test_the_flow(store: Store) -> None:
    from prefect import flow
    from prefect.client.orchestration import get_client

    from flows.retention import prune_flow_runs, retention

    @flow(name="of-somebody-else")
    def other() -> None:
        pass

    other()
    with pytest.raises(StoreError, match="there is no store"):
        retention(store=f"{store.root}-elsewhere")
    before = len(store.keys())
    said = retention(store=store.root, older_than_days=30, dry_run=True)
    assert (said["artefacts"], len(store.keys())) == (before, before)
    # As of a page that was opened yesterday, and of nothing else.
    page = store.ls("report")[-1]
    yesterday = time.time() - 86400
    os.utime(Path(store.root) / "artefacts" / page.key, (yesterday, yesterday))
    said = retention(store=store.root, older_than_days=30, dry_run=True)
    assert said["artefacts"] < before - 1
    said = retention(store=store.root, older_than_days=30, with_inputs=True, dry_run=True)
    assert said["artefacts"] == before - 1
    os.utime(Path(store.root) / "artefacts" / page.key, (0, 0))
    said = retention(store=store.root, older_than_days=30, flow_runs_days=1)
    assert (said["artefacts"], store.keys(), said["flow_runs"]) == (before, [], 0)
    later = datetime.datetime.now(datetime.UTC) + datetime.timedelta(hours=1)
    assert prune_flow_runs(later, dry_run=True) >= 2
    assert prune_flow_runs(later) >= 2
    assert prune_flow_runs(later) == 0
    with get_client(sync_client=True) as client:
        flows = {item.id: item.name for item in client.read_flows()}
        assert "of-somebody-else" in {flows[run.flow_id] for run in client.read_flow_runs()}


class TestCommand:
    def test_dry_run_removes_nothing(self, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
        before = store.keys()
        arguments = ["cache", "gc", "--older-than", "30d", "--store", store.root]
        assert main([*arguments, "--dry-run"]) == 0
        assert f"{len(before)} artefacts of " in capsys.readouterr().out
        assert store.keys() == before
        assert main([*arguments, "--json", "-"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert undocumented(found, "cache-gc") == []
        assert sorted(item["key"] for item in found["artefacts"]) == before
        assert store.keys() == []

    def test_pages_of_former_versions_go(self, store: Store) -> None:
        key = "benchmark-report-v0-0123456789abcdef"
        with store.slot(stage="benchmark-report", version=0, key=key, label="weekly"):
            pass
        place = Path(store.root) / "artefacts" / key
        os.utime(place, (time.time() - 40 * 86400,) * 2)
        assert main(["cache", "gc", "--store", store.root]) == 0
        assert not place.exists()
        assert any(item.stage == "report" for item in store.ls())

    def test_a_run_in_progress_keeps_what_an_earlier_version_made(self, store: Store) -> None:
        key = "benchmark-report-v0-0123456789abcdef"
        with store.slot(stage="benchmark-report", version=0, key=key, label="weekly"):
            pass
        os.utime(Path(store.root) / "artefacts" / key, (time.time() - 40 * 86400,) * 2)
        with recorded_run(store, "weekly") as record:
            assert record is not None
            record.add([key])
            assert main(["cache", "gc", "--store", store.root]) == 0
            assert len(store.ls(key)) == 1
        assert main(["cache", "gc", "--store", store.root]) == 0
        assert store.ls(key) == []

    def test_max_size(self, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "gc", "--max-size", "4MiB", "--store", store.root]) == 0
        assert 0 < sum(item.bytes for item in store.ls()) <= 4 << 20
        assert "used least recently" in capsys.readouterr().out

    def test_keep_last_and_unreachable(self, store: Store) -> None:
        assert main(["cache", "gc", "--keep-last", "3", "--unreachable", "--store", store.root]) == 0
        assert any(item.stage == "report" for item in store.ls())

    @pytest.mark.parametrize(
        ("option", "value"), [("--older-than", "30"), ("--max-size", "much"), ("--keep-last", "0")]
    )
    def test_wrong_values_are_refused(self, store: Store, option: str, value: str) -> None:
        assert main(["cache", "gc", option, value, "--store", store.root]) == 2

    @pytest.mark.parametrize("verb", [["ls"], ["usage"], ["gc"], ["rm", "x"]])
    def test_a_store_that_does_not_exist_is_an_error(
        self, verb: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["cache", *verb, "--store", str(tmp_path / "none")]) == 1
        assert f"there is no store {tmp_path / 'none'}" in capsys.readouterr().err
        assert not (tmp_path / "none").exists()

    def test_usage(self, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "usage", "--store", store.root]) == 0
        assert SEQUENCE in capsys.readouterr().out
        assert main(["cache", "usage", "--store", store.root, "--json", "-"]) == 0
        rows = json.loads(capsys.readouterr().out)
        assert undocumented_items(rows, "usage-of-a-sequence") == []
        assert SEQUENCE in {row["sequence"] for row in rows}
        assert sum(row["artefacts"] for row in rows) == len(store.keys())
