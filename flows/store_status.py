"""The state of a whole dataset, from its store alone: every sequence by every stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from data_catalog.catalog import resolve
from data_catalog.names import comparable_name
from data_catalog.patterns import is_named
from extrags.errors import ExtragsError, UnknownSequenceError
from extrags.metrics.comparison import figure_of
from extrags.stages import STAGES, all_tasks, stage_of_task, stages_until
from extrags.store import Manifest, Store, in_work
from extrags.store.manifest import stage_of
from extrags.store.runs import Run, active_runs, runs_of
from flows.outcome_records import (
    OutcomeRecord,
    outcome_records,
    recorded_name,
    recorded_page,
    setting_text,
    told_apart,
)
from flows.selection import chosen_sequences

__all__ = ["StageStatus", "StatusRow", "StoreStatus", "store_status"]

State = Literal["done", "skipped", "failed", "missing", "running", "stopped"]

SCENES = frozenset(task.name for task in all_tasks() if task.in_place)
"""Tasks that make what the task of the stage's name otherwise makes."""
OTHER_SETTINGS = "other settings"
"""Variant of what is being run with settings that no run on record has."""
FRAMES = frozenset(task.name for task in all_tasks() if task.shared)
"""Tasks that several stages have run: they do not tell how far a run has come."""


@dataclass(frozen=True)
class StageStatus:
    """One stage of one sequence.

    Args:
        state: `missing` where nothing is there, because it was never run or was removed.
        seconds: it took to make what is there.
        bytes: of what is there.
        reason: why it failed or was skipped.
        artefacts: keys of what it consists of, which other sequences may share.
    """

    state: State
    seconds: float = 0.0
    bytes: int = 0
    reason: str = ""
    artefacts: frozenset[str] = frozenset()


@dataclass(frozen=True)
class StatusRow:
    """One sequence under one method, seed and settings.

    Args:
        sequence: its name.
        variant: method, profile, seed and what a matrix changed, in words.
        state: `failed` where the last run did, `running` where one of its artefacts is being made now, or a
            run is going on that is its first or tries again what failed, `done` where all of its stages are
            there, `stopped` where its only runs were interrupted, else `missing`.
        reason: why it failed.
        ended: when its last run came to an end, UTC; empty where none is on record.
        psnr: of the final scene, in dB.
        stages: by name.
        report: where its page is; None where there is none, or not any more.
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
        unrecorded: artefacts of stages that neither a run on record nor one that is going on has: of runs
            with other settings, of benchmarks, of versions that left no record. Pages of several sequences
            are not among them.
    """

    store: str
    rows: Sequence[StatusRow]
    artefacts: int
    bytes: int
    unrecorded: int
    counts: Mapping[State, int] = field(default_factory=dict)

    @property
    def seconds(self) -> float:
        """All rows together took; a stage that several of them share counts once."""
        found = [stage for row in self.rows for stage in row.stages.values()]
        shared = {stage.artefacts: stage.seconds for stage in found if stage.artefacts}
        return sum(shared.values()) + sum(stage.seconds for stage in found if not stage.artefacts)

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
    """Look a store over: one listing of its keys and one small record per run, no artefact is read.

    Of a run that has not come to an end, also the manifests of what it has made.

    Args:
        store: of which.
        patterns: names, patterns or `@FILE`; what the catalogue has for them is shown also where it was
            never run. All that is in the store by default.

    Raises:
        UnknownSequenceError: for a pattern that matches nothing, in the store or the catalogue, and for a
            name that is in neither and no path.
        StoreError: when the store cannot be read.
    """
    found = list(outcome_records(store).values())
    shown_as = told_apart(found)
    places = {name: recorded_name(record) for record, name in zip(found, shown_as, strict=True)}
    labels = {str(record["sequence"]) for record in found}
    keys = store.keys()
    there = set(keys)
    running: dict[str, set[str]] = {}
    # Pages of several sequences are in work under a name of their own.
    making = [item for item in in_work(store) if _stage_of(item["stage"]) in STAGES]
    for item in making:
        running.setdefault(item["label"], set()).add(_stage_of(item["stage"]))
    going_on = active_runs(store)
    for run in going_on:
        running.setdefault(run.sequence, set())
    unfinished = _unfinished(store, going_on, labels)
    # What is in work is known by the name that it was given: of which of several places, nothing tells.
    others = {*running, *unfinished} - (labels - set(shown_as))
    names = _names(patterns, {**{name: comparable_name(name) for name in others}, **places})
    rows: list[StatusRow] = []
    bytes_of: dict[str, int] = {}
    recorded: set[str] = {key for run in (*going_on, *unfinished.values()) for key in run.keys}
    for record, name in zip(found, shown_as, strict=True):
        made = {key: size for row in record["stages"] for key, size in row["artefacts"].items()}
        recorded |= set(made)
        if name in names:
            bytes_of |= {key: size for key, size in made.items() if key in there}
            row = _row(record, there, _making(record, making, going_on))
            again = _again(record, going_on)
            if row.reason and again is not None:
                # What failed is being tried again: how the run before ended is no news any more.
                manifests = _manifests(store, again.keys & there)
                bytes_of |= {manifest.key: manifest.bytes for manifest in manifests}
                now = _unrecorded(name, again, running.get(again.sequence, set()), manifests)
                row = replace(now, variant=row.variant, ended=row.ended)
            rows.append(replace(row, sequence=name, report=recorded_page(store, record, there)))
    shown = {row.sequence for row in rows}
    for name in names:
        if name not in shown:
            manifests = _manifests(store, unfinished[name].keys & there) if name in unfinished else []
            bytes_of |= {manifest.key: manifest.bytes for manifest in manifests}
            rows.append(_unrecorded(name, unfinished.get(name), running.get(name), manifests))
    for name, run in _unlike(found, going_on).items():
        if name in shown:
            manifests = _manifests(store, run.keys & there)
            bytes_of |= {manifest.key: manifest.bytes for manifest in manifests}
            row = _unrecorded(name, run, running.get(name, set()), manifests)
            rows.append(replace(row, variant=OTHER_SETTINGS))
    order = {name: place for place, name in enumerate(names)}
    rows.sort(key=lambda row: (order[row.sequence], row.variant))
    counts: dict[State, int] = {}
    for row in rows:
        counts[row.state] = counts.get(row.state, 0) + 1
    # Pages of several sequences are of no one run.
    unrecorded = sum(key not in recorded and _stage_of(stage_of(key)) in STAGES for key in keys)
    return StoreStatus(store.root, rows, len(keys), sum(bytes_of.values()), unrecorded, counts)


