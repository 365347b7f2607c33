"""The command line on a store: verbs that need no run, and those that keep it tidy."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from extrags.errors import StoreError
from extrags.store import Store
from extrags.store.runs import runs_of
from flows.cases import SequenceCase, record_outcome
from flows.cli import main
from flows.environment import prepare
from flows.outcome import SequenceOutcome, StageRow
from flows.outcome_records import outcome_records
from flows.run_costs import RunPrediction
from tests.documented_json import undocumented
from tests.flows.tiny import SEQUENCE, TINY, settled

pytestmark = pytest.mark.usefixtures("untouched_environment")


def no_home(store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect's home can not be made in a store, as in one of another user that runs on a server filled."""
    usual = Path.mkdir

    def refused(path: Path, *given: Any, **more: Any) -> None:
        if path == Path(store) / "prefect":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        usual(path, *given, **more)

    for name in ("PREFECT_HOME", "PREFECT_API_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "mkdir", refused)


class TestFinished:
    """Verbs on a store in which everything is there: no server is needed."""

    def test_run_is_all_cached(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, first = finished
        target = tmp_path / "deep" / "results.json"
        assert main(["run", SEQUENCE, *settled(store), "--json", str(target), "--until", "evaluate"]) == 0
        results = json.loads(target.read_text())
        assert not undocumented(results, "run")
        (sequence,) = results["sequences"]
        assert sequence["name"] == SEQUENCE
        assert sequence["status"] == "ok"
        assert {stage["state"] for stage in sequence["stages"]} == {"cached", "skipped"}
        assert sequence["metrics"] == first.metrics
        assert "9 cached, 2 skipped" in capsys.readouterr().err

    def test_it_is_left_on_record(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        shutil.copytree(Path(finished[0]) / "artefacts", tmp_path / "store" / "artefacts")
        store = Store(tmp_path / "store")
        case = SequenceCase(SEQUENCE, profile="quick", settings=TINY)
        failure = SequenceOutcome(SEQUENCE, "failed", [StageRow("ingest", "failed", reason="no")])
        record_outcome(store, case, failure, "coarse", case.config())
        assert main(["status", "--store", store.root]) == 1
        arguments = ["run", SEQUENCE, *settled(store.root), "--until", "coarse"]
        assert main([*arguments, "--only", "failed"]) == 0
        assert main(["status", "--store", store.root]) == 0
        (record,) = outcome_records(store).values()
        assert (record["status"], record["until"]) == ("ok", "coarse")
        capsys.readouterr()
        assert main([*arguments, "--only", "failed"]) == 0
        assert "no sequence is failed" in capsys.readouterr().err
        # What it used is kept with it; the same run again replaces both records.
        (used,) = runs_of(store)
        assert used.keys == {key for row in record["stages"] for key in row["artefacts"]}
        assert main(arguments) == 0
        (again,) = runs_of(store)
        assert (again.name, again.keys) == (used.name, used.keys)
        assert again.ended > used.ended

    def test_a_store_that_takes_no_record_is_read_all_the_same(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        shutil.copytree(Path(finished[0]) / "artefacts", tmp_path / "store" / "artefacts")
        for name in ("records", "runs"):
            (tmp_path / "store" / name).write_text("")
        arguments = ["run", SEQUENCE, *settled(str(tmp_path / "store")), "--until", "coarse"]
        assert main(arguments) == 0

    def test_quiet_says_nothing_where_all_is_well(
        self, finished: tuple[str, SequenceOutcome], capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["run", SEQUENCE, *settled(finished[0]), "--until", "evaluate", "--quiet"]) == 0
        assert capsys.readouterr() == ("", "")

    def test_plan_says_why(
        self, finished: tuple[str, SequenceOutcome], capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, _ = finished
        assert main(["plan", SEQUENCE, *settled(store)]) == 0
        said = capsys.readouterr().out
        assert "explore" in said
        assert "holes and unresolved surface are" in said
        assert "saves s" in said
        assert "without the plan" in " ".join(said.split())
        measured = said.split("measured")[1].splitlines()
        depth = next(line for line in measured if "Median depth of the training views" in line)
        assert depth.rstrip().endswith(" mm")
        assert not any("e+0" in line or "_" in line for line in measured)

    def test_plan_as_json(
        self, finished: tuple[str, SequenceOutcome], capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, _ = finished
        assert main(["plan", SEQUENCE, *settled(store), "--json", "-"]) == 0
        plan = json.loads(capsys.readouterr().out)
        assert not undocumented(plan, "plan")
        assert plan["sequence"] == SEQUENCE
        assert {line["stage"] for line in plan["decisions"]} >= {"explore", "enhance", "finetune"}
        assert all(line["saves_s"] is not None for line in plan["decisions"])
        assert plan["without_plan"]["processor_seconds"] >= plan["predicted"]["processor_seconds"] > 0
        assert main(["plan", SEQUENCE, *settled(store), "--before", "--json", "-"]) == 0
        before = json.loads(capsys.readouterr().out)
        assert not undocumented(before, "plan")
        assert set(before) == {"sequence", "predicted"}

    def test_report_is_built_again(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, _ = finished
        page = tmp_path / "new" / "page.html"
        assert main(["report", SEQUENCE, *settled(store), "-o", str(page)]) == 0
        assert capsys.readouterr().out.strip() == str(page)
        assert "</html>" in page.read_text()

    def test_report_keeps_the_times_of_the_run(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        from tasks.report import ROWS

        store, page = Store(finished[0]), tmp_path / "page.html"
        given = ["report", SEQUENCE, *settled(store.root), "-o", str(page)]
        assert main(given) == 0
        ref = finished[1].refs["report"]
        rows = store.load_json(ROWS, ref)
        assert {row["state"] for row in rows} == {"ran", "skipped"}
        assert "came from the cache" not in page.read_text()
        # Of a page that is gone, what its stages took when they ran.
        store.rm("report-v*")
        assert main(given) == 0
        again = store.load_json(ROWS, ref)
        assert {row["stage"]: row["state"] for row in again} == {row["stage"]: row["state"] for row in rows}
        assert all(row["seconds"] == row["made_seconds"] for row in again if row["state"] == "ran")

    @pytest.mark.parametrize(
        "error",
        [
            KeyboardInterrupt(),
            pytest.param(OSError(errno.ENOSPC, "No space left on device"), marks=pytest.mark.slow),
        ],
    )
    def test_a_page_stays_where_making_it_again_does_not_end(
        self,
        error: BaseException,
        finished: tuple[str, SequenceOutcome],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        import extrags.report.build

        store, ref = Store(finished[0]), finished[1].refs["report"]
        page = store.open(ref) / "report.html"
        before = page.read_bytes()

        def fail(*_: object) -> None:
            raise error

        with monkeypatch.context() as patched:
            patched.setattr(extrags.report.build, "build_pages", fail)
            if isinstance(error, KeyboardInterrupt):
                with pytest.raises(KeyboardInterrupt):
                    main(["report", SEQUENCE, *settled(store.root)])
            else:
                assert main(["report", SEQUENCE, *settled(store.root)]) == 1
        assert store.find(store.manifest(ref).key) == ref
        assert page.read_bytes() == before
        # One that is finished takes its place, with other words too.
        build = extrags.report.build.build_pages
        monkeypatch.setattr(
            extrags.report.build,
            "build_pages",
            lambda *given: (build(*given)[0] + "<!-- anew -->", build(*given)[1]),
        )
        assert main(["report", SEQUENCE, *settled(store.root)]) == 0
        assert page.read_text().endswith("<!-- anew -->")
        assert not list(store.backend.scratch.iterdir())

    def test_a_report_of_a_store_that_cannot_be_written(
        self,
        finished: tuple[str, SequenceOutcome],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        from extrags.store.directory import DirectoryBackend

        def refuse(*_: object, **__: object) -> None:
            raise StoreError("the store cannot be written: Read-only file system")

        page = tmp_path / "page.html"
        no_home(finished[0], monkeypatch)
        monkeypatch.setattr(DirectoryBackend, "check_writable", refuse)
        monkeypatch.setattr("extrags.store.artefacts.private_directory", refuse)
        assert main(["report", SEQUENCE, *settled(finished[0]), "-o", str(page)]) == 0
        assert capsys.readouterr().out.strip() == str(page)
        assert "</html>" in page.read_text()
        assert "came from the cache" not in page.read_text()
        assert main(["report", SEQUENCE, *settled(finished[0])]) == 1
        assert "Read-only file system" in capsys.readouterr().err

    def test_a_run_that_is_finished_in_a_store_that_cannot_be_written(
        self,
        finished: tuple[str, SequenceOutcome],
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        no_home(finished[0], monkeypatch)
        assert main(["run", SEQUENCE, *settled(finished[0]), "--until", "evaluate"]) == 0
        assert "9 cached, 2 skipped" in capsys.readouterr().err
        monkeypatch.delenv("PREFECT_HOME")
        with pytest.raises(StoreError, match="cannot be written: Read-only file system"):
            prepare(Store(finished[0]).state)

    @pytest.mark.parametrize("scene", ["coarse", "final"])
    def test_export_writes_ply(
        self,
        finished: tuple[str, SequenceOutcome],
        tmp_path: Path,
        scene: str,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        from extrags.gaussians import Gaussians

        store, first = finished
        target = tmp_path / "scene.ply"
        assert main(["export", SEQUENCE, *settled(store), "--scene", scene, "-o", str(target)]) == 0
        assert len(Gaussians.read_ply(target)) == first.metrics[scene]["n_gaussians"]
        assert "Gaussians" in capsys.readouterr().out

    @pytest.mark.parametrize("verb", [["run"], ["evaluate", "--renders", "renders"]])
    def test_a_misspelled_name_leaves_no_store(
        self,
        verb: list[str],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        for name in ("PREFECT_HOME", "PREFECT_API_URL"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.chdir(tmp_path)
        assert main([*verb, "nosuch/0"]) == 2
        assert "no sequence 'nosuch/0'" in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("verb", ["report", "export"])
    def test_what_is_not_there_is_said(
        self, verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        more = ["-o", str(tmp_path / "x.ply")]
        (tmp_path / "store").mkdir()
        assert main([verb, SEQUENCE, *settled(str(tmp_path / "store")), *more]) == 1
        assert "run it first" in capsys.readouterr().err

    @pytest.mark.parametrize(
        "arguments",
        [
            ["report", SEQUENCE],
            ["export", SEQUENCE, "--output", "x.ply"],
            ["evaluate", SEQUENCE],
            ["compare", SEQUENCE],
            ["gallery"],
            ["leaderboard"],
            ["status"],
            ["cache", "ls"],
        ],
        ids=lambda words: words[0],
    )
    def test_a_verb_that_only_looks_makes_no_store(
        self,
        arguments: list[str],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert main([*arguments, "--store", str(tmp_path / "none" / "store")]) == 1
        said = capsys.readouterr().err
        assert f"{tmp_path}/none/store" in said
        assert "there is no" in said
        assert list(tmp_path.iterdir()) == []

    def test_a_cost_is_predicted_without_a_store(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        predicted = RunPrediction([], "probe", 0)
        monkeypatch.setattr("flows.run_costs.predict_run", lambda *_, **__: predicted)
        given = [SEQUENCE, "--profile", "quick", "--before", "--store", str(tmp_path / "store")]
        assert main(["plan", *given]) == 0
        assert "predicted cost" in capsys.readouterr().out
        assert list(tmp_path.iterdir()) == []


class TestCache:
    @pytest.fixture
    def store(self, tmp_path: Path) -> str:
        store = Store(tmp_path / "store")
        for index in range(3):
            with store.slot(stage="toy", version=1, key=f"toy-v1-{index}", label=f"phantom/{index}") as slot:
                (slot.path / "file").write_text("x" * 2000)
        return store.root

    def test_ls(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "ls", "--store", store]) == 0
        said = capsys.readouterr().out
        assert "toy-v1-2" in said
        assert "3 artefacts, 5.9 KiB" in said

    def test_ls_and_usage_show_whole_names_in_a_narrow_terminal(
        self, store: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("flows.terminal.console", lambda **_: Console(width=30))
        assert main(["cache", "ls", "--store", store]) == 0
        assert main(["cache", "usage", "--store", store]) == 0
        said = capsys.readouterr().out
        assert "toy: sequence phantom/2, made 20" in said
        assert "size 2.0 KiB, key toy-v1-2\n" in said
        assert "phantom/2: artefacts 1, files 2, size 2.0 KiB, last made 20" in said

    def test_ls_reads_nothing_and_shows_no_progress_of_it(
        self, store: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
        assert main(["cache", "ls", "--store", store]) == 0
        assert "reading" not in capsys.readouterr().err

    def test_ls_as_json(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "ls", "phantom/1", "--store", store, "--json", "-"]) == 0
        (item,) = json.loads(capsys.readouterr().out)
        assert undocumented(item, "an-artefact") == []
        assert item["key"] == "toy-v1-1"

    def test_verify_finds_damage(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "ls", "--verify", "--store", store]) == 0
        (Path(store) / "artefacts" / "toy-v1-1" / "file").write_text("y")
        assert main(["cache", "ls", "--verify", "--store", store]) == 1
        assert "DAMAGED" in capsys.readouterr().out

    def test_verify(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "verify", "--store", store]) == 0
        assert f"0 of 3 artefacts damaged in {store}" in capsys.readouterr().out
        file = Path(store) / "artefacts" / "toy-v1-1" / "file"
        file.write_text("y" * 2000)
        assert main(["cache", "verify", "--store", store]) == 1
        said = capsys.readouterr().out
        assert "file: its content has changed since it was stored" in said
        assert "1 of 3 artefacts damaged" in said
        assert file.exists()

    def test_verify_repairs(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        (Path(store) / "artefacts" / "toy-v1-1" / "file").unlink()
        assert main(["cache", "verify", "--repair", "--store", store, "--json", "-"]) == 1
        found = json.loads(capsys.readouterr().out)
        assert undocumented(found, "cache-verify") == []
        (row,) = found.pop("damaged")
        assert found == {"store": store, "artefacts": 3, "unreadable": []}
        assert (row["stage"], row["key"], row["file"]) == ("toy", "toy-v1-1", "file")
        assert (Path(row["set_aside"]) / "damage.json").is_file()
        assert main(["cache", "verify", "--store", store]) == 0
        assert "0 of 2 artefacts" in capsys.readouterr().out
        assert Store(store).find("toy-v1-1") is None

    @pytest.mark.parametrize("number", [errno.EACCES, errno.EIO])
    def test_verify_goes_on_where_a_file_cannot_be_read(
        self, number: int, store: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        usual = Path.open

        def opened(path: Path, *given: Any, **more: Any) -> Any:
            if path.parent.name == "toy-v1-1" and path.name == "file":
                raise OSError(number, os.strerror(number), str(path))
            return usual(path, *given, **more)

        monkeypatch.setattr(Path, "open", opened)
        (Path(store) / "artefacts" / "toy-v1-2" / "file").write_text("y" * 2000)
        assert main(["cache", "ls", "--verify", "--store", store]) == 1
        assert ("UNREADABLE" in capsys.readouterr().out) is (number == errno.EACCES)
        assert main(["cache", "verify", "--repair", "--store", store, "--json", "-"]) == 1
        found = json.loads(capsys.readouterr().out)
        assert undocumented(found, "cache-verify") == []
        damaged = {row["key"]: row["problem"] for row in found["damaged"]}
        unreadable = {row["key"]: row["problem"] for row in found["unreadable"]}
        changed = {"toy-v1-2": "its content has changed since it was stored"}
        if number == errno.EIO:
            assert damaged == {"toy-v1-1": "cannot be read: Input/output error", **changed}
            assert unreadable == {}
        else:
            # It may be whole: it stays where it is.
            assert damaged == changed
            assert unreadable["toy-v1-1"].endswith("toy-v1-1/file cannot be read: Permission denied")
            assert (Path(store) / "artefacts" / "toy-v1-1").is_dir()

    def test_verify_wants_a_store(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "verify", "--store", str(tmp_path / "none")]) == 1
        assert f"there is no store {tmp_path / 'none'}" in capsys.readouterr().err

    def test_rm(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "rm", "*-0", "phantom/2", "--store", store]) == 0
        assert "2 artefacts removed" in capsys.readouterr().out
        assert [manifest.key for manifest in Store(store).ls()] == ["toy-v1-1"]
        assert main(["cache", "rm", "toy-v1-1", "--store", store]) == 0
        assert "1 artefact removed" in capsys.readouterr().out

    def test_sequences_are_found_by_any_spelling(
        self, store: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with Store(store).slot(stage="toy", version=1, key="toy-v1-7", label="phantom/7@sparse"):
            pass
        assert main(["cache", "ls", "phantom/7", "--store", store, "--json", "-"]) == 0
        assert [item["key"] for item in json.loads(capsys.readouterr().out)] == ["toy-v1-7"]
        assert main(["cache", "rm", "phantom/7", "--store", store]) == 0

    def test_labels_are_told_with_their_brackets(
        self, store: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        label = "scans [b]/[red]case"
        with Store(store).slot(stage="toy", version=1, key="toy-v1-x", label=label):
            pass
        for verb in ("ls", "usage"):
            assert main(["cache", verb, "--store", store]) == 0
            assert label in capsys.readouterr().out
        assert main(["cache", "rm", label, "--store", store]) == 0
        assert "toy-v1-x" in capsys.readouterr().out

    def test_what_has_a_damaged_manifest(
        self, store: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (Path(store) / "artefacts" / "toy-v1-1" / "manifest.json").write_text("{")
        # It is told as all log lines are, not as Prefect's.
        told: list[str] = []
        monkeypatch.setattr("flows.commands.cache.set_up_logging", lambda **_: told.append("log"))
        for verb in ("ls", "usage", "gc"):
            assert main(["cache", verb, "--store", store]) == 0
        assert len(told) == 3
        assert main(["cache", "rm", "toy-v1-1", "--store", store]) == 0
        assert "1 artefact removed" in capsys.readouterr().out
        assert not (Path(store) / "artefacts" / "toy-v1-1").exists()

    def test_rm_of_what_is_not_there(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["cache", "rm", "nosuch*", "--store", store]) == 1
        assert f"nothing in {store} matches nosuch*" in capsys.readouterr().err
        assert len(Store(store).ls()) == 3

    def test_gc_removes_former_versions(self, store: str, capsys: pytest.CaptureFixture[str]) -> None:
        with Store(store).slot(stage="coarse", version=0, key="coarse-v0-a"):
            pass
        assert main(["cache", "gc", "--store", store]) == 0
        # It was made a moment ago: a run may have it in hand.
        assert "artefacts/coarse-v0-a" not in capsys.readouterr().out
        os.utime(Path(store) / "artefacts" / "coarse-v0-a", (0, 0))
        assert main(["cache", "gc", "--store", store]) == 0
        assert "artefacts/coarse-v0-a" in capsys.readouterr().out
        assert len(Store(store).ls()) == 3
