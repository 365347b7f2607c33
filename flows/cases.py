"""The runs of a dataset: sequences times methods, seeds and settings; which of them are to be run."""

from __future__ import annotations

import datetime
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal

from data_catalog.names import path_of
from extrags import __version__
from extrags.config import DEFAULT_PROFILE, PipelineConfig
from extrags.errors import ConfigError, DamagedArtefactError, StoreError
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.stages import STAGES, StageName
from extrags.store import Store, digest_of, write_record
from extrags.store.records import remove_record
from extrags.user_paths import absolute
from flows.estimate import expected_seconds
from flows.methods import METHODS, check_not_pinned, method_config, pinned_settings
from flows.outcome import SequenceOutcome, StageRow
from flows.outcome_records import OUTCOME, OutcomeRecord, outcome_records, record_of, setting_text
from flows.runners import NotInStoreError, StoreRunner
from flows.selection import Chosen
from flows.wiring import run_sequence
from flows.workloads import frames_work, known_work
from tasks.progress import observed

__all__ = [
    "Only",
    "SequenceCase",
    "cases_of",
    "matrix_points",
    "record_outcome",
    "record_outcome_quietly",
    "selected",
]

log = logging.getLogger(__name__)

IMPORTED = "imported.scene"

Only = Literal["failed", "changed", "missing"]
"""Which cases of a run are taken: those whose last run failed; those of which something would be made; those
that have never been run to their end."""


@dataclass(frozen=True)
class SequenceCase:
    """One run of a sequence among those of a dataset.

    Args:
        sequence: its name.
        method: of `flows.methods.METHODS`.
        profile: named settings.
        seed: of all stages; None leaves each stage's own.
        settings: overrides, those of a manifest among them.
        changed: what a matrix sets on top of them.
        variant: what sets it apart from the others of its sequence, in words; empty where there are none.
    """

    sequence: str
    method: str = "extrags"
    profile: str = DEFAULT_PROFILE
    seed: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    changed: Mapping[str, Any] = field(default_factory=dict)
    variant: str = ""

    @property
    def title(self) -> str:
        """The sequence, and the variant where there is one."""
        return f"{self.sequence} [{self.variant}]" if self.variant else self.sequence

    @property
    def distinguishing(self) -> dict[str, Any]:
        """Settings whose runs stand beside each other: those of a matrix, and the scene that is imported.

        The scene's path is absolute: a file is one, however and from wherever it is named.
        """
        found = self._distinguishing_as_given
        scene = found.get(IMPORTED)
        return {**found, IMPORTED: str(absolute(scene))} if scene else found

    @property
    def _distinguishing_as_given(self) -> dict[str, Any]:
        imported = {IMPORTED: self.settings[IMPORTED]} if self.settings.get(IMPORTED) else {}
        return {**imported, **self.changed}

    @property
    def record(self) -> str:
        """Name of the record of its last run.

        Other settings that are the same for all runs of a sequence are not part of it: who mends them runs
        the same case again.
        """
        return self._record_of(path_of(self.sequence) or self.sequence, self.distinguishing)

    @property
    def former_record(self) -> str:
        """What earlier versions called it: with paths as they were written, from whichever folder.

        The path of an imported scene was for longer than that of the sequence.
        """
        given = self._distinguishing_as_given
        place = self.sequence if given == self.distinguishing else path_of(self.sequence)
        return self._record_of(place or self.sequence, given)

    def _record_of(self, sequence: str, variant: Mapping[str, Any]) -> str:
        told = {
            "sequence": sequence,
            "method": self.method,
            "profile": self.profile,
            "seed": self.seed,
            "variant": dict(variant),
        }
        return f"{OUTCOME}{digest_of(told)}"

    def config(self) -> PipelineConfig:
        """All of its settings.

        Raises:
            ConfigError: for a setting that is wrong, or that the method sets itself.
        """
        overrides = {**self.settings, **self.changed}
        check_not_pinned(self.method, overrides)
        return method_config(self.method, self.profile, overrides, self.seed)


def matrix_points(matrix: Mapping[str, Sequence[Any]] | None) -> list[dict[str, Any]]:
    """Every combination of the values of a matrix; one that is empty without a matrix.

    Raises:
        ConfigError: for a setting without values, or with one twice.
    """
    matrix = matrix or {}
    for name, values in matrix.items():
        if not values or len({repr(value) for value in values}) < len(values):
            raise ConfigError(f"the matrix needs one or more different values of {name}: {list(values)}")
    return [dict(zip(matrix, point, strict=True)) for point in product(*matrix.values())]


