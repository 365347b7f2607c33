"""The summary tables of a run."""

from __future__ import annotations

from collections.abc import Sequence

from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from flows.outcome import DatasetOutcome, SequenceOutcome
from flows.tables import figure, table_figures
from flows.terminal import console

__all__ = ["print_failures", "print_outcomes", "print_plan"]


def print_outcomes(run: DatasetOutcome, seconds: float) -> None:
    """Print a table of results, one row per sequence; in a narrow terminal, one line per figure."""
    from extrags.metrics.comparison import figure_of

    out = console(error=True)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("sequence", overflow="fold")
    for column in ("status", "stages"):
        table.add_column(column)
    columns = table_figures(*(tree for outcome in run.sequences for tree in outcome.metrics.values()))[:4]
    for name in columns:
        table.add_column(name, justify="right")
    for outcome in run.sequences:
        coarse, final = (outcome.metrics.get(which) or {} for which in ("coarse", "final"))
        color = "green" if outcome.status == "ok" else "red"
        table.add_row(
            escape(outcome.title),
            f"[{color}]{outcome.status}[/]",
            _counts(outcome),
            *(_change(name, figure_of(coarse, name), figure_of(final, name)) for name in columns),
        )
        if restored := outcome.metrics.get("restored"):
            table.add_row(
                "[dim]  restored[/]",
                "",
                "",
                *(_change(name, figure_of(final, name), figure_of(restored, name)) for name in columns),
            )
    # No word is broken but a name, which may be folded to a third of the width.
    names = max((cell_len(outcome.title) for outcome in run.sequences), default=0)
    needed = Measurement.get(out, out.options.update(max_width=10_000), table).minimum
    if needed - max(0, names - out.width // 3) <= out.width:
        out.print(table)
    else:
        for outcome in run.sequences:
            _print_lines(out, outcome, columns)
    print_failures(run)
    for outcome in run.sequences:
        if outcome.report:
            out.print(f"report: {outcome.report}", soft_wrap=True, markup=False)
    if run.report and len(run.sequences) > 1:
        out.print(f"all together: {run.report}", soft_wrap=True, markup=False)
    out.print(f"{seconds:.1f} s in all")


def _counts(outcome: SequenceOutcome) -> str:
    """How many of its stages came to which end."""
    states = [row.state for row in outcome.stages]
    return ", ".join(
        f"{states.count(state)} {state}"
        for state in ("ran", "cached", "skipped", "failed")
        if state in states
    )


def _print_lines(out: Console, outcome: SequenceOutcome, columns: Sequence[str]) -> None:
    """What the table has in a sequence's rows, below each other."""
    from extrags.metrics.comparison import figure_of

    color = "green" if outcome.status == "ok" else "red"
    out.print(f"{escape(outcome.title)}: [{color}]{outcome.status}[/]", soft_wrap=True)
    out.print(f"  {_counts(outcome)}", soft_wrap=True)
    coarse, final, restored = (outcome.metrics.get(which) or {} for which in ("coarse", "final", "restored"))
    # A table has a dash for what was not measured.
    for name in columns:
        if figure_of(coarse, name) is None and figure_of(final, name) is None:
            continue
        out.print(
            f"  {name} {_change(name, figure_of(coarse, name), figure_of(final, name))}", soft_wrap=True
        )
        if restored:
            change = _change(name, figure_of(final, name), figure_of(restored, name))
            out.print(f"  [dim]{name}, restored[/] {change}", soft_wrap=True)


def print_failures(run: DatasetOutcome) -> None:
    """One sentence for each sequence that failed."""
    out = console(error=True)
    for outcome in run.sequences:
        for row in outcome.stages:
            if row.state == "failed":
                out.print(
                    f"[red]{escape(outcome.title)} failed in {row.stage}:[/] {escape(row.reason)}",
                    soft_wrap=True,
                )


def _change(name: str, coarse: float | None, final: float | None) -> str:
    if coarse is None or coarse == final:
        return figure(name, final)
    return f"{figure(name, coarse)} → {figure(name, final)}"


def print_plan(outcome: SequenceOutcome, *, metric: bool) -> None:
    """The scene plan, decision by decision, and what it rests on.

    Args:
        outcome: of the sequence.
        metric: whether lengths of its scene are millimetres.
    """
    # Here, because it loads torch, which a process that only looks up results must not.
    from extrags.report.measurements import measurement_rows

    out = console()
    plan = outcome.plan or {"decisions": [], "measurements": {}}
    table = Table(box=None, pad_edge=False, header_style="bold", title=f"plan for {escape(outcome.name)}")
    for column in ("stage", "runs", "budget", "saves s", "because"):
        table.add_column(column, justify="right" if column == "saves s" else "left")
    for line in plan["decisions"]:
        budget = ", ".join(f"{name} {value}" for name, value in line["budget"].items())
        runs = "[green]yes[/]" if line["run"] else "no"
        saves = "-" if line.get("saves_s") is None else f"{line['saves_s']:.1f}"
        table.add_row(line["stage"], runs, budget, saves, escape(line["reason"]))
    out.print(table)
    measured = Table(box=None, pad_edge=False, show_header=False, title="measured", title_justify="left")
    measured.add_column(style="dim")
    measured.add_column(justify="right")
    for label, value in measurement_rows(plan["measurements"], metric=metric):
        measured.add_row(label, value)
    out.print(measured)
