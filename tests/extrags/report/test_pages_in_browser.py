"""What the scripts of the pages do, in headless Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from extrags.config import ReportConfig
from extrags.report import ReportInputs, build_report
from extrags.report.leaderboard import build_leaderboard
from tests.browser import Browser, browser
from tests.extrags.report.test_leaderboard import ROWS

pytestmark = pytest.mark.slow

VISIBLE = "[...document.querySelectorAll('#runs tbody tr')].filter((row) => !row.hidden)"
FIRST = ".map((row) => row.cells[0].textContent.trim() + ' ' + row.cells[1].textContent)"


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser") / "profile") as opened:
        opened.window(1280, 900)
        yield opened


@pytest.fixture
def board(tab: Browser, tmp_path: Path) -> Browser:
    (tmp_path / "board.html").write_text(build_leaderboard(ROWS), encoding="utf-8")
    tab.open(tmp_path / "board.html")
    return tab


def choose(tab: Browser, form: str, name: str, value: str) -> None:
    place = f'document.querySelector(\'[data-for="{form}"] [data-choose="{name}"]\')'
    tab.run(
        f"{place}.value = '{value}'; {place}.dispatchEvent(new Event('input', {{ bubbles: true }})); true"
    )


def test_runs_are_filtered(board: Browser) -> None:
    choose(board, "runs", "dataset", "c3vd")
    assert board.run(VISIBLE + FIRST) == ["c3vd/cecum extrags", "c3vd/cecum 3dgs"]
    choose(board, "runs", "status", "ok")
    assert board.run(VISIBLE + ".length") == 1
    assert "1 of 7 runs" in board.run("document.querySelector('[data-part=count]').textContent")


def test_runs_are_sorted_both_ways_and_what_is_missing_stands_last(board: Browser) -> None:
    head = "document.querySelectorAll('#runs thead th')[5]"
    board.run(f"{head}.querySelector('button').click()")
    assert board.run(f"{head}.getAttribute('aria-sort')") == "descending"
    values = "[...document.querySelectorAll('#runs tbody tr')].map((row) => row.cells[5].dataset.value)"
    assert board.run(values) == ["40.0", "25.0", "23.0", "22.0", "21.0", "20.0", ""]
    board.run(f"{head}.querySelector('button').click()")
    assert board.run(values) == ["20.0", "21.0", "22.0", "23.0", "25.0", "40.0", ""]


def test_one_figure_is_shown_at_a_time(board: Browser) -> None:
    shown = "[...document.querySelectorAll('.board')].filter((b) => !b.hidden).map((b) => b.dataset.figure)"
    assert board.run(shown) == ["psnr"]
    choose(board, "boards", "figure", "ssim")
    assert board.run(shown) == ["ssim"]
    # The mean is over all sequences: it goes where only some are shown.
    choose(board, "boards", "dataset", "c3vd")
    foot = "document.querySelector('.board:not([hidden]) tfoot').hidden"
    assert board.run(foot) is True


@pytest.fixture(scope="module")
def html(inputs: ReportInputs) -> str:
    return build_report(inputs, ReportConfig(held_out_views=1, virtual_views=2, viewer_mb=0))


@pytest.fixture
def report(tab: Browser, html: str, tmp_path: Path) -> Browser:
    (tmp_path / "report.html").write_text(html, encoding="utf-8")
    tab.open(tmp_path / "report.html")
    return tab


def test_charts_are_saved_as_they_are_drawn(report: Browser) -> None:
    links = report.run(
        "[...document.querySelectorAll('a[download$=\".svg\"]')].map((link) => "
        "link.href === link.closest('figure').querySelector('img').src && link.href.slice(0, 18))"
    )
    assert len(links) >= 3
    assert set(links) == {"data:image/svg+xml"}


def test_on_paper_everything_is_unfolded(report: Browser) -> None:
    folded = "document.querySelectorAll('details:not([open])').length"
    before = report.run(folded)
    assert before > 0
    report.run("dispatchEvent(new Event('beforeprint')); true")
    assert report.run(folded) == 0
    report.run("dispatchEvent(new Event('afterprint')); true")
    assert report.run(folded) == before


@pytest.mark.parametrize("width", [390, 700, 820, 1000, 1280])
def test_no_picture_stands_alone_in_its_row(report: Browser, width: int) -> None:
    report.window(width, 900)
    try:
        alone = report.run(
            "[...document.querySelectorAll('.strip')].filter((strip) => {"
            "  const tops = [...strip.children].map((cell) => Math.round(cell.getBoundingClientRect().top));"
            "  return tops.some((top) => tops.filter((other) => other === top).length === 1);"
            "}).length"
        )
        assert alone == 0
        assert report.run("document.documentElement.scrollWidth <= innerWidth")
    finally:
        report.window(1280, 900)


def test_what_scrolls_is_reached_with_the_keyboard(report: Browser) -> None:
    report.window(390, 844)
    try:
        assert (
            report.run(
                "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done("
                "[...document.querySelectorAll('.scroll, .chart, nav ul')]"
                ".filter((box) => box.scrollWidth > box.clientWidth + 1 && box.tabIndex !== 0).length))))"
            )
            == 0
        )
    finally:
        report.window(1280, 900)


def test_no_errors(tab: Browser) -> None:
    assert tab.errors == []
