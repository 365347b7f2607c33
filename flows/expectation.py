"""How long the runs of a dataset will take, before they begin; the longest come first."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import takewhile
from statistics import median

from data_catalog.names import comparable_name
from extrags.config import PipelineConfig
from extrags.errors import ExtragsError
from extrags.run_costs import Workload
from extrags.stages import STAGES, StageName, stages_until
from extrags.store import Store, digest_of
from flows.cases import SequenceCase
from flows.estimate import expected_seconds, usual_pace, without_kernels_in_words
from flows.methods import METHODS
from flows.outcome_records import OutcomeRecord, outcome_records, record_of, recorded_name
from flows.workloads import known_work, work_before_reading
from tasks.progress import duration_text

__all__ = ["Expectation", "expectations", "expected_words", "longest_first"]


@dataclass(frozen=True)
class Expectation:
    """How long a case will take.

    Args:
        case: which.
        seconds: expected.
        measured: whether from an earlier run of its sequence; else from the number and size of its frames.
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
        left_out = METHODS[case.method].leave_out
        wanted = [stage for stage in stages_until(until) if stage not in left_out]
        earlier = [*([own] if own is not None else []), *by_sequence.get(comparable_name(case.sequence), [])]
        times = _measured(earlier)
        local = _pace(earlier) or pace or usual_pace()
        work, possible = _work(case.sequence, config, earlier)
        base = expected_seconds(config, work)
        seconds = 0.0
        for stage in wanted:
            usual = sum(base[stage].values())
            if stage in times:
                took, expected = times[stage]
                seconds += took * (usual / expected if expected else 1.0)
            elif stage in possible and (not times or not _was_skipped(earlier, stage)):
                seconds += usual * local
        found.append(Expectation(case, seconds, measured=bool(times), sized=work is not None))
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
    """Whether a run of the same sequence left the stage out, and not because one before it had failed."""
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
            row for row in record["stages"] if row["state"] in ("ran", "cached") and row.get("expected_cpu_s")
        ]
        whole = sum(row["expected_cpu_s"] for row in rows)
        if whole:
            paces.append(sum(row["made_seconds"] for row in rows) / whole)
    return median(paces) if paces else None


def _work(
    sequence: str, config: PipelineConfig, records: Sequence[OutcomeRecord]
) -> tuple[Workload | None, Collection[str]]:
    """Size and stages of a sequence as far as they are known before it is read: a path's by its last run."""
    if known_work(sequence, config) is None:
        size = next((record["size"] for record in records if record.get("size")), None)
        if size is not None:
            return Workload(config=config, **size), STAGES
    try:
        return work_before_reading(sequence, config, ())
    except (ExtragsError, OSError):
        # One source that cannot be read, or whose disk has gone, must not stop the others.
        return None, STAGES
