"""How long the runs of a dataset will take, before they begin; the longest come first."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from statistics import median

from data_catalog.names import comparable_name
from extrags.config import IngestConfig, PipelineConfig
from extrags.errors import ConfigError, ExtragsError
from extrags.pipeline import stages_that_can_run
from extrags.run_costs import Workload
from extrags.stages import StageName, stages_until
from extrags.store import Store, digest_of
from flows.cases import SequenceCase
from flows.estimate import expected_seconds, usual_pace, without_kernels_in_words
from flows.methods import METHODS
from flows.outcome_records import OutcomeRecord, outcome_records, record_of, recorded_name
from flows.settings import pipeline_config
from flows.workloads import usual_work, work_before_reading
from tasks.progress import duration_text

__all__ = ["Expectation", "expectations", "expected_words", "longest_first"]


@dataclass(frozen=True)
class Expectation:
    """How long a case will take.

    Args:
        case: which.
        seconds: expected.
        measured: whether from an earlier run of as many frames of its sequence, of the same size; else from
            the number and size of its frames.
        sized: whether these are known; else they are taken to be those of a phantom.
    """

    case: SequenceCase
    seconds: float
    measured: bool
    sized: bool = True


def expectations(
    cases: Sequence[SequenceCase], root: str, until: StageName, *, refresh: bool = False
) -> list[Expectation]:
    """How long each case will take, in the order given.

    A stage takes as long as in the last run of the same sequence, in proportion to what the cost model
    expects of the settings; else what that expects of its frames, at the pace of the runs that are on record.
    Cases that are in the store with the same settings take no time.

    Args:
        cases: to be run.
        root: of the store.
        until: last stage.
        refresh: whether everything is made anew.

    Raises:
        StoreError: when the store cannot be read.
    """
    store = Store(root)
    records = outcome_records(store)
    keys = set(store.keys()) if records else set()
    pace = _pace(list(records.values()))
    by_sequence: dict[str, list[OutcomeRecord]] = {}
    for record in records.values():
        by_sequence.setdefault(recorded_name(record), []).append(record)
    found = []
    for case in cases:
        config = case.config()
        own = record_of(records, case.record, case.former_record)
        if not refresh and own is not None and _is_finished(own, config, until, keys):
            found.append(Expectation(case, 0.0, measured=True))
            continue
        earlier = [*([own] if own is not None else []), *by_sequence.get(comparable_name(case.sequence), [])]
        work, possible = _work(case, config, earlier)
        same = [item for item in earlier if work is None or item.get("size") in (None, work.size)]
        measured = _measured(same)
        times = {**_measured(earlier), **measured}
        local = _pace(earlier) or pace or usual_pace()
        base = expected_seconds(config, work)
        # What another method does without says nothing of this one.
        alike = [item for item in earlier if item["method"] == case.method]
        seconds = 0.0
        for stage in stages_until(until):
            if stage not in possible:
                continue
            usual = sum(base[stage].values())
            if stage in times:
                took, expected = times[stage]
                seconds += took * (usual / expected if expected else 1.0)
            elif not times or not _was_skipped(alike, stage):
                seconds += usual * local
        found.append(Expectation(case, seconds, measured=bool(measured), sized=work is not None))
    return found


def longest_first(expected: Sequence[Expectation]) -> list[Expectation]:
    """Those that take longest first: one that begins last would keep the others' workers waiting."""
    return sorted(expected, key=lambda item: -item.seconds)


