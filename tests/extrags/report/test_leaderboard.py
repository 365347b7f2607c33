"""The leaderboard: who is best where, and what a mean is over."""

from __future__ import annotations

from dataclasses import replace

import pytest

from extrags.report.leaderboard import BoardRow, build_leaderboard
from tests.extrags.report.conftest import metrics_of
from tests.extrags.report.pages import Page
from tests.extrags.report.test_downloads import lines


def row(sequence: str, method: str, psnr: float, **more: str) -> BoardRow:
    ended = "2026-11-23T12:00:00+00:00"
    return BoardRow(sequence, method, "quick", ended=ended, seconds=60, metrics=metrics_of(psnr), **more)  # type: ignore[arg-type]


ROWS = [
    row("phantom/1", "3dgs", 20.0, seed="0"),
    row("phantom/1", "extrags", 23.0, seed="0"),
    row("phantom/1", "extrags", 25.0, seed="1", link="file:///store/report.html"),
    row("phantom/2", "3dgs", 22.0),
    row("phantom/2", "extrags", 21.0),
    row("c3vd/cecum", "extrags", 40.0),
    BoardRow("c3vd/cecum", "3dgs", "quick", status="failed", reason="coarse: out of memory", ended="2026"),
    row("phantom/1", "3dgs", 20.0, seed="1"),
]


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(build_leaderboard(ROWS))


def test_cells_are_means_over_seeds_and_the_best_is_marked(page: Page) -> None:
    assert "phantom/1 20.00 ± 0.00 24.00 best ± 1.41" in page.text
    assert "phantom/2 22.00 best 21.00" in page.text


def test_means_are_over_sequences_that_every_method_has(page: Page) -> None:
    assert "Mean of the 2 sequences that all methods have 21.00 22.50" in page.text


def test_of_other_seeds_nothing_is_the_best() -> None:
    """Whose hard seeds failed has the better mean."""
    told = "Not all methods have figures of the same seeds on phantom/1 (quick): none is marked as best there"
    lacking = [*ROWS[:5], replace(ROWS[-1], status="failed", metrics=None)]
    page = Page(build_leaderboard(lacking))
    assert told in page.text
    assert "phantom/1 20.00 24.00 ± 1.41" in page.text
    assert "phantom/2 22.00 best 21.00" in page.text
    assert "all methods have 21.00 22.50 " in page.text
    assert "22.50 best" not in page.text
    assert "same seeds on" not in Page(build_leaderboard(ROWS)).text
    # An oracle is no rival, whatever its seeds.
    oracle = replace(ROWS[0], method="oracle", held_out_trained_on=True)
    assert "same seeds on" not in Page(build_leaderboard([*ROWS, oracle])).text


def test_failures_are_listed_with_their_reason(page: Page) -> None:
    assert "Failed 1" in page.text
    assert "failed coarse: out of memory" in page.text


def test_figures_that_nobody_measured_have_no_table(page: Page) -> None:
    assert "LPIPS (VGG)" not in page.text
    assert (
        "Never observed" not in page.text.split("How the numbers are taken")[0] or "unseen" not in page.text
    )


def test_profiles_are_not_mixed() -> None:
    html = build_leaderboard([ROWS[0], replace(ROWS[0], profile="paper", metrics=metrics_of(30.0))])
    boards = html.split('<div class="board"')[1:]
    psnr = [board for board in boards if 'data-figure="psnr"' in board]
    assert [('data-profile="paper"' in board, "30.00" in board) for board in psnr] == [
        (True, True),
        (False, False),
    ]


def test_settings_of_a_matrix_are_columns_of_their_own() -> None:
    changed = replace(ROWS[0], settings="coarse.iterations = 500", metrics=metrics_of(19.0))
    assert "3dgs, coarse.iterations = 500" in Page(build_leaderboard([ROWS[0], changed])).text


