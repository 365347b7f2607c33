"""How well restorers predict their own error: predicted against true, with the diagonal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from extrags.report.charts import METHOD_COLORS, QUIET, drawing_style, svg_image, write_figure
from extrags.report.encode import DataImage

__all__ = ["calibration_chart", "write_calibration_plot"]


def calibration_chart(curves: Mapping[str, Mapping[str, Any]]) -> DataImage:
    """The plot for a page.

    Args:
        curves: by label, what `extrags.restoration.uncertainty.reliability_diagram.calibration` returns.

    Raises:
        ConfigError: without any curve.
    """
    with drawing_style():
        return svg_image(_drawn(curves))


def write_calibration_plot(curves: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """The plot as an image file; its suffix (`.png`, `.svg`, `.pdf`) names the format.

    Args:
        curves: by label, what `extrags.restoration.uncertainty.reliability_diagram.calibration` returns.
        path: the file.

    Raises:
        ConfigError: without any curve, or for a file that cannot be written.
    """
    with drawing_style():
        write_figure(_drawn(curves), path)


def _drawn(curves: Mapping[str, Mapping[str, Any]]) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not curves:
        raise ConfigError("no restorer here predicts its error: there is no calibration to draw")
    figure = Figure(figsize=(4.8, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    longest = 0.0
    for index, (label, curve) in enumerate(curves.items()):
        color = METHOD_COLORS[index % len(METHOD_COLORS)]
        predicted, error, low, high = (
            [float(row[name]) for row in curve["bins"]] for name in ("predicted", "error", "low", "high")
        )
        longest = max([longest, *predicted, *high])
        axes.plot(predicted, error, marker="o", markersize=4, color=color, label=_named(label, curve))
        axes.fill_between(predicted, low, high, color=color, alpha=0.15, linewidth=0)
    longest = 1.05 * longest or 1.0
    axes.plot([0, longest], [0, longest], color=QUIET, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set(xlim=(0, longest), ylim=(0, longest), aspect="equal")
    axes.set_xlabel("predicted error")
    axes.set_ylabel("true error")
    axes.grid(visible=True, axis="both")
    if len(curves) == 1:
        ((label, curve),) = curves.items()
        axes.set_title(_named(label, curve))
    else:
        axes.set_title("Predicted and true error of restored cells")
        axes.legend(loc="upper left")
    return figure


def _named(label: str, curve: Mapping[str, Any]) -> str:
    rank = curve["rank_correlation"]
    return f"{label}: rank correlation {'-' if rank is None else f'{rank:.2f}'}"
