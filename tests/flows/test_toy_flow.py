"""The machinery inside real flow runs: caching, failure, concurrency, kill and resume."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from prefect.settings import PREFECT_API_URL
from prefect_dask import DaskTaskRunner

from extrags.store import Store
from tests.flows.toy import same_key_twice, toy
from tests.tasks.toy import ToyConfig

pytestmark = pytest.mark.usefixtures("prefect_server")


def names(outcome: list[tuple[str, str, Any]]) -> list[str]:
    return [state for _, state, _ in outcome]


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "runs"
    path.touch()
    monkeypatch.setenv("EXTRAGS_TEST_RUNS", str(path))
    return path


def test_second_run_is_all_cached(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    first = toy(store)
    assert names(first) == ["Completed"] * 5
    second = toy(store)
    assert names(second) == ["Cached"] * 5
    assert [ref for *_, ref in first] == [ref for *_, ref in second]
    assert len(runs.read_text().split()) == 5
    assert list((tmp_path / "store" / "locks").iterdir()) == []
    assert list((tmp_path / "store" / "scratch").iterdir()) == []


def test_only_what_depends_on_a_changed_setting_runs_again(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    toy(store)
    changed = toy(store, ToyConfig(scale=3.0))
    assert names(changed) == ["Cached", "Cached", "Completed", "Completed", "Completed"]


def test_an_equal_intermediate_result_keeps_what_follows_cached(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    toy(store)
    Store(store).rm("toy-double")
    assert names(toy(store)) == ["Cached", "Cached", "Completed", "Completed", "Cached"]


def test_refresh_runs_everything_to_the_same_content(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    first = toy(store)
    again = toy(store, refresh=True)
    assert names(again) == ["Completed"] * 5
    assert len(runs.read_text().split()) == 10
    assert [ref for *_, ref in first] == [ref for *_, ref in again]


def test_a_removed_artefact_is_made_again(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    toy(store)
    Store(store).rm("*")
    assert names(toy(store)) == ["Completed"] * 5


def test_a_failing_stage_leaves_nothing_behind(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    outcome = toy(store, ToyConfig(fail=True))
    assert names(outcome) == ["Completed", "Completed", "Failed", "Failed"]
    assert {manifest.stage for manifest in Store(store).ls()} == {"toy-source"}
    root = tmp_path / "store"
    assert list((root / "scratch").iterdir()) == []
    assert list((root / "locks").iterdir()) == []
    assert sorted(path.name for path in root.iterdir()) == ["artefacts", "failed", "locks", "scratch"]


def test_one_key_runs_once_however_often_it_is_asked_for(tmp_path: Path, runs: Path) -> None:
    assert same_key_twice(str(tmp_path / "store")) == ["Cached", "Cached", "Cached", "Completed"]
    assert runs.read_text() == "source\n"


def run_in_a_child(store: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tests.flows.toy", str(store)],
        env={**os.environ, "PREFECT_API_URL": str(PREFECT_API_URL.value()), **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def test_a_killed_run_resumes_where_it_was(tmp_path: Path, runs: Path) -> None:
    store = tmp_path / "store"
    killed = run_in_a_child(store, EXTRAGS_TEST_DIE="1")
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert {manifest.stage for manifest in Store(store).ls()} == {"toy-source", "toy-double"}
    assert len(list((store / "scratch").iterdir())) == 1

    resumed = run_in_a_child(store)
    assert resumed.stdout.split() == ["Cached"] * 4 + ["Completed"], resumed.stderr
    assert list((store / "locks").iterdir()) == []
    assert len(Store(store).sweep()) == 1

    undisturbed = toy(str(tmp_path / "other"))
    assert [ref.digest for *_, ref in undisturbed] == [ref.digest for *_, ref in toy(str(store))]


@pytest.mark.slow
def test_dask_workers_share_the_cache(tmp_path: Path, runs: Path) -> None:
    store = str(tmp_path / "store")
    cluster = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    on_dask = toy.with_options(task_runner=DaskTaskRunner(cluster_kwargs=cluster))
    assert names(on_dask(store)) == ["Completed"] * 5
    assert names(toy(store)) == ["Cached"] * 5
    assert len(runs.read_text().split()) == 5
