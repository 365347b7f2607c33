"""What the page of a flow run says while it runs: what it does, how far it is, how long it still takes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from prefect.artifacts import create_image_artifact, create_link_artifact

from extrags.config import PipelineConfig
from extrags.pipeline import STAGES, StageName
from extrags.store import Store
from flows.outcome import SequenceOutcome
from flows.previews import preview
from tasks.progress import Observer, StageProgress, current_observer, observed
from tasks.run_log import run_log
from tasks.run_page import (
    ArtifactSender,
    ProgressLog,
    StageBars,
    artifact_key,
    duration_text,
    page_wanted,
)

__all__ = ["EXPECTED_SECONDS", "NoPage", "RunPage", "SequenceEstimate", "expected_seconds", "run_page"]

EXPECTED_SECONDS: dict[StageName, dict[str, float]] = {
    "ingest": {"ingest": 12.0},
    "poses": {"poses": 20.0},
    "depth": {"depth": 30.0},
    "coarse": {"coarse": 18.0},
    "assess": {"assess": 0.4},
    "surface": {"surface": 1.2},
    "freespace": {"freespace": 1.2},
    "explore": {"explore": 25.0},
    "enhance": {"enhance-train": 15.0, "enhance-keyframes": 5.0, "enhance-restore": 35.0, "enhance": 4.0},
    "finetune": {"finetune-judge": 18.0, "finetune": 25.0},
    "evaluate": {"evaluate-render": 8.0, "evaluate": 15.0},
    "report": {"report": 8.0},
}
"""How long the tasks of each stage take, in the order in which they run.

