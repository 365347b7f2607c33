"""The history of a benchmark in the store, and what has got worse since the runs before.

Every run that measured anew leaves one record, under a name of its own with its time: the history is only
ever appended to, by any number of machines.
"""

from __future__ import annotations

import datetime
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean, median
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from extrags import __version__
from extrags.errors import ExtragsError
from extrags.metrics.comparison import figure_of
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.metrics.regression import MACHINE, same_machine
from extrags.store import Store, digest_of, read_records, write_record

__all__ = [
    "BenchmarkRegressedError",
    "Judgement",
    "Tolerance",
    "append_history",
    "history_entry",
    "history_of",
    "judge",
    "trend",
]

FIGURES = ("observed.psnr", "psnr")
"""The figure a run is judged by is the first of these that it has."""

READABLE_LETTERS = 190
"""Letters of a benchmark's name in the names of its records: file systems allow 255 in all."""


class _Case(BaseModel):
    method: str
    profile: str
    sequence: str
    setting: str | None
    seed: int | None
    error: str | None
    asked: str = ""
    settings: str
    seconds: float
    processor_seconds: float | None = None
    figures: dict[str, float]


class _Entry(BaseModel):
    """Of an entry, what is asked for: one damaged record must not stop every later run of its benchmark."""

    name: str
    when: str
    commit: str | None
    version: str
    machine: dict[str, Any]
    cases: list[_Case]


