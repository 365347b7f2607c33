"""Cleaning goes on where one step fails, and says so at the end; its numbers have bounds."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from prefect.exceptions import ParameterTypeError

import flows.retention
from extrags.errors import StoreError
from extrags.store import Store, write_record
from extrags.store.directory import DirectoryBackend
from extrags.store.retention import Policy
from flows.cases import SequenceCase, record_outcome
from flows.cleaning import clean_store
from flows.cli import main
from flows.outcome import failed_outcome
from flows.outcome_records import outcome_records, removable_outcomes
from flows.retention import retention
from flows.store_status import store_status
from tests.flows.tiny import TINY, tiny_config
from tests.other_user import give_to_another_user


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """Three old artefacts: one that goes, one that cannot be removed, one whose manifest is damaged."""
    found = Store(tmp_path / "store")
    for name in ("goes", "stays", "damaged"):
        with found.slot(stage=name, version=1, key=f"{name}-v1-0", label=name) as slot:
            (slot.path / "file").write_text("x")
    (tmp_path / "store" / "artefacts" / "damaged-v1-0" / "manifest.json").write_text("{")
    for name in ("goes", "stays", "damaged"):
        os.utime(tmp_path / "store" / "artefacts" / f"{name}-v1-0", (time.time() - 90 * 86400,) * 2)
    usual = DirectoryBackend.discard

    def discard(backend: DirectoryBackend, key: str) -> bool:
        if key == "stays-v1-0":
            raise StoreError(f"{key} cannot be removed: Permission denied")
        return usual(backend, key)

    monkeypatch.setattr(DirectoryBackend, "discard", discard)
    return found


def test_the_flow_says_at_the_end_what_could_not_be_done(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    pruned: list[object] = []
    monkeypatch.setattr(flows.retention, "create_markdown_artifact", lambda text, **_: told.append(text))
    monkeypatch.setattr(flows.retention, "prune_flow_runs", lambda *_, **__: pruned.append(_) or 3)
    with pytest.raises(StoreError, match="not all could be cleaned: stays-v1-0 cannot be removed"):
        retention.fn(store=store.root, older_than_days=30, flow_runs_days=30)
    assert store.keys() == ["damaged-v1-0", "stays-v1-0"]
    assert len(pruned) == 1
    for row in ("| artefacts | 1 |", "| flow_runs | 3 |", "| skipped | 1 |"):
        assert row in told[0]


def test_leftovers_that_cannot_be_removed_keep_no_artefact(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gc(_: Store, **__: object) -> list[str]:
        raise PermissionError(13, "Permission denied", "failed/coarse")

    monkeypatch.setattr(Store, "gc", gc)
    policy: Any = flows.retention.Policy(older_than_s=86400.0)
    done = clean_store(store, policy)
    assert [item.key for item in done.artefacts.removed] == ["goes-v1-0"]
    assert list(map(str, done.problems)) == [
        "failed/coarse: Permission denied",
        "stays-v1-0 cannot be removed: Permission denied",
    ]
    with pytest.raises(StoreError, match=r"failed/coarse: Permission denied \(and 1 more\)"):
        done.check()


@pytest.mark.usefixtures("untouched_environment")
@pytest.mark.parametrize("kind", ["failed", "damaged"])
def test_files_of_a_failure_that_cannot_be_removed_keep_no_others(
    kind: str, store: Store, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [Path(store.root) / kind / name for name in ("coarse-v1-0", "depth-v1-0", "ingest-v1-0")]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "error.json").write_text("{}")
    give_to_another_user(monkeypatch, folders[1])
    assert main(["cache", "gc", "--store", store.root]) == 1
    said = capsys.readouterr()
    assert f"{kind}/coarse-v1-0\n{kind}/ingest-v1-0\n2 leftovers removed" in said.out
    assert f"{kind}/depth-v1-0 cannot be removed: Permission denied" in said.err
    assert [folder.exists() for folder in folders] == [False, True, False]


@pytest.mark.usefixtures("untouched_environment")
def test_what_cannot_be_removed_by_name_keeps_no_others(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cache", "rm", "stays*", "goes*", "damaged*", "--store", store.root]) == 1
    said = capsys.readouterr()
    assert said.out.startswith("goes-v1-0\ndamaged-v1-0\n2 artefacts removed from ")
    assert "stays-v1-0 cannot be removed" in said.err
    assert store.keys() == ["stays-v1-0"]


@pytest.mark.usefixtures("untouched_environment")
def test_the_command_says_so_as_well(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cache", "gc", "--older-than", "30d", "--store", store.root]) == 1
    said = capsys.readouterr()
    assert "1 artefact of 1 B removed\n1 artefact skipped, whose manifests cannot be read" in said.out
    assert "stays-v1-0 cannot be removed" in said.err


@pytest.mark.parametrize("name", ["older_than_days", "max_gib", "flow_runs_days"])
@pytest.mark.parametrize("value", [float("inf"), float("nan"), 1e308, -1.0])
def test_numbers_without_bounds_are_refused(name: str, value: float) -> None:
    with pytest.raises(ParameterTypeError, match=f"{name}: Input should be"):
        retention.validate_parameters({"store": "somewhere", name: value})


@pytest.mark.usefixtures("untouched_environment")
@pytest.mark.parametrize(
    "option", ["--older-than=-30d", "--older-than=30", "--max-size=-1GiB", "--keep-last=-1"]
)
def test_ages_and_sizes_below_zero_are_refused(option: str, store: Store) -> None:
    """Everything is older than that."""
    before = store.keys()
    assert main(["cache", "gc", option, "--store", store.root]) == 2
    assert store.keys() == before


@pytest.mark.usefixtures("untouched_environment")
def test_a_size_beyond_all_bounds_is_refused(store: Store) -> None:
    assert main(["cache", "gc", "--max-size", f"{'9' * 400}GiB", "--store", store.root]) == 2


class TestOutcomes:
    """Records of how runs ended, of sequences that failed before anything was made of them."""

    @pytest.fixture
    def store(self, tmp_path: Path) -> Store:
        made = Store(tmp_path / "store")
        made.check_writable()
        for sequence in ("phantom/0@sparse", "phantom/1@sparse"):
            case = SequenceCase(sequence, profile="quick", settings=TINY)
            record_outcome(made, case, failed_outcome(sequence, "it is empty"), "report", tiny_config())
        return made

    @pytest.mark.usefixtures("untouched_environment")
    def test_they_go_with_their_sequence(self, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["status", "--store", store.root]) == 1
        assert main(["cache", "rm", "phantom/0", "--store", store.root]) == 0
        assert "1 record of how runs ended removed" in capsys.readouterr().out
        assert [row.sequence for row in store_status(store).rows] == ["phantom/1@sparse"]
        assert main(["cache", "rm", "phantom/0", "--store", store.root]) == 1
        assert main(["cache", "rm", "phantom/*", "--store", store.root]) == 0
        assert main(["status", "--store", store.root]) == 0

    def test_those_of_a_sequence_of_that_name_elsewhere_stay(
        self, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for place in ("a", "b"):
            (tmp_path / place / "scan").mkdir(parents=True)
            monkeypatch.chdir(tmp_path / place)
            case = SequenceCase("scan", profile="quick", settings=TINY)
            record_outcome(store, case, failed_outcome("scan", "it is empty"), "report", tiny_config())
        here = str(tmp_path / "b" / "scan")
        (found,) = removable_outcomes(store, "scan", here=here)
        assert outcome_records(store)[found]["path"] == here
        assert removable_outcomes(store, here) == [found]
        assert removable_outcomes(store, "coarse") == []

    @pytest.mark.parametrize("dry_run", [True, False])
    def test_old_ones_go_when_nothing_is_left_of_their_run(self, store: Store, dry_run: bool) -> None:
        kept, gone = outcome_records(store).items()
        for name, record in (kept, gone):
            write_record(store, name, record | {"ended": "2026-01-01T00:00:00.000000+00:00"})
        with store.slot(stage="toy", version=1, key="toy-v1-x"):
            pass
        stages = [{**kept[1]["stages"][0], "artefacts": {"toy-v1-x": 1}}]
        write_record(store, kept[0], kept[1] | {"stages": stages, "ended": "2026-01-01T00:00:00+00:00"})
        young = {**gone[1], "sequence": "young"}
        write_record(store, "outcome.young", young)
        before = sorted(outcome_records(store))
        assert clean_store(store, Policy(max_bytes=0)).leftovers == []
        done = clean_store(store, Policy(older_than_s=86400.0), dry_run=dry_run)
        assert done.leftovers == [f"records/{gone[0]}.json"]
        assert sorted(outcome_records(store)) == ([kept[0], "outcome.young"] if not dry_run else before)