def _unfinished(store: Store, going_on: Sequence[Run], ended: set[str]) -> dict[str, Run]:
    """Of sequences of which no run came to an end: the run that is going on, or was interrupted last.

    Runs that are going on together count as one.
    """
    found: dict[str, Run] = {}
    for run in runs_of(store):
        if run.sequence not in ended:
            found[run.sequence] = run
    found = {name: run for name, run in found.items() if run.interrupted}
    for name in {run.sequence for run in going_on} - ended:
        keys = frozenset(key for run in going_on if run.sequence == name for key in run.keys)
        found[name] = Run("", name, "", keys)
    return found


def _making(record: OutcomeRecord, making: Sequence[Mapping[str, str]], going_on: Sequence[Run]) -> set[str]:
    """Stages of a run on record that are being made again now.

    What is made for runs with other settings alone is none of them, unless this run has the artefact as well.
    Where nothing tells the settings of the runs that are going on, it may be any.
    """
    own = {key for row in record["stages"] for key in row["artefacts"]}
    runs = [run for run in going_on if run.sequence == record["sequence"]]
    unlike = bool(runs) and all(_has_other_settings(run, record) for run in runs)
    return {
        _stage_of(item["stage"])
        for item in making
        if item["label"] == record["sequence"] and (item["key"] in own or not unlike)
    }


def _again(record: OutcomeRecord, going_on: Sequence[Run]) -> Run | None:
    """The run that is going on with the settings of a run on record; None without one."""
    keys = [
        run.keys
        for run in going_on
        if run.sequence == record["sequence"]
        and run.config
        and run.config == record.get("config")
        and (run.place or comparable_name(run.sequence)) == recorded_name(record)
    ]
    return Run("", str(record["sequence"]), "", frozenset().union(*keys)) if keys else None


