"""The state of a whole dataset, from its store alone: every sequence by every stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from data_catalog.patterns import is_named
from extrags.errors import ExtragsError
from extrags.metrics.comparison import figure_of
from extrags.pipeline import STAGES
from extrags.store import Store, in_work
from flows.outcome_records import OutcomeRecord, outcome_records, setting_text
from flows.selection import chosen_sequences

__all__ = ["StageStatus", "StatusRow", "StoreStatus", "store_status"]

State = Literal["done", "skipped", "failed", "missing", "running"]

TASKS = {
    "training-frames": "coarse",
    "depth-frames": "coarse",
    "refined-frames": "coarse",
    "continued-coarse": "coarse",
    "plan": "assess",
    "uc-nerf": "coarse",
    "uc-nerf-render": "evaluate",
}
"""Stages of the tasks that do not begin with the name of theirs."""


@dataclass(frozen=True)
class StageStatus:
    """One stage of one sequence.

    Args:
        state: `missing` where nothing is there, because it was never run or was removed.
        seconds: it took to make what is there.
        bytes: of what is there.
        reason: why it failed or was skipped.
    """

    state: State
    seconds: float = 0.0
    bytes: int = 0
    reason: str = ""


@dataclass(frozen=True)
class StatusRow:
    """One sequence under one method, seed and settings.

    Args:
        sequence: its name.
        variant: method, profile, seed and what a matrix changed, in words.
        state: `failed` where the last run did, `running` where one of its artefacts is being made now,
            `done` where all of its stages are there, else `missing`.
        reason: why it failed.
        ended: when its last run came to an end, UTC; empty where none is on record.
        psnr: of the final scene, in dB.
        stages: by name.
        report: where its page is.
    """

    sequence: str
    variant: str
    state: State
    reason: str
    ended: str
    psnr: float | None
    stages: Mapping[str, StageStatus]
    report: str | None = None

    @property
    def seconds(self) -> float:
        """All stages together took."""
        return sum(stage.seconds for stage in self.stages.values())

    @property
    def bytes(self) -> int:
        """Of all artefacts; those that other rows share count in each."""
        return sum(stage.bytes for stage in self.stages.values())


@dataclass(frozen=True)
class StoreStatus:
    """All of it.

    Args:
        store: its root.
        rows: by sequence.
        artefacts: how many there are, of these rows and of all others.
        bytes: of the artefacts of these rows, each counted once.
        unrecorded: artefacts that no row has: of runs with other settings, of benchmarks, of versions that
            left no record.
    """

    store: str
    rows: Sequence[StatusRow]
    artefacts: int
    bytes: int
    unrecorded: int
    counts: Mapping[State, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """A JSON object; keys as in docs/command_line.md."""
        return {
            "store": self.store,
            "artefacts": self.artefacts,
            "unrecorded": self.unrecorded,
            "bytes": self.bytes,
            "counts": dict(self.counts),
            "sequences": [
                {
                    "sequence": row.sequence,
                    "variant": row.variant,
                    "state": row.state,
                    "reason": row.reason,
                    "ended": row.ended,
                    "psnr": row.psnr,
                    "seconds": round(row.seconds, 3),
                    "bytes": row.bytes,
                    "report": row.report,
                    "stages": {
                        name: {
                            "state": stage.state,
                            "seconds": round(stage.seconds, 3),
                            "bytes": stage.bytes,
                            "reason": stage.reason,
                        }
                        for name, stage in row.stages.items()
                    },
                }
                for row in self.rows
            ],
        }


def store_status(store: Store, patterns: Sequence[str] = ()) -> StoreStatus:
    """Look a store over: one listing of its keys and one small record per sequence, no artefact is read.

    Args:
        store: of which.
        patterns: names, patterns or `@FILE`; what the catalogue has for them is shown also where it was
            never run. All that is in the store by default.

    Raises:
        UnknownSequenceError: for a pattern that matches nothing, in the store or the catalogue.
        StoreError: when the store cannot be read.
    """
    records = list(outcome_records(store).values())
    keys = store.keys()
    there = set(keys)
    running: dict[str, set[str]] = {}
    for item in in_work(store):
        running.setdefault(item["label"], set()).add(_stage_of(item["stage"]))
    names = _names(patterns, records, running)
    rows: list[StatusRow] = []
    bytes_of: dict[str, int] = {}
    recorded: set[str] = set()
    for record in records:
        made = {key: size for row in record["stages"] for key, size in row["artefacts"].items()}
        recorded |= set(made)
        if record["sequence"] in names:
            bytes_of |= {key: size for key, size in made.items() if key in there}
            rows.append(_row(record, there, running.get(record["sequence"], set())))
    shown = {row.sequence for row in rows}
    rows += [_unrecorded(name, running.get(name, set())) for name in names if name not in shown]
    order = {name: place for place, name in enumerate(names)}
    rows.sort(key=lambda row: (order[row.sequence], row.variant))
    counts: dict[State, int] = {}
    for row in rows:
        counts[row.state] = counts.get(row.state, 0) + 1
    unrecorded = sum(key not in recorded for key in keys)
    return StoreStatus(store.root, rows, len(keys), sum(bytes_of.values()), unrecorded, counts)


def _names(
    patterns: Sequence[str], records: Sequence[OutcomeRecord], running: Mapping[str, Any]
) -> list[str]:
    known = list(dict.fromkeys([*sorted(str(record["sequence"]) for record in records), *sorted(running)]))
    if not patterns:
        return known
    names: dict[str, None] = {}
    for pattern in patterns:
        # A sequence may be in the store although its data are not on this machine.
        found = [name for name in known if is_named(name, pattern)]
        try:
            found += [item.name for item in chosen_sequences([pattern])]
        except ExtragsError:
            if not found:
                raise
        names |= dict.fromkeys(found)
    return list(names)


def _row(record: OutcomeRecord, there: set[str], running: set[str]) -> StatusRow:
    stages = {}
    for row in record["stages"]:
        stages[row["stage"]] = _stage(row, there, running)
    for name in STAGES[: STAGES.index(record["until"]) + 1]:
        stages.setdefault(name, StageStatus("running" if name in running else "missing"))
    states = {stage.state for stage in stages.values()}
    state: State = "done"
    if "running" in states:
        state = "running"
    elif record["status"] == "failed":
        state = "failed"
    elif "missing" in states:
        state = "missing"
    return StatusRow(
        sequence=record["sequence"],
        variant=_variant(record),
        state=state,
        reason=f"{record['stage']}: {record['reason']}" if record["status"] == "failed" else "",
        ended=record["ended"],
        psnr=figure_of(record["metrics"].get("final"), "psnr"),
        stages=stages,
        report=record["report"],
    )


def _stage(row: Mapping[str, Any], there: set[str], running: set[str]) -> StageStatus:
    left = [size for key, size in row["artefacts"].items() if key in there]
    state: State
    if row["stage"] in running:
        state = "running"
    elif row["state"] in ("failed", "skipped"):
        state = row["state"]
    else:
        state = "done" if len(left) == len(row["artefacts"]) else "missing"
    return StageStatus(state, row["made_seconds"] if left else 0.0, sum(left), row["reason"])


def _unrecorded(name: str, running: set[str]) -> StatusRow:
    """A sequence of which no run has come to an end."""
    stages: dict[str, StageStatus] = {
        stage: StageStatus("running" if stage in running else "missing") for stage in STAGES
    }
    return StatusRow(name, "", "running" if running else "missing", "", "", None, stages)


def _variant(record: OutcomeRecord) -> str:
    words = [record["profile"]]
    if record["method"] != "extrags":
        words.append(record["method"])
    if record["seed"] is not None:
        words.append(f"seed {record['seed']}")
    if record["variant"]:
        words.append(setting_text(record["variant"]))
    return ", ".join(words)


def _stage_of(task: str) -> str:
    """The stage that a task belongs to: `enhance-restore` to `enhance`."""
    return TASKS.get(task) or next(
        (stage for stage in STAGES if task == stage or task.startswith(f"{stage}-")), task
    )
