from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from extrags.metrics.fronts import fronts, means_by_cell
from extrags.report import ReportInputs, charts
from extrags.report.chart_labels import LONGEST_LABEL, row_labels
from extrags.report.charts import (
    COARSE_COLOR,
    FINAL_COLOR,
    METHOD_COLORS,
    WORSE_COLOR,
    method_colors,
    method_marks,
    methods_chart,
    pairs_chart,
    sequences_chart,
)
from extrags.report.downloads import Chart
from extrags.report.fronts_plot import write_fronts_plot
from extrags.report.run_comparison import ComparedRun, build_run_comparison
from extrags.report.trend import trend_chart
from tests.extrags.metrics.test_fronts import case
from tests.extrags.report.conftest import result_of


def svg(chart: Chart) -> str:
    return base64.b64decode(chart.uri.partition("base64,")[2]).decode()


def chart_of(name: str) -> str:
    values = np.array([20.0, 21.0])
    return svg(sequences_chart([name, "phantom/0"], values, values + 1, values))


class TestLettersOfOtherScripts:
    @pytest.fixture
    def fonts(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
        """Chooses the further fonts of this machine."""

        def chosen(*names: str) -> None:
            monkeypatch.setattr(charts, "_FURTHER_FONTS", names)
            forget()

        def forget() -> None:
            charts._families.cache_clear()
            charts._letters.cache_clear()

        yield chosen
        forget()

    def test_text_stays_text_where_no_font_has_them(self, fonts: Callable[..., None]) -> None:
        """Its letters were drawn as boxes."""
        fonts()
        drawn = chart_of("结肠/腸")
        assert "结肠/腸</text>" in drawn
        assert "sans-serif" in drawn
        assert "<text" not in chart_of("côlon/Darm/кишка")

    def test_another_font_has_them(self, fonts: Callable[..., None]) -> None:
        letter = "\u1d81"  # In a font that comes with matplotlib, and not in that of charts.
        fonts()
        assert f"{letter}</text>" in chart_of(letter)
        fonts("No Such Font", "STIXGeneral")
        assert "<text" not in chart_of(letter)

    @pytest.mark.parametrize("kind", ["png", "svg"])
    def test_images_of_bench_are_drawn_alike(
        self, kind: str, fonts: Callable[..., None], tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Warnings are errors: matplotlib gave one for each letter, and drew boxes in SVG, too."""
        fonts()
        cells = means_by_cell([{**case("a", 10, 20), "sequence": "结肠\x07"}])
        write_fronts_plot({"cells": cells, "fronts": fronts(cells)}, tmp_path / f"a.{kind}")
        assert ("no font here has all letters" in caplog.text) == (kind == "png")
        if kind == "svg":
            assert r"结肠\x07" in (tmp_path / "a.svg").read_text()


def numbers(chart: Chart) -> list[str]:
    """Lines of its CSV, without the first."""
    return base64.b64decode(chart.csv.partition("base64,")[2]).decode().splitlines()[1:]


@pytest.mark.parametrize("count", [2, 6, 11])
def test_any_number_of_methods_can_be_told_apart(count: int) -> None:
    """Warnings are errors: nothing is drawn past the axes, and no layout is given up."""
    methods = [f"method-{number}" for number in range(count)]
    groups = ["phantom/0@sparse", "x" * 120, "cost$_$x"]
    drawn = {method: {group: [20.0, 21.0] for group in groups} for method in methods}
    colors = method_colors(methods, methods[0])
    chart = methods_chart(groups, drawn, drawn, colors, "PSNR (dB)")
    assert len(numbers(chart)) == 2 * count * len(groups)
    assert (len(set(colors.values())) < count) == (count > len(METHOD_COLORS) + 1)
    marks = method_marks(colors)
    assert len({(colors[method], marks[method]) for method in methods}) == count


@pytest.fixture
def marked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, str]]:
    """Colour, mark and label of every line and scatter that is drawn."""
    from matplotlib.axes import Axes

    found: list[tuple[str, str, str]] = []

    def noting(drawn: Callable[..., Any]) -> Callable[..., Any]:
        def noted(self: Axes, *given: Any, **style: Any) -> Any:
            if style.get("label"):
                found.append((style["color"], style["marker"], style["label"]))
            return drawn(self, *given, **style)

        return noted

    for name in ("plot", "scatter"):
        monkeypatch.setattr(Axes, name, noting(getattr(Axes, name)))
    return found


class TestLooksOfManyDiffer:
    NAMES = tuple(f"run-{number}" for number in range(2 * len(METHOD_COLORS) + 1))

    def check(self, marked: list[tuple[str, str, str]]) -> None:
        looks = {label: (color, mark) for color, mark, label in marked}
        assert tuple(looks) == self.NAMES
        assert len(set(looks.values())) == len(self.NAMES)

    def test_compared_runs(self, inputs: ReportInputs, marked: list[tuple[str, str, str]]) -> None:
        assert inputs.final is not None
        rgb = inputs.final.rgb
        runs = [ComparedRun(name, rgb, result_of(20.0, 10)) for name in self.NAMES]
        build_run_comparison(inputs.sequence, runs, views=1)
        self.check(marked)

    def test_the_trend(self, marked: list[tuple[str, str, str]]) -> None:
        one = {name: {"psnr": 20.0, "seconds": 1.0} for name in self.NAMES}
        entries = [{"when": f"2026-01-0{day}T00:00:00+00:00", "methods": one} for day in (1, 2)]
        trend_chart(entries, method_colors(self.NAMES, self.NAMES[0]))
        self.check(marked)

    def test_fronts(self, tmp_path: Path, marked: list[tuple[str, str, str]]) -> None:
        scene = {"sequence": "p/0", "setting": "", "width": 8, "height": 8}
        cells = [
            {**scene, "method": name, "processor_seconds": 1.0, "figures": {"psnr": 20.0}}
            for name in self.NAMES
        ]
        write_fronts_plot({"cells": cells, "fronts": []}, tmp_path / "fronts.svg", names=("psnr",))
        self.check(marked)


def test_no_difference_has_the_colour_of_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.axes import Axes

    colors: list[str] = []
    monkeypatch.setattr(Axes, "scatter", lambda self, *given, **style: colors.append(style["color"]))
    panels = [("PSNR (dB)", True), ("LPIPS", False)]
    pairs_chart(panels, [(str(mean), [(mean, None, None)] * 2) for mean in (1.0, 0.0, -1.0)])
    assert colors == [FINAL_COLOR, COARSE_COLOR, WORSE_COLOR, WORSE_COLOR, COARSE_COLOR, FINAL_COLOR]


def test_names_may_be_long_and_have_any_letters() -> None:
    values = np.array([20.0, 21.0, 22.0])
    chart = sequences_chart(["a" * 150, "cost$_$x", "b_{$"], values, values + 1, values)
    assert [line.split(",")[0] for line in numbers(chart)] == ["a" * 150, "cost$_$x", "b_{$"]


@pytest.mark.parametrize("letter", ["\x1b", "\x07", "\x00", "\x9b", "\uffff"])
def test_letters_that_no_svg_may_hold(letter: str) -> None:
    """A chart with one of them in it is no XML, and no browser shows it."""
    drawn = {f"3dgs{letter}": {f"a{letter}b": [20.0]}}
    chart = methods_chart([f"a{letter}b"], drawn, drawn, {f"3dgs{letter}": FINAL_COLOR}, f"PSNR{letter}")
    ElementTree.fromstring(base64.b64decode(chart.uri.partition("base64,")[2]))


class TestLabelsOfRows:
    def test_each_in_one_line(self) -> None:
        assert row_labels(["a\nb", "a\x1b[2J"]) == ["a\\nb", "a\\x1b[2J"]
        alike = row_labels([f"\n{'x' * 60}{number}\n" for number in range(2)])
        assert len(set(alike)) == 2
        assert "\n" not in "".join(alike)

    def test_what_runs_differ_in_is_kept(self) -> None:
        names = [f"phantom/11@sparse, seed {seed} [coarse.iterations=150]" for seed in (0, 1)]
        assert row_labels(names) == [
            "phantom/11@sparse, seed 0 [coarse…ns=150]",
            "phantom/11@sparse, seed 1 [coarse…ns=150]",
        ]

    @pytest.mark.parametrize(
        "names",
        [
            [f"{'a' * 60}{middle * 50}{'z' * 60}" for middle in "mno"],
            [f"{'a' * 60}{'x' * number}" for number in range(4)],
            [f"{'a' * 30}{'m' * 40}{letter}{'m' * 40}{'z' * 30}" for letter in "pqr"],
            [f"{'a' * 70} (2)", "a" * 74, f"{'a' * 73}b"],
            ["short", "x" * 41, "x" * 42, "x" * 43],
        ],
    )
    def test_different_names_have_different_labels(self, names: list[str]) -> None:
        labels = row_labels(names)
        assert len(set(labels)) == len(names)
        assert max(map(len, labels)) <= LONGEST_LABEL

    def test_short_names_stay_and_equal_ones_are_equal(self) -> None:
        assert row_labels(["a", "b", "a"]) == ["a", "b", "a"]
        assert row_labels(["x" * 100] * 2) == [f"{'x' * 20}…{'x' * 20}"] * 2
