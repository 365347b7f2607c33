"""Outcomes as Markdown tables, for Prefect artifacts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from extrags.metrics.registry import Figure, figures, metric_named
from extrags.pipeline import HELD_OUT_TRAINED_ON
from flows.history import Judgement
from flows.outcome import SequenceOutcome
from flows.printable import in_one_line

__all__ = [
    "benchmark_markdown",
    "dataset_markdown",
    "difference_figures",
    "difference_text",
    "figure",
    "judgement_markdown",
    "markdown_table",
    "sequence_markdown",
    "spread_text",
    "table_figures",
]


def table_figures(*trees: Mapping[str, Any] | None) -> list[str]:
    """Names of the figures in tables of runs with these metrics; narrow tables show the first few."""
    return _asked_for(figures("tables"), trees)


def difference_figures(*trees: Mapping[str, Any] | None) -> list[str]:
    """Names of the figures whose differences between methods are shown, for runs with these metrics."""
    return _asked_for(figures("differences"), trees)


def _asked_for(shown: Sequence[Figure], trees: Sequence[Mapping[str, Any] | None]) -> list[str]:
    """All but LPIPS with a backbone that no run was asked to measure."""
    return [
        item.name
        for item in shown
        if metric_named(item.key).lpips_net is None or any(item.key in (tree or {}) for tree in trees)
    ]


def figure(name: str, value: float | None) -> str:
    """Format a metric with its number of digits; a dash for None."""
    return "–" if value is None else f"{value:.{_digits(name)}f}"  # noqa: RUF001


def _count(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}"  # noqa: RUF001


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_cell(value) for value in line) + " |" for line in lines)


def _cell(value: Any) -> str:
    return in_one_line(str(value)).replace("|", "\\|")


def sequence_markdown(outcome: SequenceOutcome) -> str:
    """Stages, metrics and where the report is."""
    from extrags.metrics.comparison import figure_of

    stages = markdown_table(
        ["stage", "state", "seconds", "made in", "reason"],
        [
            [row.stage, row.state, f"{row.seconds:.1f}", f"{row.made_seconds:.1f}", row.reason]
            for row in outcome.stages
        ],
    )
    columns = table_figures(*outcome.metrics.values())
    metrics = markdown_table(
        ["scene", *columns, "Gaussians"],
        [
            [
                which,
                *(figure(name, figure_of(tree, name)) for name in columns),
                _count(tree.get("n_gaussians")),
            ]
            for which, tree in outcome.metrics.items()
            if tree is not None
        ],
    )
    where = f"Report: `{outcome.report}`" if outcome.report else "No report was made."
    return f"## {in_one_line(outcome.name)}: {outcome.status}\n\n{metrics}\n\n{stages}\n\n{where}\n"


def dataset_markdown(outcomes: Sequence[SequenceOutcome]) -> str:
    """One row per sequence: coarse and final figures, or why it failed."""
    from extrags.metrics.comparison import figure_of

    columns = table_figures(*(tree for outcome in outcomes for tree in outcome.metrics.values()))[:3]
    rows = []
    for outcome in outcomes:
        coarse, final = (outcome.metrics.get(which) or {} for which in ("coarse", "final"))
        failed = next((row for row in outcome.stages if row.state == "failed"), None)
        rows.append(
            [
                outcome.title,
                outcome.status,
                f"{outcome.seconds:.1f}",
                *(
                    f"{figure(name, figure_of(coarse, name))} → {figure(name, figure_of(final, name))}"
                    for name in columns
                ),
                "" if failed is None else f"{failed.stage}: {failed.reason}",
            ]
        )
    return markdown_table(["sequence", "status", "seconds", *columns, "problem"], rows)


def judgement_markdown(found: Judgement) -> str:
    """What is worse than in earlier runs of a benchmark, and what was not judged; empty where nothing is."""
    parts = (("Worse than before", found.regressions), ("Not judged", found.not_judged))
    return "".join(
        f"\n## {title}\n\n" + "\n".join(f"* {line}" for line in lines) + "\n"
        for title, lines in parts
        if lines
    )


def benchmark_markdown(cases: Sequence[dict[str, Any]], baseline: str) -> str:
    """Paired differences of each dataset, spread of each sequence, and one row per run."""
    from extrags.metrics.comparison import CEILING, compare_runs, figure_of

    comparison = compare_runs(cases, baseline)
    trees = [case["metrics"] for case in cases]
    columns, differences = table_figures(*trees), difference_figures(*trees)

    def by_dataset(rows: str, text: Callable[[str, dict[str, Any] | None], str]) -> str:
        return markdown_table(
            ["dataset", "profile", "method", "sequences", *differences],
            [
                [
                    row["dataset"],
                    row["profile"],
                    row["method"],
                    row["n_sequences"],
                    *(text(name, row["figures"].get(name)) for name in differences),
                ]
                for row in comparison[rows]
            ],
        )

    paired = by_dataset("paired_datasets", difference_text)
    spread = markdown_table(
        ["sequence", "setting", "profile", "method", "seeds", *columns],
        [
            [
                row["sequence"],
                row["setting"] or "",
                row["profile"],
                row["method"],
                row["n_seeds"],
                *(spread_text(name, row["figures"].get(name)) for name in columns),
            ]
            for row in comparison["sequences"]
        ],
    )
    runs = markdown_table(
        ["sequence", "setting", "profile", "method", "seed", "seconds", "MiB", *columns, "problem"],
        [
            [
                case["sequence"],
                case["setting"] or "",
                case["profile"],
                case["method"],
                case["seed"],
                f"{case['seconds']:.1f}",
                "" if case["peak_mib"] is None else f"{case['peak_mib']:.0f}",
                *(figure(name, figure_of(case["metrics"] or {}, name)) for name in columns),
                case["error"],
            ]
            for case in cases
        ],
    )
    ceiling = by_dataset("ceiling_datasets", share_text)
    shares = (
        f"## Share of the way from {baseline} to {CEILING}\n\n"
        "Of means over sequences, and its 95 % interval.\n\n"
        f"{ceiling}\n\n"
        if comparison["ceiling_datasets"]
        else ""
    )
    seen = sorted({case["method"] for case in cases if case["held_out_trained_on"]})
    warning = f"{HELD_OUT_TRAINED_ON} in {', '.join(seen)}.\n\n" if seen else ""
    return (
        f"{warning}## Differences to {baseline}\n\nMean over sequences and its 95 % interval.\n\n{paired}\n\n"
        f"{shares}"
        f"## Spread over seeds\n\n{spread}\n\n## Runs\n\n{runs}\n"
    )


def difference_text(name: str, found: dict[str, Any] | None) -> str:
    """A mean difference with its sign, and the interval if there is one."""
    if found is None:
        return figure(name, None)
    digits = _digits(name)
    text = f"{found['mean']:+.{digits}f}"
    return (
        text if found["low"] is None else f"{text} [{found['low']:+.{digits}f}, {found['high']:+.{digits}f}]"
    )


def share_text(name: str, found: dict[str, Any] | None) -> str:
    """A share in per cent, and its 95 % interval if there are several sequences."""
    if found is None:
        return figure(name, None)
    text = f"{100 * found['mean']:.0f} %"
    if found["low"] is None:
        return text
    return f"{text} ({100 * found['low']:.0f} to {100 * found['high']:.0f})"


def spread_text(name: str, found: dict[str, Any] | None) -> str:
    """A mean, and the deviation if there is one."""
    if found is None or found["deviation"] is None:
        return figure(name, None if found is None else found["mean"])
    return f"{figure(name, found['mean'])} ± {figure(name, found['deviation'])}"


def _digits(name: str) -> int:
    return metric_named(name.rpartition(".")[2]).table_digits
