"""How far a run is, and how long it still takes, from the stages that its sequences have been through."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import takewhile

from extrags.config import PipelineConfig
from extrags.cores import usable_cores
from extrags.run_costs import Workload, packaged_model, stage_tasks
from extrags.stages import STAGES, StageName, all_tasks, cost_of, stages_until
from flows.workloads import task_repeats, usual_work
from tasks.progress import StageProgress, duration_text

__all__ = ["RunEstimate", "SequenceEstimate", "expected_seconds", "usual_pace", "without_kernels_in_words"]

MEASURED_SCENES = 2
"""The coarse and the final scene."""

SEVERAL_LOOPS = frozenset(task.name for task in all_tasks() if task.several_loops)
"""Tasks that count one thing after another: no count tells how far they are, only their time does."""

READING: StageName = "ingest"
"""How long it takes depends on the files, and says nothing of other stages."""

USUAL_PACE_SECONDS = 10.0
"""The usual pace weighs as much as so many expected seconds that have run."""
USED_SHARE = 0.8
"""Of every core but the first, which whole runs keep busy: the part of their time that threads divide."""
ALMOST = 0.95
"""Share of a task, or of a step of one, that has outlasted what was expected of it."""


def expected_seconds(
    config: PipelineConfig, work: Workload | None = None
) -> dict[StageName, dict[str, float]]:
    """How much processor time the tasks of each stage take on the reference machine, in the order they run.

    They count in proportion to each other: how fast this machine is with this sequence is learned from the
    stages that have run. Tasks whose settings no model knows (`extrags.run_costs.beyond_the_fit`) count as
    with those it does know.

    Args:
        config: settings of all stages.
        work: size of the sequence; None takes that of a phantom.
    """
    model, work = packaged_model(), usual_work(config) if work is None else work
    found: dict[StageName, dict[str, float]] = {}
    restored = int(config.evaluate.restored != "none")
    work = replace(work, stacks=MEASURED_SCENES + restored)
    for stage in STAGES:
        repeats = task_repeats(stage, MEASURED_SCENES, restored)
        run = stage_tasks(stage, config)
        tasks: dict[str, float] = {}
        for task, times in repeats.items():
            if task not in run:
                continue
            cost = cost_of(task)
            known = task in model.time
            seconds = times * model.predict(task, work).seconds if known else cost.usual_s or 0.0
            for part, share in (cost.shares or {task: 1.0}).items():
                tasks[part] = share * seconds
        found[stage] = tasks
    return found


def usual_pace() -> float:
    """Elapsed seconds per second of processor time, of a run that has this machine to itself."""
    return 1 / (1 + USED_SHARE * (usable_cores() - 1))


def without_kernels_in_words() -> str:
    """What to add to an expected time where the compiled kernels, which the model rests on, are missing."""
    # Here, because it loads torch.
    from extrags.raster import available_backends

    if available_backends()[0] != "reference":
        return ""
    return ", with the compiled kernels; these are missing here, and what renders takes many times as long"


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
    _counted: tuple[float, float, float] | None = None
    """Of the task in work: its share at its last step, the share of a step, and when that was."""

    def receive(self, progress: StageProgress, now: float) -> None:
        """Take note of a step or the end of a stage."""
        if self.failed:
            # What is skipped now is not done.
            return
        if progress.expected is not None:
            self.expected = {
                stage: dict(progress.expected.get(stage, tasks)) for stage, tasks in self.expected.items()
            }
        if progress.state != "running":
            self.ended[progress.stage] = progress
            self.stage, self.newest, self._task, self._counted = "", None, "", None
            return
        if progress.stage in self.expected and progress.stage != self.stage and not progress.total:
            # Announced by the flow: the next stage.
            self._begin(progress, now)
            return
        tasks = self._tasks(self.stage)
        self.newest = progress
        if progress.stage in tasks:
            if progress.stage != self._task:
                self._task, self._task_begun, self._counted = progress.stage, now, None
            if progress.is_loop and progress.stage not in SEVERAL_LOOPS:
                share = min(1.0, progress.done / progress.total)
                if self._counted is None or share > self._counted[0]:
                    self._counted = share, 1 / progress.total, now

    @property
    def failed(self) -> bool:
        """Whether a stage failed; nothing comes after it."""
        return any(row.state == "failed" for row in self.ended.values())

    def _begin(self, progress: StageProgress, now: float) -> None:
        self.stage, self.newest = progress.stage, progress
        self._begun = self._task_begun = now
        self._task = next(iter(self._tasks(progress.stage)), "")
        self._counted = None

    def share(self, now: float) -> float:
        """Of the expected time that stages to be run take, in [0, 1]."""
        whole = sum(self._seconds(stage) for stage in self._stages())
        well = [stage for stage, row in self.ended.items() if row.state in ("ran", "cached")]
        done = sum(self._seconds(stage) for stage in self._stages() if stage in well)
        return min(1.0, (done + self._stage_done(now)) / whole) if whole else 1.0

    def seconds_left(self, now: float) -> float:
        """At the pace of what ran here, and the usual one as long as that is little."""
        waiting = [stage for stage in self._stages() if stage not in self.ended and stage != self.stage]
        rest = sum(self._seconds(stage) for stage in waiting)
        reading = 0.0
        if self.stage == READING:
            reading = self._reading_pace() * (self._seconds(self.stage) - self._stage_done(now))
        elif self.stage:
            rest += self._seconds(self.stage) - self._stage_done(now)
        return self._pace(counted=True) * rest + reading

    def _reading_pace(self) -> float:
        """Seconds per expected second of the frames that have been read."""
        if self._counted is None:
            return self._pace(counted=False)
        share, _, at = self._counted
        expected = self._before_task() + share * self._tasks(self.stage).get(self._task, 0.0)
        took = USUAL_PACE_SECONDS * usual_pace() + at - self._begun
        return took / (USUAL_PACE_SECONDS + expected)

    def _pace(self, *, counted: bool) -> float:
        """Seconds per expected second, of the stages that ran and of the steps of the one in work."""
        # Of a long video all frames are decoded and few are used: the stages to come are no slower for it.
        ran = [
            row
            for row in self.ended.values()
            if row.state == "ran" and row.stage in self._stages() and row.stage != READING
        ]
        expected = USUAL_PACE_SECONDS + sum(self._seconds(row.stage) for row in ran)
        took = USUAL_PACE_SECONDS * usual_pace() + sum(row.seconds for row in ran)
        if counted and self._counted is not None and self.stage != READING:
            share, _, at = self._counted
            expected += self._before_task() + share * self._tasks(self.stage).get(self._task, 0.0)
            took += at - self._begun
        return took / expected

    def _stages(self) -> list[StageName]:
        return [
            stage
            for stage in stages_until(self.until)
            if stage not in self.ended or self.ended[stage].state != "skipped"
        ]

    def _tasks(self, stage: str) -> dict[str, float]:
        return next((tasks for name, tasks in self.expected.items() if name == stage), {})

    def _seconds(self, stage: str) -> float:
        return sum(self._tasks(stage).values())

    def _before_task(self) -> float:
        """Expected seconds of the tasks of the stage in work that are behind it."""
        return sum(
            seconds
            for _, seconds in takewhile(lambda item: item[0] != self._task, self._tasks(self.stage).items())
        )

    def _stage_done(self, now: float) -> float:
        """Expected seconds of the stage in work that are behind it."""
        seconds = self._tasks(self.stage).get(self._task, 0.0)
        if not seconds:
            return self._before_task()
        share, most, since = (0.0, 1.0, self._task_begun) if self._counted is None else self._counted
        # Between two steps time goes on: there may be few of them.
        share += min(ALMOST * most, (now - since) / (seconds * self._pace(counted=False)))
        return self._before_task() + min(1.0, share) * seconds


class RunEstimate:
    """How far the sequences of a run are, and how long it still takes. One thread at a time.

    Args:
        sequences: how many it takes through the stages, one after the other or at once.
        expected: of one sequence (`expected_seconds`).
        until: last stage.
    """

    def __init__(self, sequences: int, expected: dict[StageName, dict[str, float]], until: StageName) -> None:
        self.sequences = sequences
        self.ended = self.failed = 0
        self.in_work: dict[str, SequenceEstimate] = {}
        """By name."""
        self._expected, self._until = expected, until
        self._failed_share = 0.0
        self._ran_seconds: list[float] = []
        self._started_at: dict[str, float] = {}

    def restart(self) -> None:
        """All sequences are looked up again from the first (`flows.damage`)."""
        self.ended = self.failed = 0

    def receive(self, progress: StageProgress, now: float) -> SequenceEstimate:
        """Take note of a step or the end of a stage; how far its sequence is."""
        estimate = self.in_work.get(progress.label)
        if estimate is None:
            estimate = self.in_work[progress.label] = SequenceEstimate(self._expected, self._until)
            self._started_at[progress.label] = now
        estimate.receive(progress, now)
        return estimate

    def sequence_ended(self, label: str, now: float, *, failed: bool, ran: bool) -> None:
        """A sequence is through.

        Args:
            label: its name.
            now: seconds, from the origin of `receive`.
            failed: whether a stage failed.
            ran: whether anything was made; what came from the store teaches nothing.
        """
        self.ended += 1
        estimate = self.in_work.pop(label, None)
        if failed:
            self.failed += 1
            self._failed_share = 0.0 if estimate is None else estimate.share(now)
        begun = self._started_at.pop(label, now)
        if ran:
            self._ran_seconds.append(now - begun)

    def share(self, now: float) -> float:
        """Of the whole run, in [0, 1]; of a single sequence that failed, what it came to."""
        if self.failed == self.sequences == 1:
            return self._failed_share
        done = self.ended + sum(item.share(now) for item in self.in_work.values())
        return min(1.0, done / self.sequences)

    def seconds_left(self, now: float) -> float | None:
        """Those in work to their end, and the others as long as those before, as many at once as now.

        None before any has begun.
        """
        in_work = {label: item.seconds_left(now) for label, item in self.in_work.items()}
        waiting = self.sequences - self.ended - len(in_work)
        whole = self._ran_seconds or [left + now - self._started_at[label] for label, left in in_work.items()]
        if waiting > 0 and not whole:
            return None
        rest = waiting * sum(whole) / len(whole) / max(1, len(in_work)) if waiting > 0 else 0.0
        return max(in_work.values(), default=0.0) + rest

    def text(self, now: float) -> str:
        """What is in work, and what is left: `3 of 12 sequences done; some/scene: coarse, 7 of 9; ...`."""
        words = []
        if self.sequences > 1:
            words.append(f"{self.ended} of {self.sequences} sequences done")
        for label, estimate in self.in_work.items():
            if estimate.stage:
                words.append(f"{label}: {_at_work(estimate)}")
        left = self.seconds_left(now)
        if left is not None:
            words.append(f"about {duration_text(left)} left")
        return "; ".join(words)


def _at_work(estimate: SequenceEstimate) -> str:
    newest = estimate.newest
    if newest is None or not newest.total:
        return estimate.stage
    task = "" if newest.stage == estimate.stage else f" ({newest.stage})"
    return f"{estimate.stage}{task}, {newest.done} of {newest.total}"
