"""Which artefacts to keep: by age, size, version, runs and reachability; and what each sequence uses.

Nothing is removed that a run which is going on has used, that was used a moment ago, or that a kept artefact
was made from. What is removed all the same while a run looks for it is made anew by that run: artefacts
disappear atomically.
"""

from __future__ import annotations

import datetime
import logging
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from extrags.errors import StoreError
from extrags.stages import PAGES_OF_SEVERAL, all_tasks
from extrags.store.artefacts import Store
from extrags.store.manifest import Manifest, stage_of
from extrags.store.runs import Run, active_runs, forget, runs_of

__all__ = ["Cleaning", "Policy", "Removal", "SequenceUsage", "apply_policy", "planned_removals", "usage"]

log = logging.getLogger(__name__)

MOMENT_S = 600.0
"""What was made or used within it is kept: a run may have it in hand, and not have recorded it yet."""
AHEAD_S = 86400.0
"""By so much the clock of another machine that shares the store may be ahead. A time still later is that of a
clock that was wrong, and has been set back: it would be kept until then."""

_LAST_MOMENT = datetime.datetime.max.replace(microsecond=0, tzinfo=datetime.UTC).timestamp()
"""File systems hold times beyond the last that has a date."""

FINAL_STAGES = frozenset({"report", *PAGES_OF_SEVERAL})
"""Where a run has no record, its page stands for it, with what that was made from."""

INTERMEDIATE_STAGES = frozenset(task.name for task in all_tasks() if task.intermediate)
"""Figures of the views of several scenes, from which the metrics of each are taken. They stay with the
metrics, which other runs may share, but do not keep the other scenes."""


@dataclass(frozen=True)
class Policy:
    """What is removed; each rule alone suffices.

    Args:
        older_than_s: not used for so long.
        max_bytes: the least recently used, until the store is no larger.
        keep_last: of each sequence, what only runs before its last so many runs used; a run that found the
            same artefacts as a former one counts once, one that did not come to its figures not at all.
        unreachable: what none of the runs that are kept used: settings that were tried and left.
        versions: what an earlier version of its stage made, by the current version of each stage. What a
            later one made stays: programs of several versions may share a store.
        with_inputs: also what kept artefacts were made from.
    """

    older_than_s: float | None = None
    max_bytes: int | None = None
    keep_last: int | None = None
    unreachable: bool = False
    versions: Mapping[str, int] = field(default_factory=dict)
    with_inputs: bool = False


@dataclass(frozen=True)
class Removal:
    """An artefact that goes, and why."""

    key: str
    sequence: str
    bytes: int
    reason: str


@dataclass(frozen=True)
class Cleaning:
    """What a policy removes, or has removed.

    Args:
        removed: the artefacts in the order of their removal, what was made from others before these.
        runs: whose records go with them.
        skipped: keys of artefacts whose manifest cannot be read: they stay, and neither what they were made
            from nor when they were used is known.
        refused: why others could not be removed, by key; they stay with what they were made from.
    """

    removed: list[Removal]
    runs: list[Run]
    skipped: list[str]
    refused: dict[str, StoreError] = field(default_factory=dict)


@dataclass(frozen=True)
class SequenceUsage:
    """What the artefacts of a sequence use; those of several sequences count where they were first made.

    Args:
        sequence: its display name; its path where several in other places have this name.
        artefacts: number.
        files: number, manifests among them.
        bytes: of all files but manifests.
        made: the latest, UTC, ISO 8601.
        used: the latest; on object stores, when it was made, or a run on record ended that used it.
    """

    sequence: str
    artefacts: int
    files: int
    bytes: int
    made: str
    used: str


class _Contents:
    """The artefacts of a store, what they were made from, and when they were used last.

    Where a store keeps no time of use, as object stores, the records of runs tell.

    Args:
        store: which.
        runs: that ended.
    """

    def __init__(self, store: Store, runs: Iterable[Run]) -> None:
        found, self.unreadable = store.manifests()
        self.manifests = {manifest.key: manifest for manifest in found}
        used = store.backend.last_used(self.manifests)
        self.used = {key: used.get(key, _made(item)) for key, item in self.manifests.items()}
        for run in runs:
            ended = _moment(run.ended)
            for key in run.keys & self.used.keys():
                if key not in used:
                    self.used[key] = max(self.used[key], ended)

    def with_inputs(self, keys: Iterable[str]) -> set[str]:
        """Artefacts, and all those they were made from."""
        found: set[str] = set()
        waiting = [key for key in keys if key in self.manifests]
        while waiting:
            key = waiting.pop()
            if key not in found:
                found.add(key)
                inputs = self.manifests[key].input_keys.values() if not _is_intermediate(key) else ()
                waiting += [name for name in inputs if name in self.manifests]
        return found

    def in_order_of_use(self) -> list[str]:
        """Least recently used first; what an artefact was made from counts as used with it, after it."""
        latest, depth = dict(self.used), {}
        for key in sorted(self.manifests, key=self.used.__getitem__, reverse=True):
            for name in self.with_inputs([key]):
                latest[name] = max(latest[name], self.used[key])
        for key in self.manifests:
            depth[key] = len(self.with_inputs([key]))
        return sorted(self.manifests, key=lambda key: (latest[key], -depth[key], key))


