from __future__ import annotations

import base64

import numpy as np
import pytest

from extrags.report.charts import METHOD_COLORS, method_colors, method_marks, methods_chart, sequences_chart
from extrags.report.downloads import Chart


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


def test_names_may_be_long_and_have_any_letters() -> None:
    values = np.array([20.0, 21.0, 22.0])
    chart = sequences_chart(["a" * 150, "cost$_$x", "b_{$"], values, values + 1, values)
    assert [line.split(",")[0] for line in numbers(chart)] == ["a" * 150, "cost$_$x", "b_{$"]