def _unlike(records: Sequence[OutcomeRecord], going_on: Sequence[Run]) -> dict[str, Run]:
    """By sequence: what runs with settings that none on record of it has have made so far."""
    keys: dict[str, frozenset[str]] = {}
    for run in going_on:
        same = [record for record in records if record["sequence"] == run.sequence]
        if same and all(_has_other_settings(run, record) for record in same):
            keys[run.sequence] = keys.get(run.sequence, frozenset()) | run.keys
    return {name: Run("", name, "", found) for name, found in keys.items()}


def _has_other_settings(run: Run, record: OutcomeRecord) -> bool:
    return bool(run.config) and run.config != record.get("config")


def _manifests(store: Store, keys: Iterable[str]) -> list[Manifest]:
    found = []
    for key in sorted(keys):
        try:
            ref = store.find(key)
            if ref is not None:
                found.append(store.manifest(ref))
        except ExtragsError:
            continue  # Damaged, or removed just now: not there for this look.
    return found


def _names(patterns: Sequence[str], on_record: Mapping[str, str]) -> list[str]:
    """The names that patterns stand for.

    Args:
        patterns: see `store_status`.
        on_record: what each name that is known has in common with others of its sequence.
    """
    known = sorted(on_record)
    if not patterns:
        return known
    names: dict[str, None] = {}
    for pattern in patterns:
        # A sequence may be in the store although its data are not on this machine.
        same = comparable_name(pattern)
        found = [name for name in known if is_named(name, pattern) or on_record[name] == same]
        try:
            chosen = [item.name for item in chosen_sequences([pattern])]
            for name in chosen:
                if comparable_name(name) not in {
                    on_record.get(other, comparable_name(other)) for other in found
                }:
                    _check_known(name)
                    found.append(name)
        except ExtragsError:
            if not found:
                raise
        names |= dict.fromkeys(found)
    return list(names)


def _check_known(name: str) -> None:
    """Raises `UnknownSequenceError` for what is neither in the catalogue nor a path."""
    try:
        resolve(name)
    except UnknownSequenceError:
        raise
    except ExtragsError:
        # Its data are elsewhere or wrong: that concerns who runs it.
        return


def _row(record: OutcomeRecord, there: set[str], running: set[str]) -> StatusRow:
    stages = {}
    for row in record["stages"]:
        stages[row["stage"]] = _stage(row, there, running)
    for name in stages_until(record["until"]):
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
    seconds = row["made_seconds"] if left else 0.0
    return StageStatus(state, seconds, sum(left), row["reason"], frozenset(row["artefacts"]))


def _unrecorded(
    name: str, run: Run | None, running: set[str] | None, manifests: Sequence[Manifest]
) -> StatusRow:
    """A sequence of which no run has come to an end.

    Args:
        name: its name.
        run: that is going on or was interrupted; None where there was none.
        running: its stages that are being made now; None where no run is going on.
        manifests: of what the run has made or found.
    """
    made: dict[str, list[Manifest]] = {}
    for manifest in manifests:
        made.setdefault(_stage_of(manifest.stage), []).append(manifest)
    now = running or set()
    keys = () if run is None else run.keys
    come_to = {_stage_of(task) for task in map(stage_of, keys) if task not in FRAMES} | now
    reached = max((STAGES.index(stage) for stage in STAGES if stage in come_to), default=0)
    stages: dict[str, StageStatus] = {}
    for place, stage in enumerate(STAGES):
        own = made.get(stage, [])
        whole = any(item.stage == stage or item.stage in SCENES for item in own)
        state: State = "missing"
        if stage in now:
            state = "running"
        elif whole or (own and place < reached):
            state = "done"
        elif place < reached and stage not in come_to:
            state = "skipped"  # Stages run in this order.
        stages[stage] = StageStatus(state, sum(item.seconds for item in own), sum(item.bytes for item in own))
    if running is not None:
        return StatusRow(name, "", "running", "", "", None, stages)
    ended = "" if run is None else run.ended
    return StatusRow(name, "", "missing" if run is None else "stopped", "", ended, None, stages)


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
    """The stage that a task belongs to: `enhance-restore` to `enhance`; else the task itself."""
    stage = stage_of_task(task)
    if stage is not None:
        return stage.name
    # Programs of other versions share the store, and their tasks begin with the names of their stages.
    return next((name for name in STAGES if task.startswith(f"{name}-")), task)