def planned_removals(store: Store, policy: Policy, *, now: float | None = None) -> Cleaning:
    """What a policy would remove.

    Args:
        store: to be cleaned.
        policy: the rules.
        now: seconds since 1970.

    Raises:
        StoreError: when the store cannot be read.
    """
    return _planned(policy, *_looked_over(store), time.time() if now is None else now)


def _looked_over(store: Store) -> tuple[_Contents, list[Run], list[Run]]:
    """What there is, the runs that ended, and those that are going on."""
    # Before and after: one that ends meanwhile is among the others, and one may begin.
    going_on = active_runs(store)
    runs = runs_of(store)
    contents = _Contents(store, runs)
    return contents, runs, [*going_on, *active_runs(store)]


def _planned(
    policy: Policy, contents: _Contents, runs: list[Run], going_on: list[Run], now: float
) -> Cleaning:
    runs = [replace(run, ended=max(run.ended, _last_time(run, contents))) for run in runs]
    kept_runs, former = _last_runs(_with_pages(runs, contents), policy.keep_last)
    of_kept = {key for run in kept_runs for key in run.keys}
    reasons = {
        key: f"of version {item.version} of its stage, which is at {policy.versions[item.stage]}"
        for key, item in contents.manifests.items()
        if item.version < policy.versions.get(item.stage, item.version)
    }
    if policy.older_than_s is not None:
        limit = now - policy.older_than_s
        reasons |= {
            key: f"not used since {_date(used)}" for key, used in contents.used.items() if used < limit
        }
    if policy.keep_last is not None:
        stale = {key for run in former for key in run.keys} - of_kept
        reasons |= dict.fromkeys(stale, f"of none of the last {policy.keep_last} runs")
    if policy.unreachable:
        reached = contents.with_inputs(of_kept)
        reasons |= {key: "of no run that is kept" for key in contents.manifests if key not in reached}
    held = {key for run in going_on for key in run.keys}
    held |= {key for key, used in contents.used.items() if _is_in_hand(used, now)}
    held = contents.with_inputs(held)
    removed = _removable(reasons, held, contents, policy)
    if policy.max_bytes is not None:
        size = sum(item.bytes for key, item in contents.manifests.items() if key not in removed)
        for key in contents.in_order_of_use():
            if size <= policy.max_bytes:
                break
            if key not in removed and key not in held:
                removed[key] = f"used least recently, {_date(contents.used[key])}"
                size -= contents.manifests[key].bytes
    order = sorted(removed, key=lambda key: (-len(contents.with_inputs([key])), key))
    found = [
        Removal(key, contents.manifests[key].label, contents.manifests[key].bytes, removed[key])
        for key in order
    ]
    left = contents.manifests.keys() - removed.keys()
    gone = [run for run in runs if run in former or not run.keys & left]
    return Cleaning(found, gone, contents.unreadable)


def apply_policy(store: Store, policy: Policy) -> Cleaning:
    """Remove what a policy does not keep; returns what was removed, and what could not be.

    What cannot be removed, as an artefact of another user, stays with what it was made from, and hinders no
    other.

    Raises:
        StoreError: when the store cannot be read, or a record of a run not be removed.
    """
    contents, runs, going_on = _looked_over(store)
    plan = _planned(policy, contents, runs, going_on, time.time())
    removed = []
    spared: set[str] = set()
    refused: dict[str, StoreError] = {}
    for item in plan.removed:
        # A run may have begun to use it since; then it needs what that was made from.
        if item.key not in spared:
            used = store.backend.last_used([item.key]).get(item.key, 0.0)
            if _is_in_hand(used, time.time()):
                spared |= contents.with_inputs([item.key])
                continue
            try:
                if store.backend.discard(item.key):
                    removed.append(item)
            except StoreError as error:
                refused[item.key] = error
                spared |= contents.with_inputs([item.key])
    gone = [run for run in plan.runs if not run.keys & refused.keys()]
    forget(store, gone)
    return Cleaning(removed, gone, plan.skipped, refused)


