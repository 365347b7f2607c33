"""The trend of a benchmark: error and run time of each method over its runs."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import Any

from extrags.report.charts import drawing_style, method_marks, svg_image
from extrags.report.downloads import Chart

__all__ = ["trend_chart"]

PANELS = (("psnr", "PSNR (dB)"), ("seconds", "Run time (s)"))


def trend_chart(entries: Sequence[Mapping[str, Any]], colors: Mapping[str, str]) -> Chart | None:
    """PSNR and run time by date, one line per method; None for fewer than two runs.

    Args:
        entries: `{when, methods: {METHOD: {psnr, seconds}}}` of each run, the oldest first; `when` is ISO
            8601, values may be None.
        colors: of the methods.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    if len(entries) < 2:
        return None
    marks = method_marks(colors)
    with drawing_style():
        figure = Figure(figsize=(9.6, 2.8), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(1, len(PANELS))
        for panel, (key, title) in zip(axes, PANELS, strict=True):
            for method, color in colors.items():
                found = [
                    (datetime.datetime.fromisoformat(entry["when"]), entry["methods"][method][key])
                    for entry in entries
                    if entry["methods"].get(method, {}).get(key) is not None
                ]
                if found:
                    panel.plot(
                        [when for when, _ in found],
                        [value for _, value in found],
                        color=color,
                        marker=marks[method],
                        markersize=3.5,
                        linewidth=1.4,
                        label=method,
                    )
            panel.set_title(title)
            locator = AutoDateLocator()  # type: ignore[no-untyped-call]
            panel.xaxis.set_major_locator(locator)
            panel.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
        axes[1].set_ylim(bottom=0)
        axes[0].legend(loc="best")
        chart = svg_image(figure)
    keys = [key for key, _ in PANELS]
    rows = [
        [entry["when"], method, *(entry["methods"][method][key] for key in keys)]
        for entry in entries
        for method in colors
        if method in entry["methods"]
    ]
    return chart.with_numbers("trend", ["when", "method", *keys], rows)
