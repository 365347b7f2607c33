"""How the last run of each sequence ended, as records in the store (`flows.cases` writes them)."""

from __future__ import annotations

import datetime
import math
import re
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from data_catalog.names import comparable_name
from extrags.pipeline import HELD_OUT_TRAINED_ON
from extrags.store import Store, read_records
from extrags.store.artefact_names import matches
from extrags.store.records import remove_record

__all__ = [
    "OUTCOME",
    "OutcomeRecord",
    "held_out_trained_on",
    "outcome_records",
    "record_of",
    "recorded_name",
    "recorded_page",
    "removable_outcomes",
    "report_key",
    "setting_text",
    "sweep_outcomes",
    "told_apart",
]

OUTCOME = "outcome."
"""Begin of the names of these records."""
REPORT = re.compile(r"report-v\d+-")
"""Begin of the keys of a sequence's own pages."""

OutcomeRecord = dict[str, Any]
"""`{sequence, path, method, profile, seed, variant, settings, until, status, stage, reason, ended, seconds,
config, size, stages, metrics, protocol, report, extrags}` of the last run of a case that came to an end.

`path` is the absolute one of a sequence that is a path, else None, `settings` are those that were given
(records of earlier versions lack both, and `protocol`, the version of the evaluation's), and the size is
that of `extrags.run_costs.Workload`. Of each stage
`{stage, state, reason, made_seconds, expected_cpu_s, artefacts: {KEY: BYTES}}`: seconds that it took, and
those of processor time that the cost model expects on its reference machine."""


class _Stage(BaseModel):
    stage: str
    state: str
    reason: str
    made_seconds: float
    expected_cpu_s: float = 0.0
    artefacts: dict[str, int]


class _Outcome(BaseModel):
    """Of `OutcomeRecord`, what is asked for: one damaged record must not stop the look at all others."""

    sequence: str
    path: str | None = None
    method: str
    profile: str
    seed: int | None
    variant: dict[str, Any]
    settings: dict[str, Any] = {}
    until: str
    status: str
    stage: str | None
    reason: str
    ended: str
    config: str
    size: dict[str, Any] | None = None
    stages: list[_Stage]
    metrics: dict[str, Any]
    report: str | None


def outcome_records(store: Store, name: str = OUTCOME) -> dict[str, OutcomeRecord]:
    """How the last run of each case ended, by the name of its record; damaged ones are left out.

    Args:
        store: that holds them.
        name: what their names begin with.

    Raises:
        StoreError: when the store cannot be read.
    """
    return read_records(store, name, _Outcome)


def removable_outcomes(store: Store, pattern: str, *, here: str | None = None) -> list[str]:
    """Names of the records of those sequences whose name or path a shell pattern means.

    A relative path may be the name of several sequences: where it is the pattern, those in one place are
    meant.

    Args:
        store: that holds them.
        pattern: of the names.
        here: absolute path that the pattern names for who gives it; None for none.

    Raises:
        StoreError: when the store cannot be read.
    """
    chosen = []
    for name, record in outcome_records(store).items():
        label, place = str(record["sequence"]), record.get("path")
        elsewhere = pattern == label != place and place not in (None, here)
        if matches(pattern, label, *([place] if place else [])) and not elsewhere:
            chosen.append(name)
    return chosen


def sweep_outcomes(
    store: Store, older_than_s: float, there: Collection[str], *, dry_run: bool = False
) -> list[str]:
    """Remove the records of runs that ended so long ago, and of which no artefact is left.

    Args:
        store: that holds them.
        older_than_s: how long ago.
        there: keys of the store's artefacts.
        dry_run: remove nothing.

    Returns:
        Names of the records that are gone, or would be.

    Raises:
        StoreError: when the store cannot be read, or a record not be removed.
    """
    limit = time.time() - older_than_s
    gone = []
    for name, record in outcome_records(store).items():
        keys = {key for row in record["stages"] for key in row["artefacts"]}
        if _ended(record) < limit and keys.isdisjoint(there):
            if not dry_run:
                remove_record(store, name)
            gone.append(name)
    return gone


def _ended(record: OutcomeRecord) -> float:
    """Seconds since 1970; of a date that is none, it is not known to be long ago."""
    try:
        return datetime.datetime.fromisoformat(str(record["ended"])).timestamp()
    except ValueError:
        return math.inf


def recorded_name(record: OutcomeRecord) -> str:
    """What the sequence of a record has in common with other names of it (`comparable_name`).

    A relative path of an earlier version's record is taken from where this is asked.
    """
    return str(record.get("path") or comparable_name(str(record["sequence"])))


def told_apart(records: Sequence[OutcomeRecord]) -> list[str]:
    """The name of each record's sequence: its path where relative ones of several places are the same."""
    places: dict[str, set[str]] = {}
    for record in records:
        places.setdefault(str(record["sequence"]), set()).add(recorded_name(record))
    return [
        recorded_name(record) if len(places[str(record["sequence"])]) > 1 else str(record["sequence"])
        for record in records
    ]


def record_of(records: Mapping[str, OutcomeRecord], name: str, former_name: str) -> OutcomeRecord | None:
    """The record of a case by its name, else by that which earlier versions gave it.

    Args:
        records: from `outcome_records`.
        name: `flows.cases.SequenceCase.record`.
        former_name: `flows.cases.SequenceCase.former_record`.
    """
    return records.get(name) or records.get(former_name)


def report_key(name: str) -> str | None:
    """The key of a page that is named by its file, its folder or itself; None for a sequence."""
    parts = [part for part in name.replace("\\", "/").split("/") if part]
    return next((part for part in reversed(parts[-2:]) if REPORT.match(part)), None)


def recorded_page(store: Store, record: OutcomeRecord, there: Collection[str]) -> str | None:
    """Where the page of a run on record is now; None where it has none, or not any more.

    The record has the address of when it was written: the store may have been moved or copied since.

    Args:
        store: that holds the record.
        record: of the run.
        there: keys of the store's artefacts.
    """
    key = report_key(record["report"]) if record["report"] else None
    if key is None or key not in there:
        return None
    file = str(record["report"]).rpartition("/")[2]
    return f"{store.backend.uri(key)}/{file}"


def held_out_trained_on(record: OutcomeRecord) -> bool:
    """Whether a run trained on the held-out frames that its figures are of."""
    return any(stage["reason"].startswith(HELD_OUT_TRAINED_ON) for stage in record["stages"])


def setting_text(settings: Mapping[str, Any]) -> str:
    """Settings in words: `coarse.iterations = 500, coarse.seed = 1`."""
    return ", ".join(f"{name} = {value}" for name, value in settings.items())
