"""Run time against error: the cells of a grid and their Pareto fronts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from extrags.metrics.fronts import COSTS, SCENE
from extrags.metrics.registry import figures
from extrags.report.charts import QUIET, drawing_style, method_marks, run_colors, write_figure

__all__ = ["write_fronts_plot"]


def write_fronts_plot(
    document: Mapping[str, Any],
    path: Path,
    *,
    cost: str = "processor_seconds",
    names: Sequence[str] = ("psnr", "lpips_alex"),
) -> None:
    """Draw one row per scene and one panel per figure: a mark per cell, a line along the front.

    Args:
        document: JSON of a grid (`{cells, fronts}`).
        path: image file; its suffix (`.png`, `.svg`, `.pdf`) names the format.
        cost: on the horizontal axis; a key of `extrags.metrics.fronts.COSTS`.
        names: figures to draw; those that no cell has are left out.

    Raises:
        ConfigError: without any cell that has such a figure, or for a file that cannot be written.
    """
    cells = [cell for cell in document["cells"] if cell[cost] is not None]
    known = {figure.name: figure for figure in figures()}
    shown = [known[name] for name in names if any(name in cell["figures"] for cell in cells)]
    scenes = list(dict.fromkeys(tuple(cell[name] for name in SCENE) for cell in cells))
    if not shown or not scenes:
        raise ConfigError(f"no cell has {cost} and any of {', '.join(names)}: there is nothing to draw")
    methods = list(dict.fromkeys(cell["method"] for cell in cells))
    colors = run_colors(methods)
    marks = method_marks(colors)
    with drawing_style():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.6 * len(shown), 2.9 * len(scenes)), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(len(scenes), len(shown), squeeze=False)
        for row, scene in zip(grid, scenes, strict=True):
            inside = [cell for cell in cells if tuple(cell[name] for name in SCENE) == scene]
            for axes, metric in zip(row, shown, strict=True):
                for method in methods:
                    own = [
                        cell for cell in inside if cell["method"] == method and metric.name in cell["figures"]
                    ]
                    values = [cell["figures"][metric.name] for cell in own]
                    axes.scatter(
                        [cell[cost] for cell in own],
                        values,
                        s=22,
                        color=colors[method],
                        marker=marks[method],
                        label=method,
                    )
                line = _front(document["fronts"], scene, cost, metric.name)
                axes.step(
                    [point["cost"] for point in line],
                    [point["value"] for point in line],
                    where="post",
                    color=QUIET,
                    linewidth=1.2,
                    zorder=1.5,
                )
                sequence, setting, width, height = scene
                axes.set_title(f"{sequence}{f'@{setting}' if setting else ''}, {width}x{height}")
                axes.set_xlabel(COSTS[cost])
                axes.set_ylabel(metric.label)
                axes.set_xlim(left=0)
                axes.grid(visible=True, axis="both")
        grid[0][0].legend()
        write_figure(figure, path)


def _front(found: Sequence[Mapping[str, Any]], scene: tuple[Any, ...], cost: str, name: str) -> list[Any]:
    for entry in found:
        if tuple(entry[key] for key in SCENE) == scene and (entry["cost"], entry["figure"]) == (cost, name):
            return list(entry["front"])
    return []
