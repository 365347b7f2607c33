"""How far a training in float32 drifts from one in float64, drawn over the iterations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from extrags.report.charts import METHOD_COLORS, drawing_style, write_figure
from extrags.stress.optimiser import Drift

__all__ = ["write_drift_plot"]


def write_drift_plot(trainings: Mapping[str, Sequence[Drift]], path: Path) -> None:
    """Two panels: distance of the parameters, and difference of the loss.

    Args:
        trainings: by label, what `training_drift` returns.
        path: the file; its suffix (`.png`, `.svg`, `.pdf`) names the format.

    Raises:
        ConfigError: for a file that cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with drawing_style():
        figure = Figure(figsize=(8.6, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, 2)
        for index, (label, drifts) in enumerate(trainings.items()):
            color, at = METHOD_COLORS[index % len(METHOD_COLORS)], [drift.iteration for drift in drifts]
            for panel, single, other in (
                (panels[0], "float32_parameters", "other_parameters"),
                (panels[1], "float32_loss", "other_loss"),
            ):
                panel.plot(at, [getattr(d, single) for d in drifts], color=color, label=f"{label}, float32")
                # The neighbours that any training has: they tell how chaotic this one is.
                neighbour = [getattr(d, other) for d in drifts]
                panel.plot(
                    at, neighbour, color=color, linestyle=(0, (4, 3)), label=f"{label}, a rounding away"
                )
        for panel, title in zip(panels, ("parameters, share of their way", "loss, relative"), strict=True):
            panel.set(xscale="log", yscale="log", title=f"Difference from float64: {title}")
            panel.set_xlabel("iterations")
            panel.grid(visible=True, axis="both")
        panels[0].legend(loc="upper left")
        write_figure(figure, path)