def cases_of(
    chosen: Sequence[Chosen],
    *,
    methods: Sequence[str],
    profile: str,
    seeds: Sequence[int | None],
    settings: Mapping[str, Any],
    matrix: Mapping[str, Sequence[Any]] | None = None,
) -> list[SequenceCase]:
    """Every sequence with every method, seed and point of the matrix.

    Of several methods, each takes the settings that it does not set itself, as in a benchmark; a matrix
    must have an effect on all of them.

    Raises:
        ConfigError: for a method or seed that is given twice; for wrong settings, once for all sequences that
            have the same.
    """
    for what, values in (("method", methods), ("seed", seeds)):
        if not values or len(set(values)) < len(values):
            raise ConfigError(f"expected one or more different {what}s: {', '.join(map(str, values))}")
    points = matrix_points(matrix)
    checked: set[str] = set()
    found = []
    for item, method, seed, point in product(chosen, methods, seeds, points):
        words = [
            *([method] if len(methods) > 1 else []),
            *([f"seed {seed}"] if len(seeds) > 1 else []),
            *([setting_text(point)] if point else []),
        ]
        own = {**settings, **item.settings}
        if len(methods) > 1:
            pinned = pinned_settings(method) - {"coarse.train_on"}  # Refused whatever the method.
            own = {name: value for name, value in own.items() if name not in pinned}
        case = SequenceCase(item.name, method, profile, seed, own, point, ", ".join(words))
        same = digest_of([method, seed, dict(case.settings), point])
        if same not in checked:
            checked.add(same)
            try:
                case.config()
            except ConfigError as error:
                raise ConfigError(
                    f"{case.title}: {error}" if item.settings or point else str(error)
                ) from error
        found.append(case)
    return found


def selected(
    cases: Sequence[SequenceCase], only: Only | None, root: str, until: StageName
) -> list[SequenceCase]:
    """The cases that a run takes, as the store tells.

    Args:
        cases: all of them.
        only: which; None takes all.
        root: of the store.
        until: last stage of the run.

    Raises:
        StoreError: when the store cannot be read.
    """
    if only is None:
        return list(cases)
    if only == "changed":
        return [case for case in cases if _would_run(case, root, until)]
    records = outcome_records(Store(root))
    if only == "failed":
        found = [(case, record_of(records, case.record, case.former_record)) for case in cases]
        return [case for case, record in found if record is not None and record["status"] == "failed"]

    def came_so_far(case: SequenceCase) -> bool:
        record = record_of(records, case.record, case.former_record)
        return record is not None and (
            record["status"] == "failed" or not _is_earlier(record["until"], until)
        )

    return [case for case in cases if not came_so_far(case) and _would_run(case, root, until)]


def _is_earlier(until: str, than: str) -> bool:
    return until in STAGES and than in STAGES and STAGES.index(until) < STAGES.index(than)


def _would_run(case: SequenceCase, root: str, until: StageName) -> bool:
    """Whether any stage would have to be made now."""

    def ignore(_: object) -> None:
        """Looking is no progress."""

    try:
        with observed(ignore):
            outcome = run_sequence(
                case.sequence,
                case.config(),
                root,
                StoreRunner(root),
                profile=case.profile,
                # The page is made anew for its texts; that is no change of the sequence.
                until="evaluate" if until == "report" else until,
                leave_out=METHODS[case.method].leave_out,
            )
    except (NotInStoreError, DamagedArtefactError):
        return True
    return outcome.status == "failed"


def record_outcome(
    store: Store, case: SequenceCase, outcome: SequenceOutcome, until: StageName, config: PipelineConfig
) -> None:
    """Leave in the store how a run of a case ended, in place of how the one before did.

    A run that was to end earlier than that one, and did, leaves its record as it is: a plan has no figures to
    put in the place of those of a finished run.

    Raises:
        StoreError: when it cannot be read or written.
    """
    names = (case.record, case.former_record)
    before = record_of(
        {key: row for name in names for key, row in outcome_records(store, name).items()}, *names
    )
    if before is not None and outcome.status != "failed" and _is_earlier(until, before["until"]):
        return
    failed = next((row for row in outcome.stages if row.state == "failed"), None)
    work = known_work(case.sequence, config)
    if work is None and "ingest" in outcome.refs:
        work = frames_work(store.manifest(outcome.refs["ingest"]).counts, config)
    expected: dict[str, float] = {
        stage: sum(tasks.values()) for stage, tasks in expected_seconds(config, work).items()
    }
    record: OutcomeRecord = {
        "sequence": case.sequence,
        "path": path_of(case.sequence),
        "method": case.method,
        "profile": case.profile,
        "seed": case.seed,
        "variant": case.distinguishing,
        "settings": dict(case.settings),
        "until": until,
        "status": outcome.status,
        "stage": None if failed is None else failed.stage,
        "reason": "" if failed is None else failed.reason,
        # Two runs of what is in the store already end within a second, and one of them is the last.
        "ended": datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds"),
        "seconds": round(outcome.seconds, 3),
        "config": digest_of(config),
        "size": None if work is None else work.size,
        "stages": [_stage_record(row, expected.get(row.stage, 0.0)) for row in outcome.stages],
        "metrics": outcome.metrics,
        "protocol": PROTOCOL_VERSION,
        "report": outcome.report,
        "extrags": __version__,
    }
    write_record(store, case.record, record)
    if case.former_record != case.record:
        remove_record(store, case.former_record)


def record_outcome_quietly(
    store: Store, case: SequenceCase, outcome: SequenceOutcome, until: StageName, config: PipelineConfig
) -> None:
    """As `record_outcome`; a store that fails now must not hide how the run ended."""
    try:
        record_outcome(store, case, outcome, until, config)
    except StoreError as error:
        log.warning("%s: how it ended is not on record: %s", case.title, error)


def _stage_record(row: StageRow, expected: float) -> dict[str, Any]:
    return {
        "stage": row.stage,
        "state": row.state,
        "reason": row.reason,
        "made_seconds": round(row.made_seconds, 3),
        "expected_cpu_s": round(expected, 6),
        "artefacts": row.made,
    }
