"""Results of a run, as the JSON of `extrags run` reports them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from extrags.errors import ExtragsError
from extrags.redaction import without_credentials
from extrags.stages import REGISTRY, Part
from extrags.store import Ref

__all__ = [
    "MAX_FAILED_SHARE",
    "NOT_COUNTED",
    "BenchmarkFailedError",
    "DatasetFailedError",
    "DatasetOutcome",
    "SequenceFailedError",
    "SequenceOutcome",
    "StageRow",
    "StageState",
    "failed_outcome",
]

NOT_COUNTED = frozenset(stage.name for stage in REGISTRY if not stage.counted)
"""Stages that are not part of a method's run time."""

MAX_FAILED_SHARE = 0.5
"""When most sequences fail, it is hardly the sequences' fault."""

StageState = Literal["ran", "cached", "skipped", "failed", "interrupted"]
"""How a stage ended. An interrupted one is announced, never returned: the run ends with it."""


@dataclass
class StageRow:
    """Outcome of one stage of one sequence."""

    stage: str
    state: StageState
    seconds: float = 0.0
    """Wall-clock time in this run; near zero when cached."""
    reason: str = ""
    """Why it was skipped or failed, or the reason from the plan."""
    made_seconds: float = 0.0
    """Time it took to compute its artefacts, in this or an earlier run."""
    spent_seconds: float = 0.0
    """The part of `made_seconds` that was spent in this run; the rest is what cached artefacts once took.
    What was damaged and made again counts each time: then it may exceed `made_seconds`."""
    processor_seconds: float | None = None
    """Processor time of all threads while the artefacts were made, in this or an earlier run; None where an
    earlier version made one of them and did not measure it."""
    peak_mib: float | None = None
    """Peak resident memory of the process while they were computed."""
    tasks: int = 0
    """Task runs it consists of."""
    made: dict[str, int] = field(default_factory=dict)
    """Bytes of the artefacts it consists of, by key; in the JSON the keys alone."""

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "stage": self.stage,
            "state": self.state,
            "seconds": round(self.seconds, 3),
            "reason": self.reason,
            "made_seconds": round(self.made_seconds, 3),
            "spent_seconds": round(self.spent_seconds, 3),
            "processor_seconds": self.processor_seconds,
            "peak_mib": self.peak_mib,
            "tasks": self.tasks,
            "artefacts": sorted(self.made),
        }


@dataclass
class SequenceOutcome:
    """Outcome of one sequence."""

    name: str
    status: Literal["ok", "failed"] = "ok"
    stages: list[StageRow] = field(default_factory=list)
    metrics: dict[str, Any] = field(default_factory=lambda: {"coarse": None, "final": None})
    """`{coarse: M, final: M}`; without fine-tuning `final` is the coarse scene's M. With a restorer also
    `restored`: M of the final scene's views, restored in the image."""
    seconds: float = 0.0
    report: str | None = None
    """Where `report.html` stands."""
    refs: dict[Part, Ref] = field(default_factory=dict)
    """What was made."""
    plan: dict[str, Any] | None = None
    error: Exception | None = None
    """The exception of a failed stage; only available in the process that ran it."""
    variant: str = ""
    """What sets it apart from other runs of the same sequence in a matrix: `3dgs, seed 1`."""
    seed: int | None = None
    """Of all its stages, where it is one of several seeds."""

    @property
    def title(self) -> str:
        """The sequence, and the variant where there is one."""
        return f"{self.name} [{self.variant}]" if self.variant else self.name

    @property
    def artefacts(self) -> dict[str, str]:
        """URI of each artefact."""
        return {part: ref.uri for part, ref in self.refs.items()}

    @property
    def digests(self) -> dict[str, str]:
        """Content digest of each artefact: equal digests, equal bytes."""
        return {part: ref.digest for part, ref in self.refs.items()}

    @property
    def final_metrics(self) -> Ref | None:
        """Figures of the final scene; where nothing was fine-tuned, of the coarse one."""
        return self.refs.get("metrics_final", self.refs.get("metrics_coarse"))

    @property
    def final_renders(self) -> Ref | None:
        """Held-out views of the final scene; where nothing was fine-tuned, of the coarse one."""
        return self.refs.get("renders_final", self.refs.get("renders_coarse"))

    def row(self, stage: str) -> StageRow | None:
        """The row of a stage, if it has one."""
        return next((row for row in self.stages if row.stage == stage), None)

    def add_time_of(self, earlier: SequenceOutcome) -> None:
        """Count what an earlier pass of the same run took, whose artefacts this one has found in the store.

        A stage that was run then was run, and is not cached, for the run as a whole.
        """
        self.seconds += earlier.seconds
        for before in earlier.stages:
            row = self.row(before.stage)
            if row is None:
                continue
            row.seconds += before.seconds
            row.spent_seconds += before.spent_seconds
            if (before.state, row.state) == ("ran", "cached"):
                row.state = "ran"

    def to_json(self) -> dict[str, Any]:
        """A JSON object; keys as in docs/json.md."""
        return {
            "name": self.name,
            "variant": self.variant,
            "seed": self.seed,
            "status": self.status,
            "seconds": round(self.seconds, 3),
            "stages": [row.to_json() for row in self.stages],
            "metrics": self.metrics,
            "plan": self.plan,
            "report": self.report,
            "artefacts": self.artefacts,
            "digests": self.digests,
        }


