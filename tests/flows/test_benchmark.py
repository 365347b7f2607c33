"""The benchmark flow: methods, variants and seeds on the tiny sequence, compared in pairs."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest
from prefect.artifacts import Artifact

import flows.benchmark
from extrags.config import profile_config
from extrags.errors import ArtefactGoneError, ConfigError
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.store import Store
from flows.benchmark import Case, benchmark, case_of, check_methods, run_method, summary_of
from flows.cli import main
from flows.commands.benchmark import print_benchmark
from flows.history import Tolerance, history_of
from flows.limits import StageLimits
from flows.outcome import BenchmarkFailedError, SequenceOutcome
from flows.runners import DirectRunner
from flows.tables import difference_text, spread_text
from tasks.run_page import artifact_key
from tests.extrags.report.pages import Page
from tests.flows.damaging import flip_bit
from tests.flows.tiny import SEQUENCE, TINY

NO_LIGHT = {"no-light": {"coarse.light.enabled": False}}


@pytest.fixture(scope="module")
def found(finished: tuple[str, SequenceOutcome], prefect_server: None) -> dict[str, Any]:
    store, _ = finished
    result: dict[str, Any] = benchmark(
        sequences=[SEQUENCE],
        profiles=["quick"],
        methods=["3dgs", "coarse"],
        variants=NO_LIGHT,
        seeds=[0, 1],
        settings={**TINY, "ingest.max_frames": 10, "coarse.iterations": 60},
        store=store,
        name="tiny methods",
    )
    return result


class TestRuns:
    def test_a_case_for_each_combination(self, found: dict[str, Any]) -> None:
        assert {"processor", "cores", "threads", "versions", "commit"} <= set(found["machine"])
        assert found["protocol"] == PROTOCOL_VERSION
        identities = [(case["method"], case["seed"]) for case in found["cases"]]
        assert identities == [(method, seed) for seed in (0, 1) for method in ("3dgs", "coarse", "no-light")]
        case = found["cases"][0]
        assert (case["sequence"], case["setting"], case["error"]) == ("phantom/0", "sparse", "")
        assert case["seconds"] > 0
        assert case["peak_mib"] > 50
        assert len({case["metrics"]["psnr"] for case in found["cases"]}) == len(found["cases"])
        json.dumps(found, allow_nan=False)

    def test_the_baseline_has_no_light_and_three_degrees(
        self, found: dict[str, Any], finished: tuple[str, SequenceOutcome]
    ) -> None:
        from extrags.scene import Scene

        scenes = {}
        for manifest in Store(finished[0]).ls("coarse"):
            config = manifest.config["config"]
            if config["iterations"] == 60 and config["seed"] == 0:
                scene = Scene.load(Path(finished[0]) / "artefacts" / manifest.key / "scene")
                scenes[(config["light"]["enabled"], config["sh_degree"])] = scene
        assert set(scenes) == {(True, 0), (False, 0), (False, 3)}
        assert scenes[False, 3].light is None
        assert scenes[False, 3].gaussians.sh_degree == 3

    def test_figures_of_every_view_are_there(self, found: dict[str, Any]) -> None:
        case = found["cases"][0]
        evaluation = json.loads(Path(case["evaluation"]).read_text())
        assert evaluation["metrics"] == case["metrics"]
        per_view = json.loads((Path(found["report"]).parent / "per_view.json").read_text())
        assert per_view[0]["per_view"] == evaluation["per_view"]
        assert [run["method"] for run in per_view[:2]] == ["3dgs", "coarse"]
        assert case["metrics"]["surface"]["threshold_mm"] == 1.0
        assert evaluation["true_surface"] == "mesh"

    def test_settings_and_image_size_are_on_the_page_and_in_its_files(
        self, found: dict[str, Any], finished: tuple[str, SequenceOutcome]
    ) -> None:
        case, report = found["cases"][0], Path(found["report"])
        assert case["settings"]["coarse.iterations"] == 60
        width, height = case["image_size"]
        text = Page(report.read_text()).text
        assert f"Image size {width} × {height} px" in text  # noqa: RUF001
        assert "ingest.max_frames = 10" in text
        assert found["methods"]["no-light"] == "coarse with coarse.light.enabled = False"
        (manifest,) = Store(finished[0]).ls(report.parent.name)
        assert manifest.config["runs"][0]["settings"]["ingest.max_frames"] == 10
        per_view = json.loads((report.parent / "per_view.json").read_text())
        assert per_view[0]["image_size"] == [width, height]

    def test_methods_are_compared_in_pairs(self, found: dict[str, Any]) -> None:
        comparison = found["comparison"]
        assert comparison["baseline"] == "3dgs"
        rows = {row["method"]: row for row in comparison["paired_sequences"]}
        assert set(rows) == {"coarse", "no-light"}
        psnr = {(case["method"], case["seed"]): case["metrics"]["psnr"] for case in found["cases"]}
        expected = sum(psnr["coarse", seed] - psnr["3dgs", seed] for seed in (0, 1)) / 2
        assert rows["coarse"]["figures"]["psnr"]["mean"] == pytest.approx(expected)
        assert rows["coarse"]["figures"]["psnr"]["n"] == 2
        stored = json.loads((Path(found["report"]).parent / "comparison.json").read_text())
        assert stored == comparison

    def test_page_and_artifact(self, found: dict[str, Any]) -> None:
        page = Path(found["report"]).read_text()
        assert "no-light" in page
        assert "truth as recorded" in page
        artifact: Any = Artifact.get("benchmark-tiny-methods")
        assert "## Differences to 3dgs" in artifact.data
        assert "| phantom/0 | sparse | quick | coarse | 2 |" in artifact.data


@pytest.mark.usefixtures("prefect_server")
class TestAgain:
    def test_what_is_there_is_taken_and_a_failure_stops_nothing(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        store, first = finished
        (tmp_path / "empty").mkdir()
        found = benchmark(
            sequences=[str(tmp_path / "empty"), SEQUENCE],
            methods=["coarse", "extrags"],
            settings=TINY,
            store=store,
        )
        broken, fine = found["cases"][:2], {case["method"]: case for case in found["cases"][2:]}
        assert [case["metrics"] for case in broken] == [None, None]
        assert all("ingest: " in case["error"] for case in broken)
        assert fine["coarse"]["metrics"] == first.metrics["coarse"]
        assert fine["extrags"]["metrics"] == first.metrics["final"]
        assert fine["extrags"]["seconds"] > fine["coarse"]["seconds"] > 0
        assert "the folder is empty" in Path(found["report"]).read_text()

    @pytest.mark.parametrize(("allowed", "fails"), [(None, True), (1.0, False)])
    def test_one_whose_runs_all_failed_has_failed(
        self, tmp_path: Path, allowed: float | None, fails: bool
    ) -> None:
        (tmp_path / "empty").mkdir()
        # Names may be as long as one likes.
        store, name = Store(tmp_path / "store"), f"none-{allowed}{' of many' * 30}"
        state = benchmark(
            sequences=[str(tmp_path / "empty")],
            methods=["coarse", "3dgs"],
            store=store.root,
            name=name,
            refresh=True,
            tolerance=Tolerance(),
            return_state=True,
            **({} if allowed is None else {"max_failed_share": allowed}),
        )
        assert (state.is_failed(), state.is_completed()) == (fails, not fails)
        # Page, table and history have been written all the same, and the state says what happened.
        artifact: Any = Artifact.get(artifact_key("benchmark", name))
        assert "the folder is empty" in artifact.data
        assert [manifest.stage for manifest in store.ls()] == ["benchmark-report"]
        (entry,) = history_of(store, name)
        assert len(entry["cases"]) == 2
        if fails:
            assert f"2 of 2 runs of the benchmark {name} failed" in state.message
            assert "[3dgs, quick, seed 0] failed in ingest: " in state.message
            error = state.result(raise_on_failure=False)
            assert isinstance(error, BenchmarkFailedError)
            assert [case["metrics"] for case in error.result["cases"]] == [None, None]

    def test_what_its_page_finds_damaged_is_made_anew(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        store, first = finished
        shutil.copytree(Path(store) / "artefacts", tmp_path / "artefacts")
        Store(tmp_path).rm("benchmark-report")  # Another test may have made that page.
        key = Path(first.artefacts["renders_final"]).name
        # No stage reads the renders of a finished run; the page does, for its pictures.
        flip_bit(tmp_path / "artefacts" / key / "renders.zarr.zip", random.Random(0))
        found = benchmark(
            sequences=[SEQUENCE], methods=["coarse", "extrags"], settings=TINY, store=str(tmp_path)
        )
        assert [case["error"] for case in found["cases"]] == ["", ""]
        assert Path(found["report"]).is_file()
        (aside,) = (tmp_path / "damaged").iterdir()
        assert aside.name.startswith(key)

    def test_what_was_spent_before_its_page_met_damage_counts(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        build, pages = flows.benchmark.benchmark_page, []

        def page(*given: Any) -> str:
            pages.append(given)
            if len(pages) == 1:
                raise ArtefactGoneError("it was removed meanwhile", "evaluate-v1-00")
            return build(*given)

        monkeypatch.setattr(flows.benchmark, "benchmark_page", page)
        settings = {**TINY, "coarse.iterations": 20}
        found = benchmark(sequences=[SEQUENCE], methods=["coarse"], settings=settings, store=str(tmp_path))
        (case,) = found["cases"]
        assert len(pages) == 2
        assert case["spent_seconds"] == pytest.approx(case["seconds"], abs=2e-3)
        assert case["spent_seconds"] > 0

    def test_a_wrong_setting_stops_it_at_once(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"did you mean coarse\.iterations"):
            benchmark(
                sequences=[SEQUENCE],
                variants={"x": {"coarse.iteration": 1}},
                store=str(tmp_path / "store"),
            )

    @pytest.mark.parametrize(
        ("settings", "seeds", "message"),
        [
            (
                {"coarse.iteration": 1},
                [0],
                r"^phantom/1@sparse: no setting .* did you mean coarse\.iterations",
            ),
            ({}, [0, -1], "^the seed is -1"),
        ],
    )
    def test_so_does_one_of_a_later_run(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        settings: dict[str, Any],
        seeds: list[int],
        message: str,
    ) -> None:
        begun: list[str] = []
        monkeypatch.setattr("flows.benchmark.run_lease", begun.append)
        manifest = tmp_path / "sequences.json"
        manifest.write_text(json.dumps([SEQUENCE, {"sequence": "phantom/1@sparse", "settings": settings}]))
        with pytest.raises(ConfigError, match=message):
            benchmark.fn(
                sequences=[f"@{manifest}"], methods=["coarse"], seeds=seeds, store=str(tmp_path / "store")
            )
        assert begun == []

    def test_a_sequence_over_the_memory_limit_is_refused(self, finished: tuple[str, SequenceOutcome]) -> None:
        found = benchmark(
            sequences=[SEQUENCE],
            methods=["coarse"],
            # What is in the store needs none.
            settings={**TINY, "coarse.iterations": 121},
            store=finished[0],
            name="little memory",
            limits=StageLimits(memory_gb=0.001),
            max_failed_share=1,
        )
        assert "more than the limit of 0.001 GB" in found["cases"][0]["error"]


def test_what_was_asked_for_is_told_from_all_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.benchmark.run_sequence", lambda name, *_args, **_more: SequenceOutcome(name))

    def case(
        settings: dict[str, Any] | None = None, variant: dict[str, Any] | None = None, seed: int = 0
    ) -> Case:
        method = "coarse" if variant is None else "x"
        variants = {"x": variant or {}}
        return run_method(method, SEQUENCE, "quick", seed, settings, "", DirectRunner(""), variants=variants)

    plain, again = case(), case({}, seed=1)
    assert (again.asked, again.settings) == (plain.asked, plain.settings)
    # A default that is asked for is no other setting; a method leaves out stages, whatever their settings.
    default = {"coarse.iterations": profile_config("quick").coarse.iterations}
    asked = [plain, case(default), case(variant=default), case(variant={**default, "method": "extrags"})]
    assert len({item.asked for item in asked}) == 4
    assert {item.settings for item in asked} == {plain.settings}
    monkeypatch.setattr(
        "flows.settings.profile_config",
        lambda name: profile_config(name).with_overrides({"coarse.iterations": 7}),
    )
    assert case().asked == plain.asked == case_of(plain)["asked"]
    assert case().settings != plain.settings


class TestNames:
    def test_the_baseline_is_3dgs_else_the_first(self) -> None:
        assert check_methods(["coarse", "3dgs"], {}) == "3dgs"
        assert check_methods(["coarse", "extrags"], {}) == "coarse"
        assert check_methods(["coarse"], NO_LIGHT, "no-light") == "no-light"

    @pytest.mark.parametrize(
        ("methods", "variants", "baseline", "message"),
        [
            (["nerf"], {}, None, "no method 'nerf'"),
            (["coarse", "coarse"], {}, None, "named twice"),
            (["coarse"], {}, "3dgs", "'3dgs' is not among the methods: coarse"),
            (["coarse"], {"3dgs": {}}, None, "cannot have a method's name: 3dgs"),
            (["coarse"], {"x": {"method": "nerf"}}, None, "variant x: no method 'nerf'"),
            (["coarse"], {"x": {"explore.hole_weight": 0}}, None, "no effect on the method coarse"),
            (
                ["3dgs"],
                {"x": {"method": "real-only", "enhance.steps": 1}},
                None,
                "leaves out the stage enhance",
            ),
        ],
    )
    def test_wrong_names(
        self, methods: list[str], variants: dict[str, Any], baseline: str | None, message: str
    ) -> None:
        with pytest.raises(ConfigError, match=message):
            check_methods(methods, variants, baseline)

    @pytest.mark.parametrize(
        ("twice", "message"),
        [
            ({"seeds": [0, 1, 0]}, "a seed is given twice: 0, 1, 0"),
            ({"profiles": ["quick", "quick"]}, "a profile is given twice: quick, quick"),
        ],
    )
    def test_what_is_given_twice_is_refused_before_anything_runs(
        self, twice: dict[str, Any], message: str, tmp_path: Path
    ) -> None:
        with pytest.raises(ConfigError, match=message):
            benchmark.fn(sequences=[SEQUENCE], store=str(tmp_path / "store"), **twice)
        assert not (tmp_path / "store").exists()

    def test_variants_say_what_they_are(self) -> None:
        assert summary_of("no-light", NO_LIGHT) == "coarse with coarse.light.enabled = False"
        assert "plain 3D Gaussian Splatting" in summary_of("3dgs", NO_LIGHT)

    def test_texts(self) -> None:
        figure = {"mean": 1.5, "low": 0.25, "high": 2.75, "deviation": 0.5}
        assert difference_text("observed.psnr", figure) == "+1.50 [+0.25, +2.75]"
        assert difference_text("ssim", {**figure, "low": None}) == "+1.5000"
        assert spread_text("psnr", figure) == "1.50 ± 0.50"
        assert spread_text("psnr", {**figure, "deviation": None}) == "1.50"
        assert spread_text("psnr", None) == difference_text("psnr", None) == "–"  # noqa: RUF001


def test_names_are_told_with_their_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    about = {"profile": "quick", "method": "dim [b]", "figures": {}}
    comparison = {
        "baseline": "[red]one",
        "paired_datasets": [{**about, "dataset": "scans [c]", "n_sequences": 1}],
        "sequences": [{**about, "sequence": "scans [d]/case", "setting": "", "n_seeds": 1}],
    }
    print_benchmark(
        {"comparison": comparison, "cases": [], "regressions": [], "report": "page.html"}, to_stderr=False
    )
    said = capsys.readouterr().out
    for name in ("dim [b]", "[red]one", "scans [c]", "scans [d]/case"):
        assert name in said


@pytest.mark.parametrize("command", [["benchmark"], ["bench", "pipeline", "--output", "grid"]])
@pytest.mark.usefixtures("untouched_environment")
def test_an_unknown_sequence_is_refused_before_any_run(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EXTRAGS_STORE", str(tmp_path / "store"))
    monkeypatch.setattr("flows.temporary_server.start_early", _never)
    monkeypatch.setattr("flows.pipeline_grid.run_grid", _never)
    assert main([*command, SEQUENCE, "phantomm/0@sparse"]) == 2
    assert "no sequence 'phantomm/0@sparse'" in capsys.readouterr().err


def _never(*_: object, **__: object) -> None:
    raise AssertionError("nothing is to be run")
