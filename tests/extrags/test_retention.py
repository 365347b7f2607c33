"""Retention: what goes, what stays, and why."""

from __future__ import annotations

import datetime
import errno
import fcntl
import json
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from extrags.errors import StoreError
from extrags.store import Ref, Store
from extrags.store.directory import DirectoryBackend
from extrags.store.records import remove_record
from extrags.store.retention import Policy, Removal, apply_policy, planned_removals, usage
from extrags.store.runs import active_runs, file_killed, recorded_run, runs_of, sweep_unreadable

DAY_S = 86400.0


def put(store: Store, name: str, *, days: float = 0.0, label: str = "phantom/0", **inputs: Ref) -> Ref:
    """An artefact that was used so many days ago."""
    key = f"{name}-v1-00"
    with store.slot(stage=name, version=1, key=key, label=label, inputs=inputs) as slot:
        (slot.path / "file").write_text("x" * 1000)
    if days:
        age(store, name, days)
    return slot.ref


def age(store: Store, name: str, days: float) -> None:
    moment = time.time() - days * DAY_S
    os.utime(Path(store.root) / "artefacts" / f"{name}-v1-00", (moment, moment))


def names(removals: list[Removal]) -> list[str]:
    return [item.key.removesuffix("-v1-00") for item in removals]


def planned(store: Store, **policy: Any) -> list[str]:
    return names(planned_removals(store, Policy(**policy)).removed)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


@pytest.fixture
def chain(store: Store) -> Store:
    """ingest -> coarse -> report, and other settings of coarse, 40 to 10 days ago."""
    ingest = put(store, "ingest", days=40)
    coarse = put(store, "coarse", days=30, sequence=ingest)
    put(store, "other", days=20, sequence=ingest)
    put(store, "report", days=10, scene=coarse)
    return store


class TestAge:
    def test_what_kept_artefacts_were_made_from_stays(self, chain: Store) -> None:
        assert planned(chain, older_than_s=15 * DAY_S) == ["other"]
        assert planned(chain, older_than_s=15 * DAY_S, with_inputs=True) == ["coarse", "other", "ingest"]
        assert planned(chain, older_than_s=5 * DAY_S) == ["report", "coarse", "other", "ingest"]
        assert planned(chain, older_than_s=50 * DAY_S) == []

    def test_looking_up_and_opening_are_use(self, chain: Store) -> None:
        assert chain.find("other-v1-00") is not None
        assert planned(chain, older_than_s=5 * DAY_S) == ["report", "coarse"]

    def test_nothing_of_now_is_removed(self, store: Store) -> None:
        put(store, "ingest")
        assert planned(store, older_than_s=0.0, max_bytes=0, unreachable=True) == []
        assert names(planned_removals(store, Policy(max_bytes=0), now=time.time() + DAY_S).removed) == [
            "ingest"
        ]