class Tolerance(BaseModel):
    """How much worse than before a benchmark may be before its run counts as failed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    runs: int = Field(5, ge=1, le=100, description="the median of so many last runs is what counts as before")
    at_least: int = Field(2, ge=1, le=100, description="with fewer earlier runs nothing is judged")
    psnr_db: float | None = Field(
        0.3, ge=0, description="PSNR that may be lost, in dB, on the mean over seeds; none: not judged"
    )
    seconds_share: float | None = Field(
        0.3,
        ge=0,
        description="share by which run time may grow, on the same kind of machine; none: not judged",
    )
    seconds: float = Field(5.0, ge=0, description="growth of run time that is never too much, in seconds")

    @model_validator(mode="after")
    def _can_judge(self) -> Self:
        if self.at_least > self.runs:
            raise ValueError(
                f"at_least is {self.at_least}, but only the last {self.runs} runs are looked at (runs): "
                f"nothing would ever be judged; set at_least to {self.runs} or less"
            )
        return self


@dataclass(frozen=True)
class Judgement:
    """What came of holding a benchmark against its earlier runs, in words.

    Args:
        regressions: what is worse; each names method, sequence and figures.
        not_judged: what too few earlier runs can be compared with, and how many there are.
    """

    regressions: list[str] = field(default_factory=list)
    not_judged: list[str] = field(default_factory=list)


class BenchmarkRegressedError(ExtragsError, RuntimeError):
    """A benchmark is worse than its earlier runs.

    Args:
        name: of the benchmark.
        result: what the flow would have returned; its `regressions` say in what it is worse.
    """

    def __init__(self, name: str, result: dict[str, Any]) -> None:
        self.result = result
        self.found: list[str] = result["regressions"]
        super().__init__(
            f"benchmark {name} is worse than the runs before in {len(self.found)} respects: "
            f"{'; '.join(self.found)}; page: {result['report']}"
        )


def history_entry(
    name: str,
    cases: Sequence[Mapping[str, Any]],
    digests: Sequence[Mapping[str, str]],
    machine: Mapping[str, Any],
) -> dict[str, Any]:
    """What is kept of a run of a benchmark.

    Args:
        name: of the benchmark.
        cases: its runs as JSON (`flows.benchmark.case_of`).
        digests: `{asked, settings}` of each: digest of what was asked for, and of all
            settings that this came to.
        machine: `extrags.raster.bench.machine`.
    """
    return {
        "name": name,
        "when": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": machine["commit"],
        "version": __version__,
        "protocol": PROTOCOL_VERSION,
        "machine": {key: machine[key] for key in (*MACHINE, "load_average")},
        "cases": [
            {
                **{key: case[key] for key in ("method", "profile", "sequence", "setting", "seed", "error")},
                **digest,
                "seconds": case["seconds"],
                "processor_seconds": case.get("processor_seconds"),
                "peak_mib": case["peak_mib"],
                "figures": {
                    figure: value
                    for figure in FIGURES
                    if (value := figure_of(case["metrics"], figure)) is not None
                },
            }
            for case, digest in zip(cases, digests, strict=True)
        ],
    }


def append_history(store: Store, entry: Mapping[str, Any]) -> str:
    """Add an entry to the history; returns the name of its record.

    Raises:
        StoreError: when it cannot be written.
    """
    moment = re.sub(r"[^0-9T]", "", str(entry["when"]).partition("+")[0])
    # Two runs may end in the same second; neither replaces the other.
    record = f"{_prefix(str(entry['name']))}{moment}.{secrets.token_hex(4)}"
    write_record(store, record, entry)
    return record


def history_of(store: Store, name: str) -> list[dict[str, Any]]:
    """All entries of a benchmark, the oldest first; damaged ones are left out.

    Raises:
        StoreError: when the store cannot be read.
    """
    found = read_records(store, _prefix(name), _Entry).values()
    return sorted((entry for entry in found if entry["name"] == name), key=lambda entry: entry["when"])


def _prefix(name: str) -> str:
    # The digest, because several names may come to the same letters, of which a file's name takes so many.
    letters = re.sub(r"[^a-z0-9]+", "-", name.lower())[:READABLE_LETTERS]
    return f"benchmark.{letters}.{digest_of(name)[:8]}."


def judge(entry: Mapping[str, Any], earlier: Sequence[Mapping[str, Any]], tolerance: Tolerance) -> Judgement:
    """Hold a run against those before.

    Compared is the mean over seeds of each method on each sequence, with the median of the last
    `tolerance.runs` runs that did not fail, asked for the same settings and had these seeds: PSNR of those
    that are of the same version of the evaluation protocol, or do not say theirs, run time of those on the
    same kind of machine. Run time is processor time where enough of these runs have measured it, since other
    work on the machine hardly changes it; elapsed time otherwise. A case that fails is worse, too, until it
    is mended.

    Args:
        entry: of the run.
        earlier: entries of the runs before, the oldest first.
        tolerance: how much may be lost.
    """
    found = Judgement()
    remark = f"of {len(earlier)} earlier runs comparable (at least {tolerance.at_least})"
    before = [_comparable(item, entry) for item in earlier]
    same = [same_machine(item["machine"], entry["machine"]) for item in earlier]
    alike = [_same_protocol(item, entry) for item in earlier]
    for group, now in _comparable(entry, entry).items():
        label = _label(group)
        past = [groups[group] for groups in before if group in groups]
        # However long it has failed, the last good runs are what it is held against.
        good = [item for item in past if not item["error"]][-tolerance.runs :]
        if now["error"]:
            if len(good) >= tolerance.at_least:
                found.regressions.append(f"{label} fails: {now['error']}")
            else:
                found.not_judged.append(f"{label}: failure, {len(good)} {remark}")
            continue
        name = next((figure for figure in FIGURES if figure in now["figures"]), None)
        measured = [
            groups[group] for groups, mine in zip(before, alike, strict=True) if mine and group in groups
        ]
        measured = [item for item in measured if not item["error"]][-tolerance.runs :]
        known = [item["figures"][name] for item in measured if name in item["figures"]]
        if tolerance.psnr_db is not None and len(known) < tolerance.at_least:
            found.not_judged.append(f"{label}: {name or 'PSNR'}, {len(known)} {remark}")
        elif tolerance.psnr_db is not None:
            was, value = median(known), now["figures"][name]
            if was - value > tolerance.psnr_db:
                found.regressions.append(
                    f"{label}: {name} {value:.2f} dB, {was - value:.2f} dB below the median {was:.2f} of "
                    f"{len(known)} runs (tolerance {tolerance.psnr_db:g} dB)"
                )
        if tolerance.seconds_share is None:
            continue
        local = [groups[group] for groups, mine in zip(before, same, strict=True) if mine and group in groups]
        clock, kind = "processor_seconds", " of processor time"
        timed = [item for item in local if not item["error"]][-tolerance.runs :]
        times = [item[clock] for item in timed if item[clock] is not None]
        if now[clock] is None or len(times) < tolerance.at_least:
            clock, kind = "seconds", ""
            times = [item[clock] for item in timed]
        if len(times) < tolerance.at_least:
            found.not_judged.append(f"{label}: run time, {len(times)} {remark}")
        else:
            was, value = median(times), now[clock]
            if value - was > max(tolerance.seconds_share * was, tolerance.seconds):
                # What took no time, as what was in the store already, has no share of it.
                more = f"{value / was - 1:.0%}" if was > 0 else f"{value - was:.1f} s"
                found.regressions.append(
                    f"{label}: {value:.1f} s{kind}, {more} above the median {was:.1f} s of "
                    f"{len(times)} runs (tolerance {tolerance.seconds_share:.0%})"
                )
    return found


def trend(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The history as a page draws it, the oldest first.

    Returns:
        `{when, commit, version, methods: {METHOD: {psnr, seconds}}}` of each entry: means over all profiles,
        sequences, settings and seeds that did not fail in the last entry. A method that lacks one of them,
        or failed there, is left out of an entry: a mean over others would be another figure. Run times of
        other kinds of machines are None, and so is PSNR of another version of the evaluation protocol.
    """
    if not entries:
        return []
    last = entries[-1]
    wanted: dict[str, dict[tuple[str, ...], str | None]] = {}
    for group, values in _comparable(last, last).items():
        if not values["error"]:
            name = next((figure for figure in FIGURES if figure in values["figures"]), None)
            wanted.setdefault(group[0], {})[group] = name
    drawn = []
    for entry in entries:
        found = _comparable(entry, last)
        measured_alike = _same_protocol(entry, last)
        methods: dict[str, dict[str, float | None]] = {}
        for method, groups in wanted.items():
            if any(group not in found or found[group]["error"] for group in groups):
                continue
            psnr = [found[group]["figures"].get(name) for group, name in groups.items() if name is not None]
            methods[method] = {
                "psnr": _mean(psnr) if psnr and measured_alike else None,
                "seconds": fmean(found[group]["seconds"] for group in groups)
                if same_machine(entry["machine"], last["machine"])
                else None,
            }
        drawn.append({**{key: entry[key] for key in ("when", "commit", "version")}, "methods": methods})
    return drawn