def usage(store: Store) -> list[SequenceUsage]:
    """What each sequence uses, the largest first."""
    contents = _Contents(store, runs_of(store))
    by_sequence: dict[str, list[Manifest]] = defaultdict(list)
    places: dict[str, set[str]] = defaultdict(set)
    for item in contents.manifests.values():
        places[item.label] |= {item.place} - {""}
    for item in contents.manifests.values():
        # Earlier versions did not say where.
        by_sequence[(len(places[item.label]) > 1 and item.place) or item.label].append(item)
    rows = [
        SequenceUsage(
            label,
            len(items),
            sum(item.files + 1 for item in items),
            sum(item.bytes for item in items),
            max(item.started for item in items),
            _date(max(contents.used[item.key] for item in items)),
        )
        for label, items in by_sequence.items()
    ]
    return sorted(rows, key=lambda row: (-row.bytes, row.sequence))


def _removable(
    reasons: Mapping[str, str], held: set[str], contents: _Contents, policy: Policy
) -> dict[str, str]:
    """Candidates that nothing holds: no run, nor, unless asked, an artefact that was made from them."""
    wanted = {key: why for key, why in reasons.items() if key in contents.manifests and key not in held}
    if policy.with_inputs:
        return wanted
    needed = contents.with_inputs(key for key in contents.manifests if key not in wanted)
    return {key: why for key, why in wanted.items() if key not in needed}


def _with_pages(runs: list[Run], contents: _Contents) -> list[Run]:
    """Runs with records, and, for those from before there were records, their pages."""
    recorded = {key for run in runs for key in run.keys}
    pages = [
        Run(
            "",
            item.label,
            _date(contents.used[key]),
            frozenset(contents.with_inputs([key])),
            place=item.place,
        )
        for key, item in contents.manifests.items()
        if item.stage in FINAL_STAGES and key not in recorded
    ]
    return sorted([*runs, *pages], key=lambda run: run.ended)


def _last_time(run: Run, contents: _Contents) -> str:
    """A run that only finds what is there may leave no record: when all that it needs was last used."""
    used = [contents.used[key] for key in _looked_up(run) if key in contents.used]
    return _date(min(used, default=0.0))


def _last_runs(runs: list[Run], count: int | None) -> tuple[list[Run], list[Run]]:
    """The last runs of each sequence, and the former ones.

    Of runs that were taken to their figures so many count, and those that ended early are kept with the ones
    after which they came: a plan, an evaluation of other images or a failure takes the place of none.
    """
    if count is None:
        return runs, []
    by_sequence: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        # Relative names of several places may be the same.
        by_sequence[run.place or run.sequence].append(run)
    kept = []
    for each in by_sequence.values():
        # Of those that used the same the last one stands for all.
        last = {_looked_up(run): place for place, run in enumerate(each) if _has_figures(run)}
        whole = sorted(last.values()) or list(range(len(each)))
        kept += each[whole[-min(count, len(whole))] :]
    return kept, [run for run in runs if run not in kept]


def _has_figures(run: Run) -> bool:
    return any(stage_of(key) in {"evaluate", *FINAL_STAGES} for key in run.keys)


def _looked_up(run: Run) -> frozenset[str]:
    """What every run of the same settings looks up.

    Metrics of earlier versions do not say which figures they were taken from: these are used by the first run
    alone.
    """
    return frozenset(key for key in run.keys if not _is_intermediate(key))


def _is_intermediate(key: str) -> bool:
    return stage_of(key) in INTERMEDIATE_STAGES


def _is_in_hand(used: float, now: float) -> bool:
    return now - MOMENT_S < used < now + AHEAD_S


def _made(manifest: Manifest) -> float:
    started = _moment(manifest.started)
    return started + manifest.seconds if started else 0.0  # The first manifests had no date.


def _moment(text: str) -> float:
    """Seconds since 1970 of a date; 0 of none."""
    try:
        return datetime.datetime.fromisoformat(text).timestamp()
    except ValueError:
        return 0.0


def _date(moment: float) -> str:
    moment = min(moment, _LAST_MOMENT)
    return datetime.datetime.fromtimestamp(moment, datetime.UTC).isoformat(timespec="seconds")
