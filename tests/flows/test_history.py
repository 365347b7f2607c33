"""The history of a benchmark: appended to, drawn, and what has got worse against the runs before."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import ValidationError

from extrags.errors import ConfigError
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.report.benchmark import BenchmarkInputs, build_benchmark_report
from extrags.store import Store, write_record
from flows.benchmark import benchmark
from flows.cli import main
from flows.history import (
    BenchmarkRegressedError,
    Judgement,
    Tolerance,
    append_history,
    history_entry,
    history_of,
    judge,
    trend,
)
from flows.outcome import BenchmarkFailedError
from flows.tables import judgement_markdown
from tests.flows.tiny import SEQUENCE, TINY

MACHINE = {
    "processor": "one",
    "cores": 2,
    "threads": 2,
    "isa": "avx2",
    "device": "cpu",
    "load_average": 0.5,
    "commit": "0123456789abcdef",
}


def entry(
    psnr: float | None = 20.0,
    seconds: float = 100.0,
    *,
    day: int = 1,
    machine: dict[str, Any] | None = None,
    asked: str = "a",
    settings: str = "all",
    seeds: tuple[int, ...] = (0, 1),
) -> dict[str, Any]:
    cases = [
        {
            "method": "coarse",
            "profile": "quick",
            "sequence": "phantom/0",
            "setting": "sparse",
            "seed": seed,
            "error": "" if psnr is not None else "coarse: it diverged",
            "seconds": seconds + seed,
            "peak_mib": 100.0,
            "metrics": None if psnr is None else {"psnr": psnr + seed, "observed": {"psnr": psnr + 2}},
        }
        for seed in seeds
    ]
    made = history_entry(
        "weekly", cases, [{"asked": asked, "settings": settings}] * len(cases), {**MACHINE, **(machine or {})}
    )
    return {**made, "when": f"2026-01-{day:02d}T04:00:00+00:00"}


BEFORE = [entry(day=day, psnr=20 + day / 100) for day in range(1, 6)]


class TestRegressions:
    @pytest.mark.parametrize(
        ("now", "worse"),
        [
            (entry(), []),
            (entry(psnr=19.8), []),
            (entry(psnr=25, seconds=10), []),
            (entry(seconds=128), []),
            (entry(psnr=19.5), ["coarse (quick) on phantom/0@sparse: observed.psnr 21.50 dB, 0.53 dB below"]),
            (entry(seconds=140), ["coarse (quick) on phantom/0@sparse: 140.5 s, 40% above the median 100.5"]),
            (entry(psnr=None), ["coarse (quick) on phantom/0@sparse fails: coarse: it diverged"]),
            # Who asks for other settings asks for another benchmark.
            (entry(psnr=10, seconds=900, asked="b"), []),
            # As a release does that changes a default, or adds a setting.
            (entry(psnr=19.5, settings="all and one"), ["coarse (quick) on phantom/0@sparse: observed.psnr"]),
        ],
    )
    def test_against_the_median_of_the_runs_before(self, now: dict[str, Any], worse: list[str]) -> None:
        found = judge(now, BEFORE, Tolerance()).regressions
        assert len(found) == len(worse)
        assert all(line.startswith(begin) for line, begin in zip(found, worse, strict=True))

    def test_figures_of_another_version_of_the_protocol_are_not_compared(self) -> None:
        worse = entry(psnr=10, seconds=900)
        older = [{**item, "protocol": worse["protocol"] - 1} for item in BEFORE]
        found = judge(worse, older, Tolerance())
        (slower,) = found.regressions
        assert slower.startswith("coarse (quick) on phantom/0@sparse: 900.5 s")
        assert found.not_judged == [
            "coarse (quick) on phantom/0@sparse: observed.psnr, 0 of 5 earlier runs comparable (at least 2)"
        ]
        # Runs from before it was on record are compared.
        silent = [{key: value for key, value in item.items() if key != "protocol"} for item in BEFORE]
        assert len(judge(worse, silent, Tolerance()).regressions) == 2

    def test_nothing_is_judged_by_a_single_run(self) -> None:
        assert judge(entry(psnr=10, seconds=900), BEFORE[:1], Tolerance()).regressions == []
        assert judge(entry(psnr=10), BEFORE[:1], Tolerance(at_least=1)).regressions != []

    def test_what_could_never_judge_is_refused(self) -> None:
        for wrong in ({"runs": 1}, {"runs": 5, "at_least": 6}):
            with pytest.raises(ValidationError, match="nothing would ever be judged"):
                Tolerance(**wrong)
        assert judge(entry(psnr=10), BEFORE, Tolerance(runs=1, at_least=1)).regressions != []

    def test_what_was_not_judged_is_told_with_how_many_could_be_compared(self) -> None:
        label = "coarse (quick) on phantom/0@sparse"
        assert judge(entry(), BEFORE, Tolerance()).not_judged == []
        assert judge(entry(), BEFORE[:1], Tolerance()).not_judged == [
            f"{label}: observed.psnr, 1 of 1 earlier runs comparable (at least 2)",
            f"{label}: run time, 1 of 1 earlier runs comparable (at least 2)",
        ]
        other = [entry(day=day, asked="b", machine={"cores": 64}) for day in (6, 7)]
        elsewhere = [entry(day=day, machine={"cores": 64}) for day in (8, 9)]
        assert judge(entry(), [*other, *elsewhere], Tolerance()).not_judged == [
            f"{label}: run time, 0 of 4 earlier runs comparable (at least 2)"
        ]
        assert judge(entry(psnr=None), other, Tolerance()).not_judged == [
            f"{label}: failure, 0 of 2 earlier runs comparable (at least 2)"
        ]
        assert judge(entry(), [], Tolerance(psnr_db=None, seconds_share=None)).not_judged == []

    def test_entries_of_earlier_versions_count_while_all_settings_are_the_same(self) -> None:
        old = [dict(item) for item in BEFORE]
        for item in old:
            item["cases"] = [
                {key: value for key, value in case.items() if key != "asked"} for case in item["cases"]
            ]
        assert len(judge(entry(psnr=19), old, Tolerance()).regressions) == 1
        found = judge(entry(psnr=19, settings="all and one"), old, Tolerance())
        assert found.regressions == []
        assert "observed.psnr, 0 of 5 earlier runs comparable" in found.not_judged[0]

    def test_only_the_same_seeds_are_compared(self) -> None:
        # Each seed is a second longer than the one before.
        tolerance = Tolerance(seconds=0, seconds_share=0.005)
        many = [entry(day=day, seeds=(0, 1, 2, 30)) for day in (1, 2)]
        assert judge(entry(seeds=(30,)), many, tolerance) == Judgement()
        (line,) = judge(entry(seeds=(2,), seconds=101), many, tolerance).regressions
        assert "103.0 s, 1% above the median 102.0 s" in line
        few = [entry(day=day, seeds=(0,)) for day in (1, 2)]
        found = judge(entry(psnr=10, seeds=(0, 1)), few, tolerance)
        assert found.regressions == []
        assert len(found.not_judged) == 2

    def test_what_has_no_tolerance_is_not_judged(self) -> None:
        both = entry(psnr=10, seconds=900)
        (line,) = judge(both, BEFORE, Tolerance(seconds_share=None)).regressions
        assert "dB below the median" in line
        (line,) = judge(both, BEFORE, Tolerance(psnr_db=None)).regressions
        assert "above the median" in line

    def test_a_case_is_worse_until_it_is_mended(self) -> None:
        good, failed = [entry()] * 10, [entry(psnr=None)] * 7
        for count in range(len(failed)):
            found = judge(entry(psnr=None), [*good, *failed[:count]], Tolerance())
            assert len(found.regressions) == 1, count
        # And then it is held against what it was before it failed.
        assert judge(entry(), [*good, *failed], Tolerance()).not_judged == []
        (worse,) = judge(entry(psnr=10), [*good, *failed], Tolerance()).regressions
        assert "below the median" in worse

    def test_the_last_runs_count(self) -> None:
        slow = [entry(day=day, seconds=300) for day in range(6, 9)]
        assert judge(entry(seconds=300), [*BEFORE, *slow], Tolerance(runs=3)).regressions == []
        assert judge(entry(seconds=300), [*BEFORE, *slow], Tolerance(runs=8)).regressions != []

    def test_run_times_of_other_machines_say_nothing_errors_do(self) -> None:
        elsewhere = [entry(day=day, machine={"processor": "another"}) for day in range(1, 6)]
        assert judge(entry(seconds=900), elsewhere, Tolerance()).regressions == []
        assert len(judge(entry(psnr=19, seconds=900), elsewhere, Tolerance()).regressions) == 1

    def test_short_runs_may_vary_by_seconds(self) -> None:
        quick = [entry(day=day, seconds=4) for day in range(1, 6)]
        assert judge(entry(seconds=8), quick, Tolerance()).regressions == []
        assert judge(entry(seconds=8), quick, Tolerance(seconds=1)).regressions != []

    def test_runs_that_took_no_time_have_no_share_of_it(self) -> None:
        at_once = [entry(day=day, seconds=0, seeds=(0,)) for day in range(1, 6)]
        assert judge(entry(seconds=0, seeds=(0,)), at_once, Tolerance()).regressions == []
        (slower,) = judge(entry(seconds=8, seeds=(0,)), at_once, Tolerance()).regressions
        assert "8.0 s, 8.0 s above the median 0.0 s of 5 runs" in slower


class TestRecords:
    def test_only_appended_to(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        names = {append_history(store, entry(day=day)) for day in (2, 1, 1)}
        assert len(names) == 3
        append_history(store, {**entry(day=3), "name": "weekly!"})
        assert [item["when"][:10] for item in history_of(store, "weekly")] == [
            "2026-01-01",
            "2026-01-01",
            "2026-01-02",
        ]
        assert len(history_of(store, "weekly!")) == 1
        assert history_of(store, "week") == []

    @pytest.mark.parametrize("lost", ["when", "cases", "figures"])
    def test_a_damaged_one_is_left_out(
        self, tmp_path: Path, lost: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        store = Store(tmp_path)
        append_history(store, entry(day=1))
        whole = entry(day=2)
        cases = [{key: value for key, value in case.items() if key != lost} for case in whole["cases"]]
        damaged = {key: value for key, value in (whole | {"cases": cases}).items() if key != lost}
        # As `append_history` names it, which the damage comes after.
        name = append_history(store, whole)
        write_record(store, name, damaged)
        assert [item["when"][:10] for item in history_of(store, "weekly")] == ["2026-01-01"]
        assert f"{name}.json of {store.root} is damaged and skipped" in caplog.text

    def test_names_of_any_length_are_told_apart(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        names = ["long " * 60, "long " * 60 + "!", "long " * 60 + "er"]
        for name in names:
            append_history(store, {**entry(), "name": name})
        assert [[item["name"] for item in history_of(store, name)] for name in names] == [
            [name] for name in names
        ]

    def test_the_trend_has_what_can_be_compared(self) -> None:
        drawn = trend(
            [entry(psnr=19, day=1, machine={"cores": 64}), entry(psnr=None, day=2), entry(psnr=20, day=3)]
        )
        assert [item["methods"].get("coarse") for item in drawn] == [
            {"psnr": 21.0, "seconds": None},
            None,
            {"psnr": 22.0, "seconds": 100.5},
        ]
        assert trend([]) == []

    def test_the_trend_joins_no_figures_of_another_version_of_the_protocol(self) -> None:
        older = {**entry(psnr=25, day=1), "protocol": PROTOCOL_VERSION - 1}
        # Of entries from before it was on record nobody knows the version: they are drawn, as judged.
        silent = {key: value for key, value in entry(psnr=19, day=2).items() if key != "protocol"}
        assert [item["methods"]["coarse"] for item in trend([older, silent, entry(psnr=20, day=3)])] == [
            {"psnr": None, "seconds": 100.5},
            {"psnr": 21.0, "seconds": 100.5},
            {"psnr": 22.0, "seconds": 100.5},
        ]

    def test_the_trend_is_over_the_seeds_of_the_last_run(self) -> None:
        entries = [entry(day=1, seeds=(0, 1, 2)), entry(day=2, seeds=(0,)), entry(day=3, seeds=(2,))]
        assert [item["methods"].get("coarse") for item in trend(entries)] == [
            {"psnr": 22.0, "seconds": 102.0},
            None,
            {"psnr": 22.0, "seconds": 102.0},
        ]

    def test_the_trend_is_over_the_same_sequences_and_figures_throughout(self) -> None:
        def both(day: int, **changed: Any) -> dict[str, Any]:
            found = entry(day=day)
            other = [{**case, "sequence": "phantom/9", "figures": {"psnr": 40.0}} for case in found["cases"]]
            return {**found, "cases": [*found["cases"], *({**case, **changed} for case in other)]}

        alone = entry(day=1)
        failed = both(2, error="coarse: it diverged", figures={})
        otherwise = both(3, figures={"observed.psnr": 50.0})
        drawn = [item["methods"].get("coarse") for item in trend([alone, failed, otherwise, both(4)])]
        assert drawn[:2] == [None, None]
        assert [None if found is None else found["psnr"] for found in drawn[2:]] == [None, 31.0]
        # What fails in the last one is not in its mean; then it is in none.
        drawn = [item["methods"].get("coarse") for item in trend([both(1), both(2, error="no")])]
        assert [None if found is None else found["psnr"] for found in drawn] == [22.0, 22.0]


def test_the_page_shows_trend_and_regressions() -> None:
    runs = [
        {
            **{key: entry()["cases"][0][key] for key in ("method", "profile", "sequence", "setting", "seed")},
            "seconds": 3.0,
            "peak_mib": 1.0,
            "metrics": {"psnr": 20.0},
            "error": "",
        }
    ]
    history = trend([entry(day=1), entry(day=8, psnr=21)])
    given: dict[str, Any] = {
        "name": "weekly",
        "runs": runs,
        "baseline": "coarse",
        "methods": {"coarse": "c"},
    }
    judged: dict[str, Any] = {"regressions": ["it is <slower>"], "not_judged": ["x: <run time>"]}
    page = build_benchmark_report(BenchmarkInputs(**given, history=history, **judged))
    assert "2 runs that measured anew, from 2026-01-01 (extrags " in page
    assert "PSNR and run time of each method over 2 runs" in page
    assert "it is &lt;slower&gt;" in page
    assert "x: &lt;run time&gt;" in page
    assert page == build_benchmark_report(BenchmarkInputs(**given, history=history, **judged))
    assert "a trend takes two" in build_benchmark_report(BenchmarkInputs(**given, history=history[:1]))
    assert 'id="history"' not in build_benchmark_report(BenchmarkInputs(**given))


def test_the_table_has_what_is_worse_and_what_was_not_judged() -> None:
    assert judgement_markdown(Judgement()) == ""
    found = judgement_markdown(Judgement(["slower"], ["x: run time"]))
    assert found == "\n## Worse than before\n\n* slower\n\n## Not judged\n\n* x: run time\n"


@pytest.mark.usefixtures("prefect_server")
class TestFlow:
    def test_measured_anew_kept_and_judged(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        store = Store(tmp_path / "store")
        given: dict[str, Any] = {
            "sequences": [SEQUENCE],
            "methods": ["coarse"],
            "settings": {**TINY, "ingest.max_frames": 8, "coarse.iterations": 20},
            "store": store.root,
            "name": "weekly",
        }
        first = benchmark(**given, refresh=True)
        made = {item.key: (item.started, item.seconds) for item in store.ls("coarse*")}
        assert first["regressions"] == []
        assert first["not_judged"] == []  # Without a tolerance.
        # Were the runs before much better, the next one would be a regression: its run fails.
        (last,) = history_of(store, "weekly")
        for case in last["cases"]:
            case["figures"] = {name: value + 3 for name, value in case["figures"].items()}
        elsewhere = {**last, "machine": {**last["machine"], "cores": 1000}}
        for day in (1, 2, 3):
            append_history(store, {**elsewhere, "when": f"2026-01-{day:02d}T00:00:00+00:00"})
        state = benchmark(**given, refresh=True, tolerance=Tolerance(seconds=600), return_state=True)
        assert state.is_failed()
        error = state.result(raise_on_failure=False)
        assert isinstance(error, BenchmarkRegressedError)
        assert len(error.found) == 1
        assert "3.00 dB below the median" in error.found[0]
        (words,) = error.result["not_judged"]
        assert "run time, 1 of 4 earlier runs comparable" in words
        assert f"not judged: {words}" in caplog.text
        assert error.result["cases"][0]["metrics"] == first["cases"][0]["metrics"]
        # The bits are the same, the seconds are those of now.
        found = history_of(store, "weekly")
        assert len(found) == 5
        assert found[-1]["cases"][0]["figures"] == found[-2]["cases"][0]["figures"]
        assert {item.key: (item.started, item.seconds) for item in store.ls("coarse*")} != made
        page = str(error).rpartition("page: ")[2]
        assert "5 runs that measured anew" in Path(page).read_text()
        assert words in Path(page).read_text()
        # From the store: nothing is measured, nothing is added.
        again = benchmark(**given)
        assert again["cases"][0]["seconds"] == found[-1]["cases"][0]["seconds"]
        assert len(history_of(store, "weekly")) == 5

    @pytest.mark.parametrize("failed", [False, True])
    def test_the_command_tells_what_was_measured_when_it_is_worse(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        failed: bool,
    ) -> None:
        found: dict[str, Any] = {
            "machine": {},
            "cases": [],
            "comparison": {"paired_datasets": [], "sequences": [], "baseline": "coarse"},
            "regressions": ["coarse on phantom/0@sparse: 20 s, 90% above the median"],
            "report": "report.html",
        }

        def measured(**given: Any) -> dict[str, Any]:
            # What has no limit of its own is not judged.
            assert (given["tolerance"].psnr_db, given["tolerance"].seconds_share) == (None, 0.5)
            if failed:
                raise BenchmarkFailedError("weekly", found, 0.5)
            raise BenchmarkRegressedError("weekly", found)

        monkeypatch.setattr(
            "flows.benchmark.benchmark", SimpleNamespace(with_options=lambda **_options: measured)
        )
        out = tmp_path / "out.json"
        arguments = ["benchmark", SEQUENCE, "--methods", "coarse", "--refresh", "--max-slowdown", "0.5"]
        assert main([*arguments, "--json", str(out), "--store", str(tmp_path / "store")]) == 1
        assert json.loads(out.read_text()) == found
        assert "worse: coarse on phantom/0@sparse: 20 s" in capsys.readouterr().out

    def test_the_help_says_what_slowdown_is_never_too_much(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit):
            main(["benchmark", "--help"])
        said = " ".join(capsys.readouterr().out.split())
        assert (
            f"longer than the median of the last runs by more, and by more than {Tolerance().seconds:g} s"
            in said
        )

    def test_a_tolerance_needs_a_measurement(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="needs refresh"):
            benchmark(sequences=[SEQUENCE], store=str(tmp_path), tolerance=Tolerance())