def test_further_settings_stand_with_each_run() -> None:
    """They do not set runs apart, so that who reads the tables has to be told of them."""
    further = "coarse.iterations = 500"
    rows = [ROWS[0], replace(ROWS[4], further=further)]
    page = Page(build_leaderboard(rows))
    assert f"extrags {further} quick" in page.text
    assert "Not all runs had the same further settings" in page.text
    (file,) = (lines(link) for link in page.links if link.startswith("data:"))
    assert [line["further_settings"] for line in file] == ["", further]
    same = Page(build_leaderboard([replace(row, further=further) for row in rows]))
    assert "Not all runs" not in same.text


def test_several_versions_of_the_protocol_are_told_of() -> None:
    told = "Figures are of several versions of the evaluation protocol"
    assert told not in Page(build_leaderboard(ROWS)).text
    newer = [replace(item, protocol=7) for item in ROWS]
    assert told not in Page(build_leaderboard(newer)).text
    mixed = Page(build_leaderboard([replace(ROWS[0], protocol=6), *newer[1:]])).text
    assert f"{told} (6, 7)" in mixed
    assert (
        f"{told} (7 and of earlier ones that are not on record)"
        in Page(build_leaderboard([ROWS[0], *newer[1:]])).text
    )


@pytest.mark.parametrize(
    ("sequence", "dataset"),
    [
        ("phantom/1@sparse", "phantom"),
        ("/data/video.mp4", "files"),
        ("frames/", "frames"),
        ("video.mp4", "files"),
        ("./a/b", "files"),
    ],
)
def test_datasets(sequence: str, dataset: str) -> None:
    assert BoardRow(sequence, "extrags", "quick").dataset == dataset


def test_all_runs_as_csv(page: Page) -> None:
    (file,) = (lines(link) for link in page.links if link.startswith("data:"))
    assert len(file) == len(ROWS)
    assert file[2]["psnr"] == "25"
    assert file[2]["seed"] == "1"
    assert file[6]["reason"] == "coarse: out of memory"
    assert file[6]["psnr"] == ""


def test_names_are_escaped_and_nothing_is_loaded() -> None:
    html = build_leaderboard([replace(ROWS[0], sequence='a"><script>alert(1)</script>')])
    assert "<script>alert" not in html
    assert Page(html).loads == []


def test_no_runs_no_tables() -> None:
    assert "No run is on record" in Page(build_leaderboard([])).text


def test_what_has_seen_the_views_is_never_the_best() -> None:
    seen = replace(row("phantom/0@sparse", "oracle", 30.0), held_out_trained_on=True)
    page = Page(build_leaderboard([row("phantom/0@sparse", "extrags", 25.0), seen]))
    assert "Held-out frames were trained on in oracle, which is never marked as best" in page.text
    assert "30.00 best" not in page.text


def test_no_error_of_depth_is_the_best_over_other_pixels() -> None:
    def covered(method: str, error: float, coverage: float) -> BoardRow:
        metrics = metrics_of(20.0) | {"depth_absrel": error, "depth_coverage": coverage}
        return replace(row("phantom/1", method, 20.0), metrics=metrics)

    def depth_board(coverage: float) -> str:
        html = build_leaderboard([covered("3dgs", 0.03, coverage), covered("extrags", 0.04, 1.0)])
        boards = html.split('<div class="board"')[1:]
        return next(board for board in boards if 'data-figure="depth_absrel"' in board)

    assert "best" in depth_board(1.0)
    assert "best" not in depth_board(0.9)


def test_an_imported_scene_is_never_the_best() -> None:
    theirs = replace(
        row("phantom/0@sparse", "extrags", 30.0), settings="imported.scene = a.ply", imported=True
    )
    page = Page(build_leaderboard([row("phantom/0@sparse", "extrags", 25.0), theirs]))
    assert "not marked as best either: extrags, imported.scene = a.ply." in page.text
    assert "30.00 best" not in page.text
