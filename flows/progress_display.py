"""What a terminal shows of a run under way: stages, the loop in work, the whole run, the last picture."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Literal

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from extrags.config import DEFAULT_PROFILE, profile_config
from extrags.errors import reason_of
from extrags.stages import StageName, stages_until
from extrags.store import Store
from flows.estimate import RunEstimate, expected_seconds
from flows.previews import stage_preview
from flows.printable import in_one_line
from flows.terminal import TerminalConsole, console
from tasks.progress import Pace, StageProgress, duration_text, observed, rate_text

__all__ = ["RunDisplay", "RunInView", "progress_display"]

log = logging.getLogger(__name__)

Showing = Literal["terminal", "log", "nothing"]
"""Where progress goes: a live display, lines of a log, nowhere."""

MARKS = {"ran": "✓", "cached": "=", "skipped": "-", "failed": "✗", "interrupted": "✗"}
STYLES = {"ran": "green", "cached": "cyan", "skipped": "dim", "failed": "red", "interrupted": "red"}

MOST_SEQUENCES = 4
"""In work at the same time that have lines of their own."""
NAME_WIDTH = 18
BAR_WIDTH = 24
SHORTEST_BAR = 6
SHORTEST_DETAIL = 12
GAP = 2
"""Columns between the parts of a line."""
REFRESH_SECONDS = 0.25
PREVIEW_WAIT_SECONDS = 2.0
"""How long the end of a run waits for a picture that is being made."""


@dataclass(frozen=True)
class RunInView:
    """What is known of a run before it begins.

    Args:
        sequences: how many it takes through the stages; 0 for a loop that is none of theirs.
        expected: seconds that their stages take in proportion to each other.
        until: last stage.
        store: root of the store whose artefacts are shown as small pictures; None for none.
    """

    sequences: int = 0
    expected: Mapping[StageName, dict[str, float]] = field(
        default_factory=lambda: expected_seconds(profile_config(DEFAULT_PROFILE))
    )
    until: StageName = "report"
    store: str | None = None


@contextmanager
def progress_display(showing: Showing, run: RunInView | None = None) -> Iterator[None]:
    """Show how far the stages are that run inside the block.

    Args:
        showing: `terminal` for a live display on standard error; for `log` the stages log it themselves
            (`tasks.progress.ProgressLog`).
        run: what is known of it.
    """
    if showing == "log":
        yield
        return
    if showing == "nothing":
        with observed(_ignore):
            yield
        return
    run = run or RunInView()
    out = console(error=True)
    previews = nullcontext(None) if run.store is None else _previews(Store(run.store))
    with previews as wanted:
        display = RunDisplay(run, announce=lambda line: out.print(line, highlight=False), preview=wanted)
        with _live(display, out), observed(display):
            yield


@contextmanager
def _live(display: RunDisplay, out: TerminalConsole) -> Iterator[None]:
    """Draw a display below what is printed, from any thread, until the end of the block.

    rich's own refresh draws beside what other threads print: each then takes the cursor back by the lines
    that the other has drawn, and lines of the display stay, or lines of the log go.
    """
    out.turn = threading.RLock()
    live = Live(display, console=out, auto_refresh=False, transient=True)
    over = threading.Event()

    def refresh() -> None:
        while not over.wait(REFRESH_SECONDS):
            with out.turn:
                live.refresh()

    thread = threading.Thread(target=refresh, name="display", daemon=True)
    with out.turn:
        live.start(refresh=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        with out.turn:
            live.stop()


def _ignore(_: StageProgress) -> None:
    """Nobody wants to know."""


class RunDisplay:
    """Observer that draws the state of a run; may be called and drawn from any thread.

    Args:
        run: what is known of it.
        announce: prints a line, with rich's markup, when a stage has ended.
        preview: is told of every stage that has made something, and gives what it has to show to a function.
        clock: seconds, from any origin.
    """

    def __init__(
        self,
        run: RunInView,
        *,
        announce: Callable[[str], object],
        preview: Callable[[StageProgress, Callable[[str], None]], object] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._run = run
        self._announce = announce
        self._preview = preview
        self._clock = clock
        self._begun = clock()
        self._guard = threading.Lock()
        self._pace = Pace()
        self._loops: dict[str, tuple[StageProgress, float | None, float | None]] = {}
        """The loop in work of each sequence, its rate and the seconds left."""
        self._over: set[str] = set()
        self._ran: set[str] = set()
        self._estimate = RunEstimate(max(1, run.sequences), dict(run.expected), run.until)
        self._picture = ""

    def __call__(self, progress: StageProgress) -> None:
        """Take note of a step or the end of a stage."""
        with self._guard:
            if progress.state == "running":
                self._step(progress)
                return
            if progress.label in self._over:
                # After a failure every further stage is announced as skipped.
                return
            self._end(progress, self._clock())
        took = "" if progress.state in ("skipped", "cached") else f"  {progress.seconds:6.1f} s"
        why = f"  [dim]{escape(progress.detail)}[/]" if progress.state in ("skipped", "failed") else ""
        style = STYLES[progress.state]
        self._announce(
            f"[{style}]{MARKS[progress.state]}[/] {escape(progress.label)}  {progress.stage:<10} "
            f"{progress.state:<8}{took}{why}"
        )
        if self._preview is not None and progress.state in ("ran", "cached"):
            self._preview(progress, self._show_picture)

    def _step(self, progress: StageProgress) -> None:
        now = self._clock()
        if not progress.total and not progress.detail:
            self._over.discard(progress.label)
        if self._run.sequences and progress.label not in self._over:
            self._estimate.receive(progress, now)
        if progress.is_loop:
            rate, left = self._pace.rate(progress, now), self._pace.seconds_left(progress, now)
            self._loops[progress.label] = progress, rate, left

    def _end(self, progress: StageProgress, now: float) -> None:
        self._pace.forget(progress.label)
        self._loops.pop(progress.label, None)
        if not self._run.sequences:
            return
        self._estimate.receive(progress, now)
        failed = progress.state == "failed"
        if progress.state == "ran":
            self._ran.add(progress.label)
        if failed or progress.stage == self._run.until:
            self._over.add(progress.label)
            ran = progress.label in self._ran
            self._ran.discard(progress.label)
            self._estimate.sequence_ended(progress.label, now, failed=failed, ran=ran)

    def _show_picture(self, words: str) -> None:
        with self._guard:
            self._picture = words

    def __rich_console__(self, out: Console, options: ConsoleOptions) -> RenderResult:
        """What stands below the lines of the stages that have ended."""
        with self._guard:

            def height(parts: list[Text | Table]) -> int:
                return sum(len(out.render_lines(part, options, pad=False)) for part in parts)

            below = list(self._below(self._clock(), options.max_width))
            room = options.size.height - height(below)
            in_work, shown = list(self._estimate.in_work), 0
            for label in in_work[:MOST_SEQUENCES]:
                block = list(self._in_work(label, options.max_width))
                # In a low terminal the whole run stays in sight; a line tells of the sequences that do not.
                room -= height(block)
                if room < (shown + 1 < len(in_work)):
                    break
                yield from block
                shown += 1
            left = len(in_work) - shown
            if left:
                sequences = "sequence" if left == 1 else "sequences"
                told = f"and {left} more {sequences}" if shown else f"{left} {sequences} in work"
                yield Text(told, style="dim")
            yield from below

    def _in_work(self, label: str, width: int) -> Iterator[Text | Table]:
        yield self._stages(label, width)
        if label in self._loops:
            yield _loop(*self._loops[label], width)

    def _below(self, now: float, width: int) -> Iterator[Text | Table]:
        """What is of no sequence in work."""
        for label, loop in self._loops.items():
            if label not in self._estimate.in_work:
                yield _loop(*loop, width)
        if self._run.sequences:
            yield self._whole(now, width)
        if self._picture:
            # In one piece: it is there to be clicked or copied.
            yield Text(f"picture  {self._picture}", style="dim", overflow="fold")

    def _stages(self, label: str, width: int) -> Text:
        """`phantom/11@sparse  ✓ ingest  - poses  ▸ coarse  · assess`, with breaks between stages alone."""
        estimate, shown = self._estimate.in_work[label], in_one_line(label)
        words, used = Text.assemble((shown, "bold")), cell_len(shown)
        for stage in stages_until(self._run.until):
            ended = estimate.ended.get(stage)
            if ended is not None:
                mark, style = MARKS[ended.state], STYLES[ended.state]
            elif stage == estimate.stage:
                mark, style = "▸", "bold"
            else:
                mark, style = "·", "dim"
            word = f"{mark} {stage}"
            if used + 2 + len(word) > width:
                words.append("\n")
                used = 0
            words.append("  ").append(word, style=style)
            used += 2 + len(word)
        return words

    def _whole(self, now: float, width: int) -> Table:
        run = self._estimate
        share = run.share(now)
        # What rounds to a hundred per cent is not done.
        words = [f"{min(round(100 * share), 100 if run.ended >= run.sequences else 99)} %"]
        if run.sequences > 1:
            words.append(f"{run.ended} of {run.sequences} sequences done")
        if run.failed:
            words.append(f"{run.failed} failed")
        words.append(f"{duration_text(now - self._begun)} so far")
        left = run.seconds_left(now)
        if left is not None and left >= 1:
            words.append(f"about {duration_text(left)} left")
        return _bar("whole run", share, words, "", width)


def _loop(progress: StageProgress, rate: float | None, left: float | None, width: int) -> Table:
    words = [f"{progress.done} of {progress.total}"]
    if rate is not None:
        words.append(rate_text(rate))
    if left is not None:
        words.append(f"about {duration_text(left)} left")
    return _bar(progress.stage, progress.done / progress.total, words, progress.detail, width)


def _bar(name: str, share: float, words: list[str], detail: str, width: int) -> Table:
    """A line of `width` columns: where it is narrow the detail goes first, the name last of all."""
    name = f"  {name}"
    said = ", ".join(words)
    name_width = max(NAME_WIDTH, len(name))
    bar_width = min(BAR_WIDTH, width - name_width - len(said) - 2 * GAP)
    if bar_width < SHORTEST_BAR:
        name_width = len(name)
        bar_width = min(BAR_WIDTH, width - name_width - len(said) - 2 * GAP)
    if bar_width < SHORTEST_BAR:
        bar_width = 0
        while len(words) > 1 and name_width + GAP + len(said) > width:
            words = words[:-1]
            said = ", ".join(words)
        name_width = max(1, min(name_width, width - GAP - len(said)))
    line = Table.grid(padding=(0, GAP))
    line.add_column(width=name_width, no_wrap=True, overflow="ellipsis")
    cells: list[Text | ProgressBar] = [Text(name)]
    if bar_width:
        line.add_column(width=bar_width)
        cells.append(ProgressBar(total=1.0, completed=share, width=bar_width))
    room = width - name_width - (bar_width and bar_width + GAP) - GAP
    text = Text(said)
    if detail and room - len(said) >= SHORTEST_DETAIL:
        text.append("   ").append(detail, style="dim")
    # With a width of its own, so that what is too long for it takes nothing from the name.
    line.add_column(width=max(1, min(room, text.cell_len)), no_wrap=True, overflow="ellipsis")
    cells.append(text)
    line.add_row(*cells)
    return line


@contextmanager
def _previews(store: Store) -> Iterator[Callable[[StageProgress, Callable[[str], None]], object]]:
    """Makes pictures in a thread of its own, of the newest stage where several wait; no run fails by it."""
    asked: SimpleQueue[tuple[StageProgress, Callable[[str], None]] | None] = SimpleQueue()

    def work() -> None:
        while (wanted := asked.get()) is not None:
            while not asked.empty():
                newer = asked.get()
                if newer is None:
                    return
                wanted = newer
            progress, show = wanted
            try:
                found = stage_preview(progress.label, progress.stage, progress.made, store)
            except Exception as error:
                log.info("no picture of %s %s: %s", progress.label, progress.stage, reason_of(error))
                continue
            if found is not None:
                path, words = found
                show(f"{_short(path)} ({words})")

    thread = threading.Thread(target=work, name="previews", daemon=True)
    thread.start()
    try:
        yield lambda progress, show: asked.put((progress, show))
    finally:
        asked.put(None)
        thread.join(PREVIEW_WAIT_SECONDS)


def _short(path: Path) -> str:
    """Relative to the working directory where it is inside."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