class TestClockThatWasWrong:
    def test_what_was_used_in_the_future_is_not_kept_until_then(self, store: Store) -> None:
        put(store, "ingest", days=-400)
        # The clock of another machine may be ahead by so much.
        put(store, "other", days=-0.1)
        assert planned(store, max_bytes=0) == ["ingest"]
        assert names(apply_policy(store, Policy(max_bytes=0)).removed) == ["ingest"]

    def test_times_beyond_the_calendar(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        put(store, "ingest")
        monkeypatch.setattr(DirectoryBackend, "last_used", lambda *_: {"ingest-v1-00": 2.0**40})
        assert usage(store)[0].used == "9999-12-31T23:59:59+00:00"
        assert planned(store, older_than_s=0.0) == []


class TestSize:
    @pytest.mark.parametrize(
        ("most", "gone"),
        [
            (4000, []),
            (3999, ["other"]),
            (2000, ["report", "other"]),
            (1000, ["report", "coarse", "other"]),
            (0, ["report", "coarse", "other", "ingest"]),
        ],
    )
    def test_least_recently_used_first_and_never_from_below(
        self, chain: Store, most: int, gone: list[str]
    ) -> None:
        assert planned(chain, max_bytes=most) == gone


class TestRuns:
    @pytest.fixture
    def three(self, store: Store) -> Store:
        """Three runs of a sequence with other settings each, and one of another sequence."""
        ingest = put(store, "ingest", days=40)
        for index in range(3):
            final = put(store, f"final{index}", days=30 - index, sequence=ingest)
            judged = put(store, f"judged{index}", days=30 - index, scene=final)
            with recorded_run(store, "phantom/0") as record:
                assert record is not None
                record.add(Path(ref.uri).name for ref in (ingest, final))
                record.add([Path(judged.uri).name])
        elsewhere = put(store, "elsewhere", days=40, label="phantom/1")
        with recorded_run(store, "phantom/1") as record:
            assert record is not None
            record.add([Path(elsewhere.uri).name])
        return store

    def test_the_last_are_kept(self, three: Store) -> None:
        assert planned(three, keep_last=3) == []
        assert planned(three, keep_last=2) == ["judged0", "final0"]
        assert planned(three, keep_last=1) == ["judged0", "judged1", "final0", "final1"]

    def test_relative_names_of_several_places_are_several_sequences(self, store: Store) -> None:
        """Two groups share a store, and both call a folder of theirs `scan`."""
        for place in ("/a/scan", "/b/scan"):
            name = f"judged{place[1]}"
            put(store, name, days=30, label="scan")
            with recorded_run(store, "scan", place=place) as record:
                assert record is not None
                record.add([f"{name}-v1-00"])
        assert {run.place for run in runs_of(store)} == {"/a/scan", "/b/scan"}
        assert planned(store, keep_last=1) == []

    def test_the_same_run_again_counts_once_and_is_the_last(self, three: Store) -> None:
        assert len(runs_of(three)) == 4
        with recorded_run(three, "phantom/0") as record:
            assert record is not None
            record.add(["judged0-v1-00", "final0-v1-00", "ingest-v1-00"])
        assert len(runs_of(three)) == 4
        assert planned(three, keep_last=1) == ["judged1", "judged2", "final1", "final2"]

    def test_a_run_that_only_found_everything_is_the_last(self, three: Store) -> None:
        for name in ("ingest", "final0", "judged0"):
            age(three, name, -0.001)
        assert planned(three, keep_last=1) == ["judged1", "judged2", "final1", "final2"]

    def test_figures_that_no_run_looks_up_again_make_none_older(self, store: Store) -> None:
        """As metrics of earlier versions left them: these do not say which figures they were taken from."""
        for name, days in (("tried", 30), ("again", 20)):
            metrics = put(store, name, days=days)
            used = [Path(metrics.uri).name]
            if name == "tried":
                used.append(Path(put(store, "evaluate-views", days=days).uri).name)
            with recorded_run(store, "phantom/0") as record:
                assert record is not None
                record.add(used)
        age(store, "tried", -0.001)
        assert planned(store, keep_last=1) == ["again"]

    def test_a_run_without_the_figures_of_the_first_is_the_same_run(self, store: Store) -> None:
        figures = Path(put(store, "evaluate-views", days=30).uri).name
        for name, days in (("tried", 30), ("again", 20)):
            with store.slot(stage="evaluate", version=1, key=f"evaluate-v1-{name}"):
                pass
            moment = time.time() - days * DAY_S
            os.utime(Path(store.root) / "artefacts" / f"evaluate-v1-{name}", (moment, moment))
        for used in (["evaluate-v1-tried", figures], ["evaluate-v1-again"], ["evaluate-v1-tried"]):
            with recorded_run(store, "phantom/0") as record:
                assert record is not None
                record.add(used)
        assert len(runs_of(store)) == 3
        assert planned(store, keep_last=2) == ["evaluate-views"]
        assert planned(store, keep_last=1) == ["evaluate-v1-again", "evaluate-views"]

    def test_figures_of_views_stay_with_metrics_and_keep_no_other_scene(self, store: Store) -> None:
        """Of two scenes that were measured together, the metrics of one are those of a later run as well."""
        shared, other = put(store, "shared", days=9), put(store, "other", days=9)
        views = put(store, "evaluate-views", days=9, shared=shared, other=other)
        metrics = put(store, "metrics", days=1, renders=shared, views=views)
        with recorded_run(store, "phantom/0") as record:
            assert record is not None
            record.add(Path(ref.uri).name for ref in (shared, metrics))
        assert planned(store, older_than_s=5 * DAY_S) == ["other"]
        assert planned(store, unreachable=True) == ["other"]

    def test_a_run_that_ended_early_takes_the_place_of_none(self, store: Store) -> None:
        """A plan, or a failure, after a run to the end; then another run to the end."""
        for number, days in ((0, 30), (1, 20)):
            ingest = put(store, f"ingest{number}", days=days)
            figures = put(store, ("evaluate", "report")[number], days=days - 1, scene=ingest)
            with recorded_run(store, "phantom/0") as record:
                assert record is not None
                record.add(Path(ref.uri).name for ref in (ingest, figures))
            early = put(store, f"early{number}", days=days - 2, scene=ingest)
            with recorded_run(store, "phantom/0") as record:
                assert record is not None
                record.add(Path(ref.uri).name for ref in (ingest, early))
        assert set(planned(store, keep_last=1)) == {"ingest0", "evaluate", "early0"}
        assert planned(store, keep_last=2) == []

    def test_what_no_run_used_is_unreachable(self, three: Store) -> None:
        put(three, "tried", days=1)
        assert planned(three, unreachable=True) == ["tried"]
        gone = apply_policy(three, Policy(unreachable=True, keep_last=1)).removed
        assert sorted(names(gone)) == ["final0", "final1", "judged0", "judged1", "tried"]
        assert len(runs_of(three)) == 2

    def test_without_records_pages_stand_for_runs(self, chain: Store) -> None:
        assert planned(chain, unreachable=True) == ["other"]

    def test_what_a_run_in_progress_used_stays_however_old(self, chain: Store) -> None:
        with recorded_run(chain, "phantom/0") as record:
            assert record is not None
            record.add(["other-v1-00"])
            (run,) = active_runs(chain)
            assert run.keys == {"other-v1-00"}
            assert planned(chain, older_than_s=DAY_S, max_bytes=0) == ["report", "coarse"]
        assert active_runs(chain) == []
        assert planned(chain, max_bytes=0) == ["report", "coarse", "other", "ingest"]

    def test_a_killed_run_holds_nothing(self, chain: Store) -> None:
        code = (
            "import os, sys\nfrom extrags.store import Store\nfrom extrags.store.runs import RunRecord\n"
            "RunRecord(Store(sys.argv[1]), 'phantom/0', 'c0', '/p').add(['other-v1-00'])\n"
            "os.kill(os.getpid(), 9)"
        )
        assert subprocess.run([sys.executable, "-c", code, chain.root]).returncode == -9
        assert active_runs(chain) == []
        (run,) = runs_of(chain)
        assert run.keys == {"other-v1-00"}
        # The next run leaves one record of it, however often the same run was killed.
        assert len(file_killed(chain)) == 1
        assert file_killed(chain) == []
        assert list((chain.state / "runs" / "active").iterdir()) == []
        (filed,) = runs_of(chain)
        assert (filed.keys, filed.ended) == (run.keys, run.ended)
        assert (filed.config, filed.place) == (run.config, run.place) == ("c0", "/p")
        assert len(apply_policy(chain, Policy(older_than_s=DAY_S)).removed) == 4
        assert runs_of(chain) == []

    def test_damaged_records_are_left_out(self, three: Store) -> None:
        for path in (Path(three.root) / "records").glob("run-*.json"):
            path.write_text("[1")
        assert runs_of(three) == []

    def test_on_an_object_store(self, tmp_path: Path) -> None:
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path)
        final = put(store, "report", sequence=put(store, "ingest"))
        put(store, "other")
        with recorded_run(store, "phantom/0") as record:
            assert record is not None
            record.add(["ingest-v1-00", Path(final.uri).name])
        assert store.keys() == ["ingest-v1-00", "other-v1-00", "report-v1-00"]
        later = time.time() + DAY_S
        assert names(planned_removals(store, Policy(unreachable=True), now=later).removed) == ["other"]
        assert len(planned_removals(store, Policy(older_than_s=3600.0), now=later).removed) == 3
        remove_record(store, runs_of(store)[0].name)
        assert runs_of(store) == []

    def test_what_runs_go_on_to_use_on_an_object_store_stays(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Nothing there has a time of use: a night that finds everything is a use all the same."""
        store = Store(f"memory://{uuid.uuid4().hex}", cache=tmp_path)
        put(store, "report", sequence=put(store, "ingest"))
        put(store, "other")
        nights = time.time() + 100 * DAY_S
        with monkeypatch.context() as patched:
            told = datetime.datetime.fromtimestamp(nights, datetime.UTC).isoformat(timespec="microseconds")
            patched.setattr("extrags.store.runs._now", lambda: told)
            with recorded_run(store, "phantom/0") as record:
                assert record is not None
                record.add(["ingest-v1-00", "report-v1-00"])
        old = Policy(older_than_s=90 * DAY_S)
        assert names(planned_removals(store, old, now=nights + DAY_S).removed) == ["other"]
        assert len(planned_removals(store, old, now=nights + 91 * DAY_S).removed) == 3
        (row,) = usage(store)
        assert row.used == told[:19] + "+00:00"


class TestVersions:
    def test_what_earlier_versions_made_goes_and_what_later_ones_made_stays(self, chain: Store) -> None:
        assert planned(chain, versions={"report": 1, "elsewhere": 7}) == []
        assert planned(chain, versions={"report": 0, "other": 0}) == []
        (found,) = planned_removals(chain, Policy(versions={"report": 2})).removed
        assert (found.key, found.reason) == ("report-v1-00", "of version 1 of its stage, which is at 2")
        assert names(apply_policy(chain, Policy(versions={"report": 2})).removed) == ["report"]
        assert len(chain.keys()) == 3

    def test_what_a_kept_artefact_was_made_from_stays(self, chain: Store) -> None:
        assert planned(chain, versions={"ingest": 2, "coarse": 2, "other": 2}) == ["other"]
        assert planned(chain, versions={"coarse": 2}, with_inputs=True) == ["coarse"]
        assert planned(chain, versions={"coarse": 2, "report": 2}) == ["report", "coarse"]

    def test_what_a_run_in_progress_uses_stays(self, chain: Store) -> None:
        """It began before the program was replaced by a later one."""
        with recorded_run(chain, "phantom/0") as record:
            assert record is not None
            record.add(["other-v1-00"])
            assert apply_policy(chain, Policy(versions={"other": 2})).removed == []
        assert names(apply_policy(chain, Policy(versions={"other": 2})).removed) == ["other"]

    def test_what_was_used_a_moment_ago_stays(self, chain: Store) -> None:
        assert chain.find("other-v1-00") is not None
        assert planned(chain, versions={"other": 2}) == []


def test_nothing_is_removed_that_a_run_has_begun_to_use_since(
    chain: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    from extrags.store import retention

    whole = retention._planned

    def and_then_it_is_found(*given: Any) -> object:
        plan = whole(*given)
        chain.find("coarse-v1-00")
        return plan

    monkeypatch.setattr(retention, "_planned", and_then_it_is_found)
    assert names(apply_policy(chain, Policy(older_than_s=DAY_S)).removed) == ["report", "other"]
    assert chain.keys() == ["coarse-v1-00", "ingest-v1-00"]


def test_what_cannot_be_removed_hinders_no_other(chain: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = DirectoryBackend.discard

    def discard(backend: DirectoryBackend, key: str) -> bool:
        if key == "coarse-v1-00":
            raise StoreError(f"{key} cannot be removed: Permission denied")
        return usual(backend, key)

    monkeypatch.setattr(DirectoryBackend, "discard", discard)
    done = apply_policy(chain, Policy(older_than_s=0.0, with_inputs=True))
    assert names(done.removed) == ["report", "other"]
    assert {key: str(error) for key, error in done.refused.items()} == {
        "coarse-v1-00": "coarse-v1-00 cannot be removed: Permission denied"
    }
    # It stays with what it was made from.
    assert chain.keys() == ["coarse-v1-00", "ingest-v1-00"]


@pytest.mark.parametrize("unreadable", [False, True])
def test_a_manifest_that_cannot_be_read_hinders_no_other(
    chain: Store, unreadable: bool, caplog: pytest.LogCaptureFixture
) -> None:
    manifest = Path(chain.root) / "artefacts" / "other-v1-00" / "manifest.json"
    manifest.unlink()
    if unreadable:
        manifest.mkdir()
    else:
        manifest.write_text("{")
    assert planned(chain, older_than_s=15 * DAY_S) == []
    done = apply_policy(chain, Policy(older_than_s=5 * DAY_S))
    assert (names(done.removed), done.skipped) == (["report", "coarse", "ingest"], ["other-v1-00"])
    assert "other-v1-00 is skipped: " in caplog.text
    assert [row.artefacts for row in usage(chain)] == []


def test_usage(chain: Store) -> None:
    put(chain, "coarse1", label="phantom/1")
    first, second = usage(chain)
    assert (first.sequence, first.artefacts, first.files, first.bytes) == ("phantom/0", 4, 8, 4000)
    assert (second.sequence, second.artefacts) == ("phantom/1", 1)
    assert first.used < second.used
    assert first.made


@pytest.mark.parametrize("unwritable", [lambda path: path.write_text("")])
def test_a_store_that_cannot_be_written_is_only_read(
    store: Store, unwritable: Callable[[Path], None]
) -> None:
    put(store, "ingest")
    unwritable(Path(store.root) / "runs")
    with recorded_run(store, "phantom/0") as record:
        assert record is None


@pytest.mark.parametrize("when", ["at the beginning", "at the end"])
def test_a_run_that_cannot_be_recorded_holds_no_lock(
    store: Store, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = len(os.listdir("/proc/self/fd"))
    with monkeypatch.context() as patched:
        if when == "at the beginning":
            patched.setattr(os, "pwrite", full)
        else:
            patched.setattr("extrags.store.runs.write_record", full)
        with recorded_run(store, "phantom/0") as record:
            assert (record is None) == (when == "at the beginning")
            if record is not None:
                record.add(["toy-v1-x"])
    assert active_runs(store) == []
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_disk_that_is_full_in_the_middle_ends_no_run_and_keeps_the_record(
    store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    usual, full_from = os.pwrite, len(store.root) + 200

    def nearly_full(file: int, text: bytes, offset: int) -> int:
        if offset >= full_from:
            raise OSError(errno.ENOSPC, "No space left on device")
        return usual(file, text[: full_from - offset], offset)

    monkeypatch.setattr(os, "pwrite", nearly_full)
    with recorded_run(store, "phantom/0") as record:
        assert record is not None
        record.add(["ingest-v1-00"])
        record.add(f"coarse-v1-{number:032d}" for number in range(20))
        (run,) = active_runs(store)
        assert run.keys == {"ingest-v1-00"}
        assert "could not be written: No space left on device" in caplog.text
    (ended,) = runs_of(store)
    assert len(ended.keys) == 21


def test_a_record_that_is_half_written_is_read_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    with recorded_run(store, "phantom/0") as record:
        assert record is not None
        record.add(["ingest-v1-00"])
        (path,) = (store.state / "runs" / "active").iterdir()
        whole = path.read_bytes()
        path.write_bytes(whole[:-9])
        monkeypatch.setattr("time.sleep", lambda _: path.write_bytes(whole))
        (run,) = active_runs(store)
        assert run.keys == {"ingest-v1-00"}


@pytest.mark.parametrize(
    ("content", "days", "held", "kept"),
    [
        ('{"sequence": ', 31, False, False),
        ("", 31, False, False),
        ("", 29, False, True),
        ("", 31, True, True),
        ('{"sequence": "a", "ended": "2026-01-01", "keys": []}', 31, False, True),
    ],
)
def test_records_of_runs_that_nobody_can_read_go_when_they_are_old(
    content: str,
    days: float,
    held: bool,
    kept: bool,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("time.sleep", lambda _: None)
    caplog.set_level("INFO")
    path = store.state / "runs" / "active" / "0123.json"
    path.parent.mkdir(parents=True)
    path.write_text(content)
    os.utime(path, (time.time() - days * DAY_S,) * 2)
    with path.open() as file:
        if held:
            fcntl.flock(file, fcntl.LOCK_EX)
        found = sweep_unreadable(store, dry_run=True)
        assert path.exists()
        assert sweep_unreadable(store) == found == ([] if kept else ["runs/active/0123.json"])
    assert path.exists() is kept
    assert ("cannot be read and is old: it is removed" in caplog.text) is not kept


def test_a_record_that_may_not_be_read_stops_nobody(
    store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = store.state / "runs" / "active" / "0123.json"
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    usual = os.open

    def opened(place: Path, *given: int, **more: int) -> int:
        if place == path:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return usual(place, *given, **more)

    monkeypatch.setattr(os, "open", opened)
    assert (active_runs(store), runs_of(store), file_killed(store)) == ([], [], [])
    assert "what it uses, cannot be read: Permission denied" in caplog.text


def test_a_record_is_plain_json(store: Store) -> None:
    with recorded_run(store, "phantom/0") as record:
        assert record is not None
        record.add(["ingest-v1-00"])
    (path,) = (Path(store.root) / "records").glob("run-*.json")
    read = json.loads(path.read_text())
    assert read["keys"] == ["ingest-v1-00"]
    assert read["sequence"] == "phantom/0"