def expected_words(expected: Sequence[Expectation], at_once: int = 1, *, processes: bool = False) -> str:
    """`24 runs, about 3 h; 20 as measured in earlier runs, 4 by their frames`.

    Args:
        expected: of all runs.
        at_once: how many go on at the same time.
        processes: each of these on cores of its own; in one process they share the cores, and each is charged
            its share of the time.
    """
    busy = [0.0] * (max(1, at_once) if processes else 1)
    for item in longest_first(expected) if at_once > 1 else expected:
        busy[busy.index(min(busy))] += item.seconds
    known = sum(item.measured for item in expected)
    words = [f"{len(expected)} {'run' if len(expected) == 1 else 'runs'}, about {duration_text(max(busy))}"]
    if at_once > 1:
        words.append(f"{at_once} at once")
    unread = sum(not item.measured and not item.sized for item in expected)
    reasons = {
        "as measured in earlier runs": known,
        "by their frames": len(expected) - known - unread,
        "as a phantom of 48 frames, not being read yet": unread,
    }
    given = [f"{count} {reason}" for reason, count in reasons.items() if count]
    words += [", ".join(given)] if len(given) > 1 else [item.partition(" ")[2] for item in given]
    return "; ".join(words) + (without_kernels_in_words() if known < len(expected) else "")


def _is_finished(record: OutcomeRecord, config: PipelineConfig, until: StageName, keys: set[str]) -> bool:
    return (
        until in stages_until(record["until"])
        and record["status"] == "ok"
        and record["config"] == digest_of(config)
        and all(key in keys for row in record["stages"] for key in row["artefacts"])
    )


def _measured(records: Sequence[OutcomeRecord]) -> dict[str, tuple[float, float]]:
    """Seconds that each stage took, and that were expected of it, in the first record that has them."""
    found: dict[str, tuple[float, float]] = {}
    for record in records:
        for row in record["stages"]:
            if row["state"] in ("ran", "cached") and row["made_seconds"] > 0:
                found.setdefault(row["stage"], (row["made_seconds"], row.get("expected_cpu_s", 0.0)))
    return found


def _was_skipped(records: Sequence[OutcomeRecord], stage: str) -> bool:
    """Whether one of the runs left the stage out, and not because one before it had failed."""
    return any(
        row["stage"] == stage and row["state"] == "skipped"
        for record in records
        for row in takewhile(lambda row: row["state"] != "failed", record["stages"])
    )


def _pace(records: Sequence[OutcomeRecord]) -> float | None:
    """Seconds per expected second, the median over records."""
    paces = []
    for record in records:
        rows = [
            row
            for row in record["stages"]
            # How long reading takes says nothing of other stages (`extrags.run_costs.tells_pace`).
            if row["stage"] != "ingest" and row["state"] in ("ran", "cached") and row.get("expected_cpu_s")
        ]
        whole = sum(row["expected_cpu_s"] for row in rows)
        if whole:
            paces.append(sum(row["made_seconds"] for row in rows) / whole)
    return median(paces) if paces else None


def _work(
    case: SequenceCase, config: PipelineConfig, records: Sequence[OutcomeRecord]
) -> tuple[Workload | None, Collection[StageName]]:
    """Size and stages of a sequence as far as they are known before it is read.

    A run with the same settings of `ingest` tells the size best; any other one where the source tells none.
    """
    leave_out = METHODS[case.method].leave_out
    sized = [record for record in records if record.get("size")]
    work: Workload | None
    try:
        work, possible = work_before_reading(case.sequence, config, leave_out)
        sized = [record for record in sized if _is_read_alike(record, config)]
    except (ExtragsError, OSError):
        # One source that cannot be read, or whose disk has gone, must not stop the others.
        work, told = None, usual_work(config)
        possible = stages_that_can_run(
            config, leave_out, has_poses=False, has_depth=False, train=told.train, test=told.test
        )
    return (Workload(config=config, **sized[0]["size"]) if sized else work), possible


def _is_read_alike(record: OutcomeRecord, config: PipelineConfig) -> bool:
    """Whether a run read its frames with the same settings; records of earlier versions do not tell."""
    if "settings" not in record:
        return False
    given = {**record["settings"], **record["variant"]}
    own = {name: value for name, value in given.items() if name.startswith("ingest.")}
    return _ingest_of(record["profile"], json.dumps(own)) == config.ingest


@cache
def _ingest_of(profile: str, settings: str) -> IngestConfig | None:
    """Of a run on record; no method sets any of it. None where profile or settings are not there any more."""
    try:
        return pipeline_config(profile, json.loads(settings)).ingest
    except ConfigError:
        return None
