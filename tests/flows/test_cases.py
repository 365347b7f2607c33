"""The runs of a dataset: the matrix, what the store tells of the last runs, and how long they will take."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from data_catalog.folders import FolderDataset
from extrags.errors import ConfigError
from extrags.run_costs import Workload
from extrags.stages import StageName
from extrags.store import Store, read_records, write_record
from extrags.store.records import remove_record
from extrags.store.runs import recorded_run
from flows.cases import SequenceCase, cases_of, matrix_points, record_outcome, selected
from flows.cli import main
from flows.commands.run_checks import check_names
from flows.dataset import reconstruct_dataset
from flows.estimate import expected_seconds
from flows.expectation import Expectation, expectations, expected_words, longest_first
from flows.outcome import DatasetFailedError, SequenceOutcome, StageRow
from flows.outcome_records import outcome_records
from flows.selection import Chosen
from flows.store_status import store_status
from flows.workloads import expected_work
from tests.flows.tiny import SEQUENCE, TINY


def case(sequence: str = SEQUENCE, **more: Any) -> SequenceCase:
    return SequenceCase(sequence, profile="quick", settings=TINY, **more)


def leave(store: str, of: SequenceCase, *stages: StageRow, status: Any = "ok", until: Any = "coarse") -> None:
    """Leave the record of a run."""
    outcome = SequenceOutcome(of.sequence, status, list(stages))
    record_outcome(Store(store), of, outcome, until, of.config())


def leave_read(store: str, of: SequenceCase, work: Workload, *more: StageRow) -> None:
    """Leave the record of a run that read frames and estimated their poses, each in 100 seconds."""
    rows = [StageRow(stage, "ran", made_seconds=100.0) for stage in ("ingest", "poses")]
    leave(store, of, *rows, *more, until="depth" if more else "poses")
    (record,) = read_records(Store(store), of.record).values()
    expected = expected_seconds(of.config(), work)
    for row in record["stages"]:
        row["expected_cpu_s"] = sum(expected[row["stage"]].values())
    write_record(Store(store), of.record, {**record, "size": work.size})


def with_frames(folder: Path, number: int = 9) -> Path:
    """A folder with so many frames."""
    folder.mkdir(exist_ok=True)
    for frame in range(number):
        Image.new("RGB", (60, 50), (90, 60, 50)).save(folder / f"{frame:03d}.png")
    return folder


def test_a_run_of_an_imported_scene_stands_beside_the_sequence_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    own, imported = case(), SequenceCase(SEQUENCE, profile="quick", settings={"imported.scene": "their.ply"})
    assert own.record != imported.record
    assert own.record == SequenceCase(SEQUENCE, profile="quick").record
    assert imported.distinguishing == {"imported.scene": str(tmp_path / "their.ply")}


def test_one_imported_scene_is_one_run_however_its_file_is_spelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings, file = {**TINY, "imported.scene": "their.ply"}, str(tmp_path / "their.ply")
    relative = SequenceCase(SEQUENCE, profile="quick", settings=settings)
    full = replace(relative, settings={**settings, "imported.scene": file})
    varied = replace(relative, settings=TINY, changed={"imported.scene": "./their.ply"})
    assert relative.record == full.record == varied.record
    # Its page as well, which shows all settings.
    assert relative.config() == full.config() == varied.config()
    assert full.former_record == full.record
    # What earlier versions left under the path as it was written goes.
    store = Store(tmp_path / "store")
    leave(store.root, full, StageRow("report", "ran"), until="report")
    (record,) = outcome_records(store).values()
    remove_record(store, full.record)
    write_record(store, relative.former_record, {**record, "variant": {"imported.scene": "their.ply"}})
    leave(store.root, relative, StageRow("report", "ran"), until="report")
    assert list(outcome_records(store)) == [full.record]


class TestPaths:
    def test_relative_ones_of_several_places_are_several_sequences(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = str(tmp_path / "store")
        for place in ("a", "b"):
            (tmp_path / place / "frames").mkdir(parents=True)
        monkeypatch.chdir(tmp_path / "a")
        first = case("frames")
        record = first.record
        assert record == case(str(tmp_path / "a" / "frames")).record == case("../a/frames").record
        leave(store, first, StageRow("ingest", "failed"), status="failed", until="report")
        assert selected([first], "failed", store, "report") == [first]
        (shown,) = store_status(Store(store)).rows
        assert shown.sequence == "frames"

        monkeypatch.chdir(tmp_path / "b")
        second = case("frames")
        assert second.record != record
        assert selected([second], "failed", store, "report") == []
        leave(store, second, StageRow("ingest", "failed"), status="failed", until="report")
        both = [str(tmp_path / place / "frames") for place in ("a", "b")]
        assert [row.sequence for row in store_status(Store(store)).rows] == both
        # By either spelling, from anywhere.
        for asked in ("frames", both[1]):
            (shown,) = store_status(Store(store), [asked]).rows
            assert (shown.sequence, shown.state) == (both[1], "failed")
        # Which of them is in work nothing tells; it is no third one.
        with recorded_run(Store(store), "frames"):
            assert [row.sequence for row in store_status(Store(store)).rows] == both

    def test_records_of_earlier_versions_count_until_they_are_replaced(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "frames").mkdir()
        monkeypatch.chdir(tmp_path)
        own, root = case("frames"), str(tmp_path / "store")
        store = Store(root)
        leave(root, own, StageRow("report", "ran"), until="report")
        (finished,) = outcome_records(store).values()
        remove_record(store, own.record)
        former = {name: value for name, value in finished.items() if name != "path"}
        write_record(store, own.former_record, former)
        # A plan has no figures to put in the place of those of a finished run.
        leave(root, own, StageRow("assess", "ran"), until="assess")
        assert outcome_records(store) == {own.former_record: former}
        write_record(store, own.former_record, {**former, "status": "failed"})
        assert selected([own], "failed", root, "report") == [own]
        assert selected([own], "missing", root, "report") == []
        leave(root, own, StageRow("report", "ran"), until="report")
        assert list(outcome_records(store)) == [own.record]

    def test_names_of_the_catalogue_are_what_they_were(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        record = case().record
        monkeypatch.chdir(tmp_path)
        assert case().record == case().former_record == record


class TestMatrix:
    def test_every_combination(self) -> None:
        points = matrix_points({"coarse.iterations": [500, 1000], "coarse.seed": [0, 1]})
        assert len(points) == 4
        assert points[1] == {"coarse.iterations": 500, "coarse.seed": 1}
        assert matrix_points(None) == [{}]

    def test_sequences_times_methods_times_seeds_times_settings(self) -> None:
        found = cases_of(
            [Chosen("phantom/0@sparse"), Chosen("phantom/1@sparse", {"ingest.max_frames": 10})],
            methods=["3dgs", "extrags"],
            profile="quick",
            seeds=[0, 1],
            settings={"coarse.sh_degree": 1},
            matrix={"coarse.iterations": [500, 1000]},
        )
        assert len(found) == 2 * 2 * 2 * 2
        assert len({item.record for item in found}) == len({item.title for item in found}) == 16
        assert found[0].title == "phantom/0@sparse [3dgs, seed 0, coarse.iterations = 500]"
        # What plain 3DGS sets itself is not overridden, as in a benchmark.
        assert [item.config().coarse.sh_degree for item in (found[0], found[4])] == [3, 1]
        assert found[-1].config().ingest.max_frames == 10
        assert found[-1].config().coarse.seed == 1

    @pytest.mark.parametrize(
        ("more", "message"),
        [
            ({"matrix": {"coarse.iterations": [5, 5]}}, "different values of coarse.iterations"),
            ({"matrix": {"coarse.iterations": [0]}}, "coarse.iterations = 0.*at least 1"),
            ({"matrix": {"coarse.sh_degree": [1]}, "methods": ["3dgs"]}, "sets coarse.sh_degree itself"),
            ({"methods": ["3dgs", "3dgs"]}, "different methods"),
            ({"seeds": [1, 1]}, "different seeds"),
            ({"settings": {"coarse.iteration": 1}}, "did you mean coarse.iterations"),
            ({"settings": {"coarse.train_on": "all"}, "methods": ["3dgs", "coarse"]}, "train_on"),
        ],
    )
    def test_wrong_ones_are_refused(self, more: dict[str, Any], message: str) -> None:
        given: dict[str, Any] = {"methods": ["coarse"], "seeds": [None], "settings": {}, **more}
        with pytest.raises(ConfigError, match=message):
            cases_of([Chosen(SEQUENCE)], profile="quick", **given)

    def test_on_the_command_line(self) -> None:
        from flows.commands.run import parsed_matrix, parsed_methods

        assert parsed_matrix(["coarse.iterations=500,1000", "enhance.channels=[8,8,16],[16,16,32]"]) == {
            "coarse.iterations": [500, 1000],
            "enhance.channels": [(8, 8, 16), (16, 16, 32)],
        }
        assert parsed_methods(["3dgs,coarse", "extrags"], "coarse") == ["3dgs", "coarse", "extrags"]
        assert parsed_methods([], "coarse") == ["coarse"]
        for wrong in ("coarse.iterations", "coarse.iteration=5", "coarse.iterations=x"):
            with pytest.raises(ConfigError):
                parsed_matrix([wrong])


class TestOnly:
    def test_failed_missing_and_changed(self, finished: tuple[str, SequenceOutcome], tmp_path: Path) -> None:
        shutil.copytree(Path(finished[0]) / "artefacts", tmp_path / "store" / "artefacts")
        store = str(tmp_path / "store")
        done, broken, new = case(), case("phantom/1@sparse"), case("phantom/2@sparse")
        leave(store, done)
        leave(store, broken, StageRow("ingest", "failed", reason="no"), status="failed")
        cases = [done, broken, new]
        assert selected(cases, None, store, "coarse") == cases
        assert selected(cases, "failed", store, "coarse") == [broken]
        assert selected(cases, "missing", store, "coarse") == [new]
        assert selected(cases, "changed", store, "coarse") == [broken, new]
        # With other settings all would be made, and what failed is still the same run.
        other = [SequenceCase(item.sequence, profile="quick", settings={}) for item in cases]
        assert selected(other, "changed", store, "coarse") == other
        assert selected(other, "failed", store, "coarse") == [other[1]]
        # What is taken away is to be made.
        Store(store).rm("coarse*")
        assert selected(cases, "changed", store, "coarse") == cases

    def test_a_plan_leaves_the_record_of_a_finished_run(self, tmp_path: Path) -> None:
        store, of = str(tmp_path), case()
        leave(store, of, StageRow("evaluate", "ran"), until="report")
        leave(store, of, until="assess")
        (record,) = outcome_records(Store(store)).values()
        assert record["until"] == "report"
        leave(store, of, StageRow("coarse", "failed", reason="no"), status="failed", until="assess")
        (record,) = outcome_records(Store(store)).values()
        assert (record["until"], record["status"]) == ("assess", "failed")
        leave(store, of, until="report")
        (record,) = outcome_records(Store(store)).values()
        assert (record["until"], record["status"]) == ("report", "ok")

    def test_who_was_only_planned_is_missing(self, tmp_path: Path) -> None:
        store, of = str(tmp_path), case("phantom/1@sparse")
        leave(store, of, until="assess")
        assert selected([of], "missing", store, "assess") == []
        assert selected([of], "missing", store, "report") == [of]

    def test_a_matrix_keeps_its_runs_apart(self, tmp_path: Path) -> None:
        store = str(tmp_path)
        points = [case(changed={"coarse.iterations": number}) for number in (60, 90)]
        leave(store, points[1], StageRow("coarse", "failed"), status="failed")
        assert selected(points, "failed", store, "coarse") == [points[1]]


class TestExpected:
    def test_by_frames_where_nothing_was_measured(self, tmp_path: Path) -> None:
        few, many = case("phantom/0@sparse"), SequenceCase("c3vdv2/c1_cecum_t1@sparse", profile="quick")
        found = expectations([few, many], str(tmp_path), "coarse")
        assert not any(item.measured for item in found)
        assert 0 < found[0].seconds < found[1].seconds
        assert [item.case for item in longest_first(found)] == [many, few]

    def test_as_measured_in_proportion_to_what_is_expected(self, tmp_path: Path) -> None:
        store, before = str(tmp_path), case()
        leave(
            store,
            before,
            StageRow("ingest", "ran", made_seconds=2.0),
            StageRow("poses", "skipped"),
            StageRow("depth", "skipped"),
            StageRow("coarse", "ran", made_seconds=10.0, made={"coarse-v1-x": 3}),
        )
        twice = SequenceCase(SEQUENCE, profile="quick", settings={**TINY, "coarse.iterations": 240})
        (same,) = expectations([before], store, "coarse", refresh=True)
        (found,) = expectations([twice], store, "coarse")
        assert same.measured
        assert same.seconds == pytest.approx(12.0)
        # Twice the iterations take about twice the time: part does not depend on them, and Gaussians grow.
        assert 18.0 < found.seconds < 26.0
        # Another sequence: by its frames, at the pace of those that were measured.
        (other,) = expectations([case("phantom/1@sparse")], store, "coarse")
        assert not other.measured
        # What the record names is not in the store: it would be made.
        assert expectations([before], store, "coarse")[0].seconds == pytest.approx(12.0)

    def test_what_is_in_the_store_takes_no_time(self, tmp_path: Path) -> None:
        store = str(tmp_path)
        leave(store, case(), StageRow("ingest", "ran", made_seconds=2.0))
        assert expectations([case()], store, "coarse")[0].seconds == 0
        assert expectations([case()], store, "coarse", refresh=True)[0].seconds > 2.0
        assert expectations([case()], store, "finetune")[0].seconds > 0

    def test_what_the_source_spares_is_spared_after_a_failure_too(self, tmp_path: Path) -> None:
        """But not what was skipped because a stage before it had failed."""
        store, folder = str(tmp_path / "store"), case(str(tmp_path))
        read = StageRow("ingest", "ran", made_seconds=2.0)
        spared = [StageRow("poses", "skipped"), StageRow("depth", "skipped")]
        left = [StageRow("coarse", "failed"), StageRow("assess", "skipped"), StageRow("surface", "skipped")]
        leave(store, folder, read, *spared, *left, status="failed")
        (found,) = expectations([folder], store, "surface")
        leave(store, folder, read, *left, status="failed")
        (with_depth,) = expectations([folder], store, "surface")
        leave(store, folder, read, *spared, StageRow("coarse", "failed"), status="failed")
        (same,) = expectations([folder], store, "surface")
        assert found.seconds == same.seconds < with_depth.seconds

    def test_what_another_method_does_without_is_no_part_of_its_time(self, tmp_path: Path) -> None:
        own, plain = (
            SequenceCase(str(with_frames(tmp_path / "frames")), method=method, profile="quick")
            for method in ("extrags", "3dgs")
        )

        def seconds(of: SequenceCase, store: str, until: StageName) -> float:
            return expectations([of], str(tmp_path / store), until, refresh=True)[0].seconds

        work = expected_work(own.sequence, own.config())
        assert work is not None
        leave_read(str(tmp_path / "one"), own, work, StageRow("depth", "ran", made_seconds=100.0))
        assert seconds(own, "one", "depth") == pytest.approx(300.0)
        assert seconds(plain, "one", "depth") == pytest.approx(200.0)
        # Nor does what that skips for its settings say that this one does.
        leave_read(str(tmp_path / "other"), plain, work, StageRow("depth", "skipped"))
        assert seconds(own, "other", "depth") > seconds(own, "other", "poses")

    def test_a_preview_tells_the_pace_and_not_the_time_of_a_whole_run(self, tmp_path: Path) -> None:
        store, folder = str(tmp_path / "store"), with_frames(tmp_path / "frames", 40)
        few, all_of_them = (
            SequenceCase(str(folder), profile="quick", settings={**TINY, "ingest.max_frames": number})
            for number in (4, 40)
        )
        work = expected_work(few.sequence, few.config())
        assert work is not None
        leave_read(store, few, work)
        (again,) = expectations([few], store, "poses", refresh=True)
        assert again.measured
        assert again.seconds == pytest.approx(200.0)
        (whole,) = expectations([all_of_them], store, "poses")
        assert not whole.measured
        assert whole.seconds > 2 * again.seconds
        assert expected_words([whole]).endswith("; by their frames")

    def test_a_run_with_the_same_settings_tells_the_size_of_frames(self, tmp_path: Path) -> None:
        """Names and headers tell at most how many frames there will be."""
        store, folder = str(tmp_path / "store"), with_frames(tmp_path / "frames", 20)
        leave_read(store, case(str(folder)), Workload(1000, 12, 10, 2, case().config(), width=40))
        (found,) = expectations([case(str(folder))], store, "poses", refresh=True)
        assert found.measured
        assert found.seconds == pytest.approx(200.0)
        # What cannot be looked at is taken to be what it was.
        shutil.rmtree(folder)
        larger = SequenceCase(str(folder), profile="quick", settings={**TINY, "ingest.width": 60})
        (gone,) = expectations([larger], store, "poses")
        assert gone.sized
        assert gone.seconds == pytest.approx(200.0)

    def test_a_path_is_measured_in_any_spelling(self, tmp_path: Path) -> None:
        store = str(tmp_path / "store")
        leave(store, case(f"{tmp_path}/colon/"), StageRow("ingest", "ran", made_seconds=2.0))
        assert expectations([case(f"{tmp_path}/colon")], store, "coarse")[0].measured
        assert not expectations([case(f"{tmp_path}/col")], store, "coarse")[0].measured

    def test_in_words(self) -> None:
        found = [Expectation(case(), 3600.0, measured=True), Expectation(case(), 600.0, measured=False)]
        assert (
            expected_words(found) == "2 runs, about 70 min; 1 as measured in earlier runs, 1 by their frames"
        )
        # In one process they share its cores, in two each has its own.
        assert expected_words(found, 2).startswith("2 runs, about 70 min; 2 at once")
        assert expected_words(found, 2, processes=True).startswith("2 runs, about 60 min; 2 at once")
        assert expected_words(found[:1]) == "1 run, about 60 min; as measured in earlier runs"
        assert expected_words(found[1:]) == "1 run, about 10 min; by their frames"

    def test_a_disk_that_is_gone_stops_no_other_sequence(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def gone(*_: object) -> None:
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(tmp_path))

        monkeypatch.setattr(FolderDataset, "resolve", gone)
        check_names([str(tmp_path), SEQUENCE])
        (found,) = expectations([case(str(tmp_path))], str(tmp_path / "store"), "report")
        assert not found.sized
        assert expected_work(str(tmp_path), case().config()) is None

    def test_a_folder_that_was_not_read_is_taken_for_a_phantom(self, tmp_path: Path) -> None:
        (found,) = expectations([case(str(tmp_path))], str(tmp_path / "store"), "coarse")
        assert not found.sized
        assert expected_words([found]).endswith("; as a phantom of 48 frames, not being read yet")


@pytest.mark.usefixtures("prefect_server")
class TestFlow:
    def test_a_matrix_over_a_manifest_then_what_failed(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "empty").mkdir()
        (tmp_path / "night.txt").write_text(f"phantom/[0]@sparse\n{tmp_path / 'empty'}  # nothing in it\n")
        store = str(tmp_path / "store")
        given: dict[str, Any] = {
            "sequences": [f"@{tmp_path / 'night.txt'}"],
            "profile": "quick",
            "settings": {**TINY, "ingest.max_frames": 8},
            "matrix": {"coarse.iterations": [20, 30]},
            "method": "coarse",
            "until": "coarse",
            "store": store,
        }
        found = reconstruct_dataset(**given, at_once=2)
        assert [(item.title, item.status) for item in found.sequences] == [
            ("phantom/0@sparse [coarse.iterations = 20]", "ok"),
            ("phantom/0@sparse [coarse.iterations = 30]", "ok"),
            (f"{tmp_path / 'empty'} [coarse.iterations = 20]", "failed"),
            (f"{tmp_path / 'empty'} [coarse.iterations = 30]", "failed"),
        ]
        with pytest.raises(DatasetFailedError) as failed:
            reconstruct_dataset(**given, only="failed")
        assert len(failed.value.outcome.sequences) == 2
        assert reconstruct_dataset(**given, only="missing").sequences == []
        status = store_status(Store(store))
        assert status.counts == {"done": 2, "failed": 2}
        assert len(outcome_records(Store(store))) == 4
        assert main(["status", "--store", store]) == 1
        said = capsys.readouterr().out
        assert "the folder is empty" in said
        assert "4 runs: " in said
