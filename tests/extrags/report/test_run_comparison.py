"""The page that compares runs of one sequence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.errors import ConfigError, ShapeError
from extrags.report import ReportInputs
from extrags.report.run_comparison import ComparedRun, build_run_comparison
from tests.extrags.report.conftest import result_of
from tests.extrags.report.pages import Page
from tests.extrags.report.test_downloads import lines


@pytest.fixture(scope="module")
def runs(inputs: ReportInputs) -> list[ComparedRun]:
    assert inputs.coarse is not None
    assert inputs.final is not None
    return [
        ComparedRun("3dgs", inputs.coarse.rgb, result_of(20.0, 1000), {"a.x": "1", "a.y": "2"}, 75.0),
        ComparedRun("extrags", inputs.final.rgb, result_of(22.5, 1500), {"a.x": "1", "a.y": "3", "b": "on"}),
    ]


@pytest.fixture(scope="module")
def html(inputs: ReportInputs, runs: list[ComparedRun]) -> str:
    return build_run_comparison(inputs.sequence, runs, views=2)


def test_says_which_is_best_and_by_how_much(html: str) -> None:
    page = Page(html)
    assert "The highest PSNR is that of extrags, 22.50 dB, 2.50 dB above 3dgs." in page.text
    assert "PSNR, dB ↑ 20.00 +2.50 better 22.50 best" in page.text
    assert "3dgs 1\N{NARROW NO-BREAK SPACE}000 Gaussians 1 min 15 s" in page.text.replace(
        " 000", "\N{NARROW NO-BREAK SPACE}000"
    )


def test_only_settings_that_differ_are_listed(html: str) -> None:
    page = Page(html)
    assert "1 settings are the same" in page.text
    assert "a.y 2 3" in page.text
    assert "b – on" in page.text  # noqa: RUF001
    assert "a.x" not in page.text


def test_the_same_views_of_all_runs_and_their_errors(html: str) -> None:
    page = Page(html)
    strips = [image for image in page.images if str(image["alt"]).startswith("Frame ")]
    assert len(strips) == 2 * 5
    assert [str(image["alt"]).split(", ", 1)[1].split(",")[0] for image in strips[:5]] == [
        "3dgs render",
        "extrags render",
        "truth as recorded",
        "error of the 3dgs render",
        "error of the extrags render",
    ]


def test_nothing_is_loaded_from_outside_and_it_is_the_same_every_time(
    inputs: ReportInputs, runs: list[ComparedRun], html: str
) -> None:
    assert all(load.startswith("data:image/") for load in Page(html).loads)
    assert build_run_comparison(inputs.sequence, runs, views=2) == html


def test_the_numbers_can_be_taken_along(html: str) -> None:
    files = [lines(link) for link in Page(html).links if link.startswith("data:")]
    table, views = files
    psnr = next(row for row in table if row["metric"] == "psnr" and row["pixels"] == "Never observed")
    assert (psnr["3dgs"], psnr["extrags"]) == ("16", "18.5")
    assert len(views) == 5
    assert set(views[0]) == {"frame", "3dgs", "extrags"}


def test_a_figure_that_looks_the_same_is_no_better(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    twins = [runs[0], replace(runs[0], name="again", result=result_of(20.0001, 1000))]
    page = Page(build_run_comparison(inputs.sequence, twins, views=1))
    assert "PSNR, dB ↑ 20.00 best ±0.00 20.00 best" in page.text


def test_more_runs_than_fit_in_pictures(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    many = [replace(runs[0], name=f"run {number}") for number in range(6)]
    page = Page(build_run_comparison(inputs.sequence, many, views=1))
    assert "Not shown in pictures, for want of room: run 4, run 5." in page.text


@pytest.mark.parametrize("count", [0, 1])
def test_one_run_is_no_comparison(inputs: ReportInputs, runs: list[ComparedRun], count: int) -> None:
    with pytest.raises(ConfigError, match="two or more runs"):
        build_run_comparison(inputs.sequence, runs[:count])


def test_names_tell_runs_apart(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    with pytest.raises(ConfigError, match="different names"):
        build_run_comparison(inputs.sequence, [runs[0], runs[0]])


def test_runs_of_other_views_are_refused(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    fewer = replace(runs[1], rgb=np.asarray(runs[1].rgb)[:-1])
    with pytest.raises(ShapeError, match="the run extrags has renders"):
        build_run_comparison(inputs.sequence, [runs[0], fewer])


def test_runs_of_other_held_out_frames_are_refused(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    views = [dict(view) for view in runs[1].result["per_view"]]
    for view, frame in zip(views, inputs.sequence.test, strict=True):
        view["name"] = inputs.sequence.frame_name(int(frame))
    views[-1]["name"] = "another"
    other = replace(runs[1], result={**runs[1].result, "per_view": views})
    with pytest.raises(ShapeError, match="extrags has other held-out frames: another in place of"):
        build_run_comparison(inputs.sequence, [runs[0], other])
    first, second = (replace(run, held_out=run.name) for run in runs)
    with pytest.raises(ShapeError, match="images or masks of the held-out frames differ"):
        build_run_comparison(inputs.sequence, [first, second])
    # Of one it is not known.
    assert build_run_comparison(inputs.sequence, [runs[0], second], views=1)


def test_a_run_that_has_seen_the_views_is_no_competitor(
    inputs: ReportInputs, runs: list[ComparedRun]
) -> None:
    seen = replace(runs[1], name="oracle", held_out_trained_on=True)
    text = Page(build_run_comparison(inputs.sequence, [runs[0], seen], views=1)).text
    assert "Held-out frames were trained on in oracle" in text
    assert "The highest PSNR is that of 3dgs, 20.00 dB." in text
    assert "22.50 best" not in text


def test_no_error_of_depth_is_the_best_over_other_pixels(
    inputs: ReportInputs, runs: list[ComparedRun]
) -> None:
    def text_of(coverage: float) -> str:
        told = []
        for run, error, share in zip(runs, (0.03, 0.04), (coverage, 1.0), strict=True):
            metrics = {**run.result["metrics"], "depth_absrel": error, "depth_coverage": share}
            told.append(replace(run, result={**run.result, "metrics": metrics}))
        return Page(build_run_comparison(inputs.sequence, told, views=1)).text

    assert "Depth AbsRel ↓ 0.030 best +0.010 worse 0.040" in text_of(1.0)
    other = text_of(0.9)
    assert "Depth AbsRel ↓ 0.030 +0.010 over other pixels 0.040" in other
    assert "Depth coverage ↑ 0.900 +0.100 better 1.000 best" in other


def test_an_imported_scene_may_have_seen_the_views(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    theirs = replace(runs[1], name="theirs", imported=True)
    text = Page(build_run_comparison(inputs.sequence, [runs[0], theirs], views=1)).text
    assert "not known of imported scenes, which are not marked as best: theirs." in text
    assert "The highest PSNR is that of 3dgs, 20.00 dB." in text
    assert "22.50 best" not in text


def test_a_tie_names_the_first(inputs: ReportInputs, runs: list[ComparedRun]) -> None:
    again = replace(runs[0], name="again", result=result_of(20.0001, 1000))
    text = Page(build_run_comparison(inputs.sequence, [runs[0], again], views=1)).text
    assert "The highest PSNR is that of 3dgs, 20.00 dB." in text


def test_long_names_of_a_matrix_leave_room_for_the_lines(
    inputs: ReportInputs, runs: list[ComparedRun]
) -> None:
    """Where a legend takes all of it, matplotlib warns, which is an error here."""
    names = [f"coarse.iterations = {n}, coarse.max_gaussians = {m}" for n in (150, 300) for m in (20, 40)]
    many = [replace(runs[0], name=name) for name in names]
    page = Page(build_run_comparison(inputs.sequence, many, views=1))
    tables = [lines(link) for link in page.links if link.startswith("data:")]
    (views,) = [table for table in tables if "frame" in table[0]]
    assert set(views[0]) == {"frame", *names}