Rounded, from some runs of the profile `quick` on two cores. They count in proportion to each other
only: how fast this machine is with this sequence is learned from the stages that have run.
"""
QUICK_ITERATIONS = {"coarse": 1500, "finetune": 1000}

LEARNED_SECONDS = 10.0
"""So much of what is expected must have run before anything is said of what is left."""
ALMOST = 0.95
"""Share of a task that has outlasted what was expected of it."""


def expected_seconds(config: PipelineConfig) -> dict[StageName, dict[str, float]]:
    """`EXPECTED_SECONDS` with the iterations of these settings."""
    times = {stage: dict(tasks) for stage, tasks in EXPECTED_SECONDS.items()}
    times["coarse"]["coarse"] *= config.coarse.iterations / QUICK_ITERATIONS["coarse"]
    times["finetune"]["finetune"] *= config.finetune.iterations / QUICK_ITERATIONS["finetune"]
    return times


@dataclass
class SequenceEstimate:
    """How far a sequence is, and how long it still takes.

    Args:
        expected: seconds by stage and task (`expected_seconds`).
        until: last stage.
    """

    expected: dict[StageName, dict[str, float]]
    until: StageName = "report"
    ended: dict[str, StageProgress] = field(default_factory=dict)
    stage: str = ""
    """In work."""
    newest: StageProgress | None = None
    _begun: float = 0.0
    _task: str = ""
    _task_begun: float = 0.0
    _task_share: float | None = None

    def receive(self, progress: StageProgress, now: float) -> None:
        """Take note of a step or the end of a stage."""
        if self.failed:
            # What is skipped now is not done.
            return
        if progress.state != "running":
            self.ended[progress.stage] = progress
            self.stage, self.newest = "", None
            return
        if progress.stage in self.expected and progress.stage != self.stage and not progress.total:
            # Announced by the flow: the next stage.
            self._begin(progress, now)
            return
        tasks = self._tasks(self.stage)
        self.newest = progress
        if progress.stage in tasks:
            if progress.stage != self._task:
                self._task, self._task_begun, self._task_share = progress.stage, now, None
            # Several tasks of a kind may run at once; only the sum of `enhance-restore` would be a share.
            if progress.total and progress.stage != "enhance-restore":
                self._task_share = max(self._task_share or 0.0, min(1.0, progress.done / progress.total))

    @property
    def failed(self) -> bool:
        """Whether a stage failed; nothing comes after it."""
        return any(row.state == "failed" for row in self.ended.values())

    def _begin(self, progress: StageProgress, now: float) -> None:
        self.stage, self.newest = progress.stage, progress
        self._begun = self._task_begun = now
        self._task = next(iter(self._tasks(progress.stage)), "")
        self._task_share = None

    def share(self, now: float) -> float:
        """Of the expected time that stages to be run take, in [0, 1]."""
        whole = sum(self._seconds(stage) for stage in self._stages())
        well = [stage for stage, row in self.ended.items() if row.state in ("ran", "cached")]
        done = sum(self._seconds(stage) for stage in self._stages() if stage in well)
        return min(1.0, (done + self._stage_done(now)) / whole) if whole else 1.0

    def seconds_left(self, now: float) -> float | None:
        """At the pace of the stages that ran here; None before enough of them have."""
        pace = self._pace(now)
        if pace is None:
            return None
        waiting = [stage for stage in self._stages() if stage not in self.ended and stage != self.stage]
        rest = sum(self._seconds(stage) for stage in waiting)
        if self.stage:
            rest += self._seconds(self.stage) - self._stage_done(now)
        return pace * rest

    def _pace(self, now: float) -> float | None:
        """Seconds per expected second."""
        ran = [row for row in self.ended.values() if row.state == "ran" and row.stage in self._stages()]
        expected = sum(self._seconds(row.stage) for row in ran)
        took = sum(row.seconds for row in ran)
        if self.stage and self._task_share:
            expected += self._stage_done(now)
            took += now - self._begun
        return took / expected if expected >= LEARNED_SECONDS else None

    def _stages(self) -> list[StageName]:
        wanted = STAGES[: STAGES.index(self.until) + 1]
        return [stage for stage in wanted if stage not in self.ended or self.ended[stage].state != "skipped"]

    def _tasks(self, stage: str) -> dict[str, float]:
        return next((tasks for name, tasks in self.expected.items() if name == stage), {})

    def _seconds(self, stage: str) -> float:
        return sum(self._tasks(stage).values())

    def _stage_done(self, now: float) -> float:
        """Expected seconds of the stage in work that are behind it."""
        done = 0.0
        for task, seconds in self._tasks(self.stage).items():
            if task == self._task:
                share = self._task_share
                if share is None:
                    share = min(ALMOST, (now - self._task_begun) / seconds) if seconds else ALMOST
                return done + float(share * seconds)
            done += seconds
        return 0.0


class RunPage:
    """Observer of a flow run: its overall progress and that of its long stages, as artifacts and in the log.

    Args:
        name: of the run, in the keys of its artifacts.
        sequences: how many it takes through the stages, one after the other or at once.
        expected: of one sequence (`expected_seconds`).
        until: last stage.
        bars: whether stages get bars of their own; not where another flow run has them.
    """

    def __init__(
        self,
        name: str,
        sequences: int,
        expected: dict[StageName, dict[str, float]],
        until: StageName,
        *,
        bars: bool,
    ) -> None:
        self.sender = ArtifactSender()
        self._name = name
        self._key = artifact_key("progress", name)
        self._sequences = sequences
        self._expected, self._until = expected, until
        self._bars = StageBars(self.sender) if bars else None
        self._outer: Observer = current_observer() or ProgressLog()
        self._guard = threading.Lock()
        self._begun = time.monotonic()
        self._estimates: dict[str, SequenceEstimate] = {}
        self._ended = self._failed = 0
        self._failed_share = 0.0
        self._ran_seconds: list[float] = []
        self._started_at: dict[str, float] = {}

    def __call__(self, progress: StageProgress) -> None:
        """Take note of a step; may be called from any thread, and often."""
        self._outer(progress)
        if self._bars is not None:
            self._bars(progress)
        now = time.monotonic()
        with self._guard:
            estimate = self._estimates.get(progress.label)
            if estimate is None:
                estimate = self._estimates[progress.label] = SequenceEstimate(self._expected, self._until)
                self._started_at[progress.label] = now
            estimate.receive(progress, now)
            self.sender.progress(self._key, 100 * self._share(now), self._text(now))

    def restart(self) -> None:
        """All sequences are looked up again from the first (`flows.damage`)."""
        with self._guard:
            self._ended = self._failed = 0

    def sequence_ended(self, outcome: SequenceOutcome, store: str) -> None:
        """A sequence is through; its pictures and its report are shown on the page that has the bars."""
        if self._bars is not None:
            self._show(outcome, store)
        now = time.monotonic()
        with self._guard:
            self._ended += 1
            estimate = self._estimates.pop(outcome.name, None)
            if outcome.status == "failed":
                self._failed += 1
                self._failed_share = 0.0 if estimate is None else estimate.share(now)
            begun = self._started_at.pop(outcome.name, now)
            if any(row.state == "ran" for row in outcome.stages):
                self._ran_seconds.append(now - begun)
            self.sender.progress(self._key, 100 * self._share(now), self._text(now))

    def _show(self, outcome: SequenceOutcome, store: str) -> None:
        """Add the pictures of a sequence, and the link to its report."""

        def picture() -> None:
            # Read in the sender's thread: stages go on meanwhile.
            found = preview(outcome, Store(store))
            if found is not None:
                uri, words = found
                create_image_artifact(uri, key=artifact_key("preview", outcome.name), description=words)

        self.sender.add(picture)
        if outcome.report is not None:
            self.link(outcome.report, artifact_key("report", outcome.name), f"Report of {outcome.name}")

    def link(self, place: str, key: str, words: str) -> None:
        """Add a link to a page in the store."""
        address = place if "://" in place else Path(place).absolute().as_uri()
        self.sender.add(
            lambda: create_link_artifact(address, link_text=place, key=key, description=f"{words}: `{place}`")
        )

    def close(self, *, wait: bool = True) -> None:
        """The last word, and everything sent."""
        took = duration_text(time.monotonic() - self._begun)
        with self._guard:
            if self._failed == self._sequences == 1:
                share, words = self._failed_share, f"failed after {took}"
            elif self._ended >= self._sequences:
                share, words = 1.0, f"done in {took}"
                if self._failed:
                    words += f"; {self._failed} of {self._sequences} failed"
            else:
                share, words = self._share(time.monotonic()), f"ended after {took}"
        self.sender.progress(self._key, 100 * share, f"{self._name}: {words}")
        self.sender.close(wait=wait)

    def _share(self, now: float) -> float:
        return min(
            1.0,
            (self._ended + sum(item.share(now) for item in self._estimates.values())) / self._sequences,
        )

    def _text(self, now: float) -> str:
        words = []
        if self._sequences > 1:
            words.append(f"{self._ended} of {self._sequences} sequences done")
        for label, estimate in self._estimates.items():
            if estimate.stage:
                words.append(f"{label}: {_at_work(estimate)}")
        left = self._seconds_left(now)
        if left is not None:
            words.append(f"about {duration_text(left)} left")
        return "; ".join([*words, f"{duration_text(now - self._begun)} so far"])

    def _seconds_left(self, now: float) -> float | None:
        """Those in work to their end, and the others as long as those before, as many at once as now."""
        in_work = {label: item.seconds_left(now) for label, item in self._estimates.items()}
        waiting = self._sequences - self._ended - len(in_work)
        known = [left for left in in_work.values() if left is not None]
        if len(known) < len(in_work):
            return None
        whole = self._ran_seconds or [
            left + now - self._started_at[label] for label, left in in_work.items() if left is not None
        ]
        if waiting and not whole:
            return None
        rest = waiting * sum(whole) / len(whole) / max(1, len(in_work)) if waiting else 0.0
        return max(known, default=0.0) + rest


def _at_work(estimate: SequenceEstimate) -> str:
    newest = estimate.newest
    if newest is None or not newest.total:
        return estimate.stage
    task = "" if newest.stage == estimate.stage else f" ({newest.stage})"
    return f"{estimate.stage}{task}, {newest.done} of {newest.total}"


class NoPage:
    """Of a run that has none."""

    def restart(self) -> None:
        """Nothing was begun."""

    def sequence_ended(self, outcome: SequenceOutcome, store: str) -> None:
        """Nobody is told."""

    def link(self, place: str, key: str, words: str) -> None:
        """Nothing is linked."""


@contextmanager
def run_page(
    name: str,
    config: PipelineConfig,
    until: StageName,
    *,
    sequences: int = 1,
    bars: bool = True,
) -> Iterator[RunPage | NoPage]:
    """The page and the log of the current flow run.

    Args:
        name: of the run, in the keys of its artifacts.
        config: settings of its sequences.
        until: last stage.
        sequences: how many it takes through the stages.
        bars: whether stages get bars of their own here, and sequences their pictures; not where flow runs
            inside this one have them.

    Yields:
        A page that is told when a sequence ends. One that says nothing where none is wanted
        (`tasks.run_page.page_wanted`).
    """
    with run_log():
        if not page_wanted():
            yield NoPage()
            return
        page = RunPage(name, sequences, expected_seconds(config), until, bars=bars)
        try:
            with observed(page):
                yield page
        except Exception:
            page.close()
            raise
        except BaseException:
            # Interrupted: whoever is waiting for the end must not wait for the server.
            page.close(wait=False)
            raise
        page.close()