def failed_outcome(sequence: str, reason: str, error: Exception | None = None) -> SequenceOutcome:
    """Of a run that failed before any stage of it began, or round them: the first stage stands for it.

    Args:
        sequence: its name.
        reason: why.
        error: the exception, where there was one.
    """
    row = StageRow("ingest", "failed", reason=without_credentials(reason))
    return SequenceOutcome(sequence, "failed", [row], error=error)


@dataclass
class DatasetOutcome:
    """Outcomes of the sequences of a run."""

    sequences: list[SequenceOutcome]
    report: str | None = None
    """Where the page that compares them stands."""

    @property
    def failed_share(self) -> float:
        """Share of the sequences that failed, 0 to 1."""
        failed = sum(outcome.status == "failed" for outcome in self.sequences)
        return failed / len(self.sequences) if self.sequences else 0.0

    def to_json(self, seconds: float) -> dict[str, Any]:
        """A JSON object; keys as in docs/json.md."""
        return {
            "seconds": round(seconds, 3),
            "sequences": [outcome.to_json() for outcome in self.sequences],
            "report": self.report,
        }


class SequenceFailedError(ExtragsError, RuntimeError):
    """A stage of a sequence failed; `outcome` holds everything else."""

    def __init__(self, outcome: SequenceOutcome) -> None:
        self.outcome = outcome
        failed = next((row for row in outcome.stages if row.state == "failed"), None)
        where = "" if failed is None else f" in {failed.stage}: {failed.reason}"
        super().__init__(f"{outcome.title} failed{where}")


class DatasetFailedError(ExtragsError, RuntimeError):
    """Too many sequences failed; `outcome` holds them all.

    Args:
        outcome: of the whole run.
        max_failed_share: the share of its sequences that might fail.
    """

    def __init__(self, outcome: DatasetOutcome, max_failed_share: float) -> None:
        self.outcome = outcome
        failed = [str(SequenceFailedError(item)) for item in outcome.sequences if item.status == "failed"]
        super().__init__(
            f"{len(failed)} of {len(outcome.sequences)} sequences failed, more than the share of "
            f"{max_failed_share:g} that may (max_failed_share): {'; '.join(failed)}"
        )


class BenchmarkFailedError(ExtragsError, RuntimeError):
    """Too many runs of a benchmark failed.

    Args:
        name: of the benchmark.
        result: what the flow would have returned; the `error` of its `cases` says why they failed.
        max_failed_share: the share of its runs that might fail.
    """

    def __init__(self, name: str, result: dict[str, Any], max_failed_share: float) -> None:
        self.result = result
        failed = [_told(case) for case in result["cases"] if case["error"]]
        super().__init__(
            f"{len(failed)} of {len(result['cases'])} runs of the benchmark {name} failed, more than the "
            f"share of {max_failed_share:g} that may (max_failed_share): {'; '.join(failed)}; "
            f"page: {result['report']}"
        )


def _told(case: dict[str, Any]) -> str:
    """A failed run of a benchmark, in words."""
    setting = f"@{case['setting']}" if case["setting"] else ""
    about = f"{case['method']}, {case['profile']}, seed {case['seed']}"
    return f"{case['sequence']}{setting} [{about}] failed in {case['error']}"
