"""Progress bars in a terminal, log lines elsewhere; and the summary tables of a run."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from flows.outcome import DatasetOutcome, SequenceOutcome
from flows.tables import figure, table_figures
from flows.terminal import console
from tasks.progress import StageProgress, observed

__all__ = ["print_outcomes", "print_plan", "progress_bars"]

_MARKS = {
    "ran": "[green]✓[/]",
    "cached": "[cyan]=[/]",
    "skipped": "[dim]-[/]",
    "failed": "[red]✗[/]",
    "interrupted": "[red]✗[/]",
}


@contextmanager
def progress_bars(*, terminal: bool) -> Iterator[None]:
    """Show progress bars of the stages that run inside the block.

    Without a terminal there are no bars: stages then log their progress (`tasks.progress`).
    """
    if not terminal:
        yield
        return
    with _bars() as bars, observed(_Display(bars)):
        yield


def _bars() -> Progress:
    return Progress(
        SpinnerColumn(finished_text=" "),
        TextColumn("{task.fields[label]}  [bold]{task.description}[/]"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.fields[detail]}[/]"),
        console=console(error=True),
        transient=True,
    )


class _Display:
    """Observer that shows stage progress as bars; may be called from any thread."""

    def __init__(self, bars: Progress) -> None:
        self.bars = bars
        self._guard = threading.Lock()
        self._shown: dict[tuple[str, str], TaskID] = {}

    def __call__(self, progress: StageProgress) -> None:
        key = (progress.label, progress.stage)
        with self._guard:
            if progress.state == "running":
                if key not in self._shown:
                    self._shown[key] = self.bars.add_task(
                        progress.stage, total=None, label=progress.label, detail=""
                    )
                bar = self._shown[key]
                if progress.total:
                    self.bars.update(bar, completed=progress.done, total=progress.total)
                if progress.detail:
                    self.bars.update(bar, detail=progress.detail[:60])
                return
            for shown in [name for name in self._shown if name[0] == progress.label]:
                self.bars.remove_task(self._shown.pop(shown))
        took = "" if progress.state == "skipped" else f"  {progress.seconds:6.1f} s"
        why = f"  [dim]{progress.detail}[/]" if progress.state in ("skipped", "failed") else ""
        self.bars.console.print(
            f"{_MARKS[progress.state]} {progress.label}  {progress.stage:<10} {progress.state:<8}{took}{why}",
            highlight=False,
        )


def print_outcomes(run: DatasetOutcome, seconds: float) -> None:
    """Print a table of results, one row per sequence."""
    out = console(error=True)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("sequence", "status", "stages"):
        table.add_column(column)
    columns = table_figures(*(tree for outcome in run.sequences for tree in outcome.metrics.values()))[:4]
    for name in columns:
        table.add_column(name, justify="right")
    for outcome in run.sequences:
        states = [row.state for row in outcome.stages]
        counts = ", ".join(
            f"{states.count(state)} {state}"
            for state in ("ran", "cached", "skipped", "failed")
            if state in states
        )
        coarse, final = (outcome.metrics.get(which) or {} for which in ("coarse", "final"))
        colour = "green" if outcome.status == "ok" else "red"
        table.add_row(
            escape(outcome.title),
            f"[{colour}]{outcome.status}[/]",
            counts,
            *(_change(name, coarse.get(name), final.get(name)) for name in columns),
        )
        if restored := outcome.metrics.get("restored"):
            table.add_row(
                "[dim]  restored in the image[/]",
                "",
                "",
                *(_change(name, final.get(name), restored.get(name)) for name in columns),
            )
    out.print(table)
    for outcome in run.sequences:
        for row in outcome.stages:
            if row.state == "failed":
                out.print(f"[red]{escape(outcome.title)} failed in {row.stage}:[/] {escape(row.reason)}")
        if outcome.report:
            out.print(f"report: {outcome.report}", soft_wrap=True)
    if run.report and len(run.sequences) > 1:
        out.print(f"all together: {run.report}", soft_wrap=True)
    out.print(f"{seconds:.1f} s in all")


def _change(name: str, coarse: float | None, final: float | None) -> str:
    if coarse is None:
        return figure(name, final)
    return f"{figure(name, coarse)} → {figure(name, final)}"


def print_plan(outcome: SequenceOutcome) -> None:
    """The scene plan, decision by decision."""
    out = console()
    plan = outcome.plan or {"decisions": [], "measurements": {}}
    table = Table(box=None, pad_edge=False, header_style="bold", title=f"plan for {outcome.name}")
    for column in ("stage", "runs", "budget", "because"):
        table.add_column(column)
    for line in plan["decisions"]:
        budget = ", ".join(f"{name} {value}" for name, value in line["budget"].items())
        runs = "[green]yes[/]" if line["run"] else "no"
        table.add_row(line["stage"], runs, budget, escape(line["reason"]))
    out.print(table)
    figures = ", ".join(f"{name} {value:.4g}" for name, value in plan["measurements"].items())
    out.print(f"[dim]measured: {figures}[/]")
