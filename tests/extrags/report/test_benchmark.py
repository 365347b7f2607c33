"""The page of a benchmark: paired numbers, charts, pictures of two methods, failures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from extrags.errors import ConfigError, ShapeError
from extrags.report.benchmark import BenchmarkInputs, ComparedViews, build_benchmark_report
from extrags.report.charts import method_colors
from extrags.report.comparison import RenderedMethod, compared_rows
from extrags.sequence import EndoscopicSequence
from tests.drawn_once import drawn_anew

from .conftest import TEST, metrics_of
from .pages import Page, decoded
from .test_downloads import lines

METHODS = {"3dgs": "plain 3D Gaussian Splatting", "coarse": "the light-aware coarse scene"}


def run(method: str, sequence: str, seed: int, psnr: float) -> dict[str, Any]:
    surface = {"accuracy_mm": 1 / psnr, "fscore": psnr / 40, "unobserved": {}}
    return {
        "method": method,
        "profile": "quick",
        "sequence": sequence,
        "setting": "sparse",
        "seed": seed,
        "seconds": 30.0 + psnr,
        "peak_mib": 500.0,
        "metrics": metrics_of(psnr) | {"surface": surface},
        "error": "",
    }


def runs_of(gains: dict[str, float], seeds: int = 3) -> list[dict[str, Any]]:
    return [
        run(method, sequence, seed, 20.0 + seed / 4 + gain * (method == "coarse"))
        for sequence, gain in gains.items()
        for seed in range(seeds)
        for method in METHODS
    ]


@pytest.fixture(scope="module")
def compared(sequence: EndoscopicSequence) -> ComparedViews:
    truth = sequence.rgb[TEST].astype(np.float32) / 255
    waves = np.sin(np.arange(truth.size).reshape(truth.shape) / 7)
    views = {
        name: RenderedMethod(
            name,
            np.clip(truth + size * waves, 0, 1),
            [{"frame": int(frame)} | metrics_of(20 + 5 * (name == "coarse")) for frame in TEST],
        )
        for name, size in (("3dgs", 0.2), ("coarse", 0.05))
    }
    return ComparedViews(sequence, "seed 0", views["3dgs"], views["coarse"])


@pytest.fixture(scope="module")
def inputs(compared: ComparedViews) -> BenchmarkInputs:
    gains = {"phantom/0": 4.0, "phantom/1": 3.0}
    return BenchmarkInputs("light", runs_of(gains), "3dgs", METHODS, [compared], views=2)


@pytest.fixture(scope="module")
def html(inputs: BenchmarkInputs) -> str:
    return build_benchmark_report(inputs)


def test_says_what_was_gained(html: str) -> None:
    text = Page(html).text
    assert "coarse against 3dgs on phantom@sparse: +3.50 dB PSNR on observed pixels" in text
    assert "better on 2 of 2 sequences" in text
    # t(0.975, 1) * 0.7071 / sqrt(2) = 6.35
    assert "−2.85 to +9.85" in text  # noqa: RUF001
    assert "better in 3 of 3" in text
    assert "Surface accuracy" in text
    assert "3dgs (baseline)" in text


def test_lengths_are_millimetres_of_metric_scenes_alone(html: str) -> None:
    told = "of scenes that are not metric in units of the scene"
    assert told in Page(html).text
    plain = [run("3dgs", "phantom/0", 0, 20.0) | {"metrics": metrics_of(20.0)}]
    assert told not in Page(build_benchmark_report(BenchmarkInputs("light", plain, "3dgs", METHODS))).text


def test_profiles_are_told_apart_in_words_and_charts() -> None:
    quick = runs_of({"phantom/0": 1.0}, seeds=2)
    balanced = [{**run, "profile": "balanced"} for run in runs_of({"phantom/0": 3.0}, seeds=2)]
    html = build_benchmark_report(BenchmarkInputs("two", [*quick, *balanced], "3dgs", METHODS))
    text = Page(html).text
    assert "coarse against 3dgs on phantom@sparse (quick): +1.00 dB" in text
    assert "coarse against 3dgs on phantom@sparse (balanced): +3.00 dB" in text
    tables = [lines(link) for link in Page(html).links if link.startswith("data:text/csv;")]
    names = {"phantom/0@sparse, quick", "phantom/0@sparse, balanced"}
    for column in ("run", "sequence"):
        drawn = [{row[column] for row in table} for table in tables if column in table[0]]
        assert drawn
        assert all(found == names for found in drawn)


def test_is_one_file_and_the_same_twice(
    inputs: BenchmarkInputs, html: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn_anew(monkeypatch)
    page = Page(html)
    assert page.loads
    assert all(load.startswith("data:image/") for load in page.loads)
    assert build_benchmark_report(inputs) == html
    assert len(html.encode()) < 6_000_000
    for image in page.images:
        assert image["alt"]
        content = decoded(str(image["src"]))
        if isinstance(content, str):
            assert content.count("<path") > 10


def test_pictures_stand_side_by_side(html: str) -> None:
    alts = [str(image["alt"]) for image in Page(html).images]
    shown = (", 3dgs render", ", coarse render", "truth as recorded")
    for wanted in (*shown, "error of the 3dgs render", "error of the coarse render"):
        assert sum(wanted in alt for alt in alts) == 2, wanted


def test_the_outline_is_explained_wherever_it_is_drawn(
    inputs: BenchmarkInputs, compared: ComparedViews
) -> None:
    blind = replace(compared, sequence=replace(compared.sequence, observed=None))
    for pictures, explained in (([blind, compared], True), ([compared, blind], True), ([blind], False)):
        text = Page(build_benchmark_report(replace(inputs, pictures=pictures, views=1))).text
        assert ("Cyan outlines surface" in text) == explained


def test_errors_share_a_scale_and_show_the_better(compared: ComparedViews) -> None:
    table = compared_rows(compared.sequence, (compared.baseline, compared.contender), 1, 100_000)
    (row,) = table.rows
    assert [cell.label for cell in row.cells] == ["3dgs", "coarse", "Truth", "Error, 3dgs", "Error, coarse"]
    worse, better = (np.asarray(decoded(cell.image.uri).convert("L")) for cell in row.cells[3:])  # type: ignore[union-attr]
    assert worse.mean() > 2 * better.mean()
    assert "PSNR 20.00 → 25.00 dB" in row.note
    assert table.outlined
    assert (table.shown, table.total) == (1, len(TEST))
    short = replace(compared.baseline, rgb=compared.baseline.rgb[:2])
    with pytest.raises(ShapeError, match="renders of 3dgs have shape"):
        compared_rows(compared.sequence, (short, compared.contender), 1, 100_000)


def test_failures_and_what_is_missing_are_said() -> None:
    runs = runs_of({"phantom/0": 1.0}, seeds=1)
    runs[1] |= {"metrics": None, "error": "coarse: not finite any more at iteration 3"}
    text = Page(build_benchmark_report(BenchmarkInputs("bad", runs, "3dgs", METHODS))).text
    assert "not finite any more at iteration 3" in text
    assert "phantom/0@sparse, coarse, seed 0" in text
    assert "there is nothing to compare" in text
    assert "No renders of two methods" in text


def test_a_single_seed_has_no_interval() -> None:
    html = build_benchmark_report(
        BenchmarkInputs("one", runs_of({"phantom/0": 2.0}, seeds=1), "3dgs", METHODS)
    )
    text = Page(html).text
    assert "+2.00 dB PSNR on observed pixels, better on 1 of 1 sequence." in text
    assert "interval" not in text.split("Methods")[0]


@pytest.mark.parametrize(
    ("gains", "verdict"),
    [
        ((1.2, -0.9, 0.1), None),
        ((1.2, 0.9, 1.1), "better"),
        ((-1.2, -0.9, -1.1), "worse"),
        ((2.0,), None),
        ((0.0,), "equal"),
    ],
)
def test_a_verdict_takes_an_interval_without_zero(gains: tuple[float, ...], verdict: str | None) -> None:
    given = runs_of({f"phantom/{number}": gain for number, gain in enumerate(gains)}, seeds=1)
    page = Page(build_benchmark_report(BenchmarkInputs("x", given, "3dgs", METHODS)))
    cell = page.text.split("Differences to 3dgs")[1].split("PSNR, dB ↑")[1].split("better in")[0].split()
    assert [word for word in cell if word in ("better", "worse", "equal")] == ([verdict] if verdict else [])


def test_sources_that_tell_nothing_of_what_was_observed() -> None:
    runs = runs_of({"sinus/hopkins": 1.0})
    for item in runs:
        for name in ("observed", "unobserved", "surface"):
            del item["metrics"][name]
    text = Page(build_benchmark_report(BenchmarkInputs("sinus", runs, "3dgs", METHODS))).text
    assert "+1.00 dB PSNR on all valid pixels" in text
    assert "Surface accuracy" not in text.split("How the numbers")[0]


def test_a_baseline_that_was_not_run_is_refused() -> None:
    with pytest.raises(ConfigError, match="no run of the baseline"):
        build_benchmark_report(BenchmarkInputs("x", runs_of({"phantom/0": 1.0}), "extrags", METHODS))


def test_share_of_the_way_to_the_oracle(html: str) -> None:
    runs = runs_of({"phantom/0": 4.0, "phantom/1": -1.0})
    runs += [run("oracle", item["sequence"], item["seed"], 30.0) for item in runs if item["method"] == "3dgs"]
    page = Page(build_benchmark_report(BenchmarkInputs("oracle", runs, "3dgs", METHODS)))
    assert "ceiling" in page.ids
    assert "Share of the way from 3dgs to oracle" in page.text
    # 3dgs is at 20.25 dB on average, so that the oracle is 9.75 dB better: 41 % and -10 %, 15 % on average.
    assert "15 % −10 % to 41 %" in page.text  # noqa: RUF001
    assert "oracle against 3dgs" not in page.text
    assert "ceiling" not in Page(html).ids


def test_colours_of_methods() -> None:
    colors = method_colors(["a", "base", "b"], "base")
    assert list(colors) == ["base", "a", "b"]
    assert len(set(colors.values())) == 3


def test_stages_that_runs_share_took_their_time_once(inputs: BenchmarkInputs) -> None:
    stages = [{"artefacts": ["ingest-0"], "made_seconds": 20.0}, {"artefacts": [], "made_seconds": 0.0}]
    runs = [{**run, "seconds": 50.0, "stages": stages} for run in inputs.runs[:2]]
    assert "Run time of all 1 min 20 s" in Page(build_benchmark_report(replace(inputs, runs=runs))).text


def test_depth_over_different_pixels_is_not_judged() -> None:
    def page_of(coverage: float) -> Page:
        runs = runs_of({"phantom/0": 1.0, "phantom/1": 1.0}, seeds=2)
        for item in runs:
            fuller = item["method"] == "coarse"
            item["metrics"] |= {
                "depth_absrel": 0.04 if fuller else 0.03,
                "depth_coverage": 1.0 if fuller else coverage,
            }
        return Page(build_benchmark_report(BenchmarkInputs("depth", runs, "3dgs", METHODS)))

    differences = page_of(0.9).text.split("Differences to 3dgs")[1].split("By sequence")[0]
    assert "Depth AbsRel ↓ +0.010 over more pixels: see the coverage" in differences
    assert "Depth coverage ↑ +0.100 better" in differences
    assert "Depth AbsRel ↓ +0.010 worse" in page_of(1.0).text


def test_opposite_differences_in_coverage_do_not_cancel() -> None:
    runs = runs_of({"phantom/0": 1.0, "phantom/1": 1.0}, seeds=1)
    for item in runs:
        fuller = (item["method"] == "coarse") == (item["sequence"] == "phantom/0")
        item["metrics"] |= {
            "depth_absrel": 0.03 if item["method"] == "coarse" else 0.05,
            "depth_coverage": 1.0 if fuller else 0.8,
        }
    text = Page(build_benchmark_report(BenchmarkInputs("depth", runs, "3dgs", METHODS))).text
    assert "Depth AbsRel ↓ −0.020 over other pixels: see the coverage" in text  # noqa: RUF001
    assert "better in 2 of 2" not in text.split("Depth AbsRel ↓")[1].split("Depth coverage")[0]


def test_accuracy_of_less_of_the_surface_is_not_judged() -> None:
    def page_of(recall: float) -> str:
        runs = runs_of({"phantom/0": 1.0, "phantom/1": 1.0}, seeds=2)
        for item in runs:
            better = item["method"] == "coarse"
            item["metrics"]["surface"] |= {
                "accuracy_mm": 0.3 if better else 0.8,
                "recall": recall if better else 0.9,
            }
        return Page(build_benchmark_report(BenchmarkInputs("surface", runs, "3dgs", METHODS))).text

    assert "−0.50 better" in page_of(0.9)  # noqa: RUF001
    less = page_of(0.2)
    assert "−0.50 over less of the surface" in less  # noqa: RUF001
    assert "−0.50 better" not in less  # noqa: RUF001


def test_sources_without_geometry_have_a_chart_of_all_pixels() -> None:
    told, blind = runs_of({"phantom/0": 1.0}, seeds=1), runs_of({"sinus/hopkins": 1.0}, seeds=1)
    for item in blind:
        for name in ("observed", "unobserved", "surface"):
            del item["metrics"][name]
    page = Page(build_benchmark_report(BenchmarkInputs("both", [*told, *blind], "3dgs", METHODS)))
    alts = [str(image["alt"]) for image in page.images]
    assert any("PSNR, observed (dB) on held-out views of the 2 of 4 runs that have it" in alt for alt in alts)
    assert any(alt.startswith("PSNR (dB) on held-out views of every run") for alt in alts)
    tables = [lines(link) for link in page.links if link.startswith("data:text/csv;")]
    named = [{line["sequence"] for line in table} for table in tables if "sequence" in table[0]]
    assert {"phantom/0@sparse", "sinus/hopkins@sparse"} in named