def _comparable(entry: Mapping[str, Any], run: Mapping[str, Any]) -> dict[tuple[str, ...], dict[str, Any]]:
    """Means of an entry over the seeds of a run, for each method, profile and sequence of that run.

    What the entry does not have with the same settings and every one of these seeds is left out.
    """
    cases = {(_group(case), case["seed"]): case for case in entry["cases"]}
    grouped: dict[tuple[str, ...], list[Mapping[str, Any] | None]] = {}
    for asked in run["cases"]:
        case = cases.get((_group(asked), asked["seed"]))
        same = case is not None and _same_settings(case, asked)
        grouped.setdefault(_group(asked), []).append(case if same else None)
    return {
        group: _means([case for case in cases_of if case is not None])
        for group, cases_of in grouped.items()
        if None not in cases_of
    }


def _group(case: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(case[key] or "") for key in ("method", "profile", "sequence", "setting"))


def _same_settings(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    # Not all settings, or a release with another default or one setting more would not be judged. Entries of
    # earlier versions have their digest alone.
    key = "asked" if "asked" in one and "asked" in other else "settings"
    return bool(one[key] == other[key])


def _means(cases: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "error": next((case["error"] for case in cases if case["error"]), ""),
        "seconds": fmean(case["seconds"] for case in cases),
        "processor_seconds": _mean([case.get("processor_seconds") for case in cases]),
        "figures": {
            name: fmean(case["figures"][name] for case in cases)
            for name in FIGURES
            if all(name in case["figures"] for case in cases)
        },
    }


def _mean(values: Sequence[float | None]) -> float | None:
    """None where one of them is."""
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def _label(group: tuple[str, ...]) -> str:
    method, profile, sequence, setting = group
    return f"{method} ({profile}) on {sequence}{f'@{setting}' if setting else ''}"


def _same_protocol(earlier: Mapping[str, Any], entry: Mapping[str, Any]) -> bool:
    """Whether figures are of one version of the evaluation protocol; earlier entries may not say theirs."""
    return earlier.get("protocol") in (None, entry.get("protocol"))
