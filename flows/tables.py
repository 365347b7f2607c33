"""Outcomes as Markdown tables, for Prefect artifacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flows.outcome import SequenceOutcome

__all__ = ["METRICS", "dataset_markdown", "figure", "markdown_table", "sequence_markdown"]

METRICS = ("psnr", "ssim", "lpips_alex", "flip", "depth_absrel")
_DIGITS = {"psnr": 2}


def figure(name: str, value: float | None) -> str:
    """A metric with the digits it deserves; a dash where it cannot be had."""
    return "–" if value is None else f"{value:.{_DIGITS.get(name, 4)}f}"  # noqa: RUF001


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_cell(value) for value in line) + " |" for line in lines)


def _cell(value: Any) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")


def sequence_markdown(outcome: SequenceOutcome) -> str:
    """Stages, metrics and where the report is."""
    stages = markdown_table(
        ["stage", "state", "seconds", "made in", "reason"],
        [
            [row.stage, row.state, f"{row.seconds:.1f}", f"{row.made_seconds:.1f}", row.reason]
            for row in outcome.stages
        ],
    )
    metrics = markdown_table(
        ["scene", *METRICS, "Gaussians"],
        [
            [which, *(figure(name, tree.get(name)) for name in METRICS), tree.get("n_gaussians", "")]
            for which, tree in outcome.metrics.items()
            if tree is not None
        ],
    )
    where = f"Report: `{outcome.report}`" if outcome.report else "No report was made."
    return f"## {outcome.name}: {outcome.status}\n\n{metrics}\n\n{stages}\n\n{where}\n"


def dataset_markdown(outcomes: Sequence[SequenceOutcome]) -> str:
    """One row per sequence: coarse and final figures, or why it failed."""
    rows = []
    for outcome in outcomes:
        coarse, final = (outcome.metrics.get(which) or {} for which in ("coarse", "final"))
        failed = next((row for row in outcome.stages if row.state == "failed"), None)
        rows.append(
            [
                outcome.name,
                outcome.status,
                f"{outcome.seconds:.1f}",
                *(
                    f"{figure(name, coarse.get(name))} → {figure(name, final.get(name))}"
                    for name in METRICS[:3]
                ),
                "" if failed is None else f"{failed.stage}: {failed.reason}",
            ]
        )
    return markdown_table(["sequence", "status", "seconds", *METRICS[:3], "problem"], rows)
