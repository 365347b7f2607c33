"""What the assessment of a scene measured, in words and with units, for pages and the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from extrags.report.wording import count

__all__ = ["measured_figure", "measurement_rows"]

Kind = Literal["share", "count", "number", "length", "pixels"]

_LABELS: dict[str, tuple[str, Kind]] = {
    "lacking_share": ("What nearby views lack: holes, and unresolved surface by its weight", "share"),
    "hole_share": ("Holes in nearby views", "share"),
    "unresolved_share": ("Unresolved surface in nearby views", "share"),
    "worst_probe_lacking_share": ("What the worst nearby view lacks", "share"),
    "training_hole_share": ("Holes in the training views", "share"),
    "gaussians": ("Gaussians", "count"),
    "gaussians_unseen_share": ("Gaussians that no training view sees", "share"),
    "directions_mean": ("Directions that see a Gaussian, mean", "number"),
    "directions_median": ("Directions that see a Gaussian, median", "number"),
    "coverage_share": ("Covered (Gaussian, direction) pairs", "share"),
    "depth_unit_mm": ("Median depth of the training views", "length"),
    "training_views": ("Training views", "count"),
    "pixels": ("Pixels of a training view", "count"),
    "width": ("Width of a training view", "pixels"),
    "probe_views": ("Nearby views that were rendered", "count"),
}
"""Of the measurements of `extrags.assessment.measure`."""


def measurement_rows(measurements: Mapping[str, float], *, metric: bool) -> list[tuple[str, str]]:
    """Label and value of each measurement; one without a label stands under its own name.

    Args:
        measurements: of a scene plan.
        metric: whether lengths of the scene are millimetres.
    """
    rows = []
    for name, value in measurements.items():
        label, kind = _LABELS.get(name, (name.replace("_", " "), "number"))
        unit = {"share": " %", "pixels": " px", "length": " mm" if metric else " units of the scene"}
        figure = f"{100 * value:.2f}" if kind == "share" else measured_figure(value)
        rows.append((label, figure + unit.get(kind, "")))
    return rows


def measured_figure(value: float | int) -> str:
    """A measured number: whole ones as counts, others with four digits."""
    return count(value) if float(value).is_integer() else f"{float(value):.4g}"
