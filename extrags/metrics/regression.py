"""Two results of one benchmark: what has got worse, and what is noise.

Runs of both results that have everything in common, seed and repeat included, are pairs; a difference is
judged by the spread of the pairs' differences (one-sided t test). Where seeds or repeats do not match, the
two samples are compared as they are. Repeats of a seed count once for a figure.

What is noise then, and what is certain, is said by `extrags.metrics.significance`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np

from extrags.errors import ConfigError
from extrags.metrics.comparison import figure_of
from extrags.metrics.registry import Figure, figures
from extrags.metrics.significance import LEVEL, MATTERS, Change, changes_over_sequences, judge_changes

__all__ = [
    "COST_NAMES",
    "GROUP",
    "MACHINE",
    "compare_results",
    "grouped_runs",
    "known_sizes",
    "repetition",
    "same_machine",
]

COST_NAMES = ("seconds", "processor_seconds", "peak_mib")
SIZE = ("width", "height")
GROUP = ("method", "profile", "budget", "sequence", "setting", *SIZE)
"""What runs have in common that differ in seed and repeat alone."""
MACHINE = ("processor", "cores", "threads", "isa", "device")
"""What must be equal for run times to be comparable; keys of `extrags.raster.bench.machine`."""


def same_machine(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether results are of one kind of machine: times of others are not compared.

    Results from before the device was recorded say nothing of it; theirs is not compared.
    """
    keys = [key for key in MACHINE if key != "device" or (one.get(key) and other.get(key))]
    return all(one.get(key) == other.get(key) for key in keys)


def compare_results(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Compare two results of `bench pipeline` or `benchmark`.

    Args:
        before: JSON of the reference: `{machine, cases}`.
        after: of what is judged.

    Returns:
        `{level, times_judged, memory_judged, protocols, other_settings, rows, failed, missing, regressions,
        not_judged}`. A row has what its
        runs share (`sequence` is None over all sequences of a method), the quantity, whether it is a cost or
        whole figure (`primary`), means, the worsening (share
        of a cost or figure, or dB; `absolute`, in its own unit, of what was 0; positive is worse), its 95 %
        interval and a verdict: `worse`, `better`, `noise`, `equal`, or `not judged` where seeds are too few
        to tell a change of `PLAUSIBLE` times what matters from noise. `failed` names groups of
        runs that fail now and did not; `missing` those that are not in `after`, wholly or with a seed or
        repeat, and figures that no run there has any more. Times and memory are judged on one kind of
        machine only, figures by one version of the evaluation protocol: of another, the same renders may have
        other ones.
        Memory is not judged either where runs of one result shared stages and those of the other did not
        (`sharing`): who finds a stage made has not its peak. `other_settings` names groups whose runs were
        asked for with other settings, though they are called alike, as variants may be: what they
        differ in may be why.
        `protocols` has both versions, null for results that say none, whose figures are judged.
        `regressions` has the rows that are worse, and what fails or is missing, in words; `not_judged` the
        primary rows that seem worse by more than matters and could not be judged.

    Raises:
        ConfigError: for a document that is no such result, or two that have no group in common.
    """
    found = [_cases(before, "the first result"), _cases(after, "the second result")]
    sizes = [known_sizes(cases) for cases in found]
    sides = [grouped_runs(found[0], sizes), grouped_runs(found[1], sizes[::-1])]
    common = [group for group in sides[0] if group in sides[1]]
    if not common:
        raise ConfigError("the two results have no method, budget, sequence and size of images in common")
    same = same_machine(before.get("machine") or {}, after.get("machine") or {})
    protocols = [_protocol(document) for document in (before, after)]
    sharing = [_shares_stages(document) for document in (before, after)]
    same_sharing = None in sharing or sharing[0] == sharing[1]
    one_protocol = None in protocols or protocols[0] == protocols[1]
    rows: list[Change] = []
    failed = []
    other_settings = []
    missing = [f"{_label(group)} was not run" for group in sides[0] if group not in sides[1]]
    for group in common:
        was, now = (side[group] for side in sides)
        if (error := _new_failure(was, now)) is not None:
            failed.append(f"{_label(group)} fails: {error}")
        costs = [name for name in COST_NAMES if same and (same_sharing or name != "peak_mib")]
        rows += _rows(group, was, now, costs=costs, with_figures=one_protocol)
        if told := _other_settings(group, (was, before), (now, after)):
            other_settings.append(told)
        if gone := _gone(was, now):
            missing.append(f"{_label(group)} was not run with {'; '.join(gone)}")
        if one_protocol:
            missing += [f"{_label(group)} has no {name}" for name in _lost(was, now)]
    rows += changes_over_sequences(rows)
    judge_changes(rows)
    worse = [_words(row) for row in rows if row.verdict == "worse"]
    return {
        "level": LEVEL,
        "times_judged": same,
        "memory_judged": same and same_sharing,
        "protocols": protocols,
        "other_settings": other_settings,
        "rows": [row.to_json() for row in rows],
        "failed": failed,
        "missing": missing,
        "regressions": [*failed, *missing, *worse],
        "not_judged": [
            _words(row)
            for row in rows
            if row.primary and row.verdict == "not judged" and row.worsening >= MATTERS[row.kind]
        ],
    }


def _shares_stages(document: Mapping[str, Any]) -> bool | None:
    """Whether a grid's runs made common stages once; None for results that do not say."""
    if isinstance(document.get("separate"), bool):
        return not document["separate"]
    # Earlier grids have it in words alone.
    sharing = document.get("sharing")
    return None if sharing is None else not str(sharing).startswith("none")


def _protocol(document: Mapping[str, Any]) -> int | None:
    """Version of the protocol that figures were measured by; None of results that do not say it."""
    found = document.get("protocol")
    return found if isinstance(found, int) else None


def _cases(document: Mapping[str, Any], which: str) -> list[Mapping[str, Any]]:
    cases = document.get("cases")
    known = [figure.name for figure in figures()]
    if not isinstance(cases, list) or not cases or not all(_is_case(case, known) for case in cases):
        raise ConfigError(
            f"{which} is no JSON of `bench pipeline` or `benchmark`: its `cases` lack fields, or have others "
            "in their place"
        )
    for name in ("machine", "methods"):
        if not isinstance(document.get(name) or {}, Mapping):
            raise ConfigError(f"{which} is no JSON of `bench pipeline` or `benchmark`: `{name}` is no object")
    return cases


def _is_case(case: Any, known: Sequence[str]) -> bool:
    """Whether it has all fields that are compared, and each of its kind."""
    needed = {"method", "profile", "sequence", "setting", "seed", "seconds", "metrics", "error"}
    if not isinstance(case, Mapping) or not needed <= set(case):
        return False
    names = [case.get(name) for name in (*GROUP, "error")]
    numbers = [case.get(name) for name in ("seed", "repeat", *COST_NAMES)]
    size = case.get("image_size") or (None, None)
    if not isinstance(size, list | tuple) or len(size) != len(SIZE):
        return False
    numbers += size
    try:
        for name in known:
            figure_of(case["metrics"], name)
    except (TypeError, ValueError):
        return False
    return (
        all(isinstance(value, str | int | float | None) for value in names)
        and all(isinstance(value, int | float | None) for value in numbers)
        and isinstance(case["metrics"], Mapping | None)
    )


def known_sizes(cases: Sequence[Mapping[str, Any]]) -> dict[tuple[Any, ...], set[tuple[Any, ...]]]:
    """The sizes of images of all runs that have something in common but these."""
    found: dict[tuple[Any, ...], set[tuple[Any, ...]]] = {}
    for case in cases:
        size = _size(case)
        if any(size):
            found.setdefault(_but_size(case), set()).add(size)
    return found


def _size(case: Mapping[str, Any]) -> tuple[Any, ...]:
    """Width and height in px, as results of `bench pipeline` or of `benchmark` have it; None: not known."""
    named = tuple(case.get(key) for key in SIZE)
    return named if any(named) else tuple(case.get("image_size") or (None, None))


def _but_size(case: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(case.get(key) for key in GROUP if key not in SIZE)


def grouped_runs(
    cases: Sequence[Mapping[str, Any]], sizes: Sequence[Mapping[tuple[Any, ...], set[tuple[Any, ...]]]]
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Runs by what they have in common (`GROUP`).

    A run that failed before the size of its frames was known counts as one of the size that the other runs
    have, if it is one.

    Args:
        cases: of one result.
        sizes: from `known_sizes`, of the same result and of the other one.
    """
    found: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for case in cases:
        # Results of `benchmark` have no budgets, and earlier ones no sizes.
        group, size = _but_size(case), _size(case)
        if not any(size):
            # Or it failed while its frames were read, before it was known. That of other runs of it.
            known = next((side[group] for side in sizes if len(side.get(group, ())) == 1), {size})
            (size,) = known
        found.setdefault((*group, *size), []).append(case)
    return found


def _other_settings(
    group: tuple[Any, ...], *sides: tuple[Sequence[Mapping[str, Any]], Mapping[str, Any]]
) -> str:
    """What tells that the runs of a group were asked for with other settings, in words; empty for nothing.

    Args:
        group: what the runs have in common.
        sides: its runs in each result, and the result.
    """
    asked = [{run.get("asked") for run in runs} for runs, _ in sides]
    variants = [str((document.get("methods") or {}).get(group[0], "")) for _, document in sides]
    given = [_given(runs) for runs, _ in sides]
    if any(None in digests for digests in asked):
        # Earlier results have words alone; those of a method may be worded anew, those of a variant say
        # what it changes.
        differs = (all(" = " in words for words in variants) and variants[0] != variants[1]) or (
            None not in given and given[0] != given[1]
        )
    else:
        differs = asked[0] != asked[1]
    if not differs:
        return ""
    told = [f"{was or 'nothing'}, now {now or 'nothing'}" for was, now in (variants, given) if was != now]
    return f"{_label(group)} was asked for with other settings{': ' if told else ''}{'; '.join(told)}"


def _given(runs: Sequence[Mapping[str, Any]]) -> str | None:
    """Settings that were given beside the profile, in words; None where it is not known."""
    found = {
        ", ".join(f"{name} = {value}" for name, value in sorted(run["settings"].items()))
        for run in runs
        if isinstance(run.get("settings"), Mapping)
    }
    return " or ".join(sorted(found)) if found else None


def _new_failure(was: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> str | None:
    """The error of a run that fails and did not; of one that was not run before, if none failed."""
    before = {repetition(run): bool(run["error"]) for run in was}
    unstable = any(before.values())
    for run in now:
        if run["error"] and not before.get(repetition(run), unstable):
            return str(run["error"])
    return None


def _gone(was: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> list[str]:
    """Seeds and repeats that are not there any more, in words; none where all of them are other ones."""
    before, after = ({repetition(run) for run in runs} for runs in (was, now))
    if not before & after:
        return []
    repeated = any(repeat for _, repeat in before)
    return [
        f"seed {seed}{f', repeat {repeat}' if repeated else ''}" for seed, repeat in sorted(before - after)
    ]


def _lost(was: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> list[str]:
    """Figures that every run had that did not fail, and none of those now has."""
    if all(run["error"] for run in now):
        return []
    good = [run for run in was if not run["error"]]
    return [
        figure.name
        for figure in figures()
        if good
        and all(figure_of(run["metrics"], figure.name) is not None for run in good)
        and not _values(now, figure.name, figure)
    ]


def _rows(
    group: tuple[Any, ...],
    was: Sequence[Mapping[str, Any]],
    now: Sequence[Mapping[str, Any]],
    *,
    costs: Sequence[str],
    with_figures: bool,
) -> list[Change]:
    about = dict(zip(GROUP, group, strict=True))
    wanted: list[tuple[str, str, Figure | None]] = [(name, "cost", None) for name in costs]
    if with_figures:
        wanted += [(figure.name, "dB" if figure.unit == "dB" else "other", figure) for figure in figures()]
    found = []
    for name, kind, figure in wanted:
        sides = [_values(runs, name, figure) for runs in (was, now)]
        if not all(sides) or _says_it_again(figure, sides, was, now):
            continue
        shared = [key for key in sides[0] if key in sides[1]]
        paired = len(shared) == max(len(sides[0]), len(sides[1])) or len(shared) > 1
        samples = [[side[key] for key in shared] if paired else list(side.values()) for side in sides]
        found.append(_row(about, name, kind, figure, paired, samples))
    return found


def _values(runs: Sequence[Mapping[str, Any]], name: str, figure: Figure | None) -> dict[Any, float]:
    """A cost by seed and repeat; a figure by seed, its mean over the repeats.

    Repeats of a seed have the same figure to the last bit: they tell nothing about its noise.
    """
    found: dict[Any, list[float]] = {}
    for run in runs:
        value = run.get(name) if figure is None else figure_of(run["metrics"], figure.name)
        if not run["error"] and value is not None and math.isfinite(value):
            key = repetition(run) if figure is None else run["seed"]
            found.setdefault(key, []).append(float(value))
    return {key: fmean(values) for key, values in found.items()}


def _says_it_again(
    figure: Figure | None,
    sides: Sequence[Mapping[Any, float]],
    was: Sequence[Mapping[str, Any]],
    now: Sequence[Mapping[str, Any]],
) -> bool:
    """Whether it is of all pixels where the mask is full: the overall figure under another name."""
    if figure is None or figure.name != f"whole.{figure.key}":
        return False
    return list(sides) == [_values(runs, figure.key, replace(figure, name=figure.key)) for runs in (was, now)]


def _is_primary(figure: Figure | None) -> bool:
    """Costs, and the figures of all valid pixels and of the surface that tables show.

    Others are of parts of these pixels, with one gain per view, or other measures of the same errors.
    """
    return figure is None or (
        figure.name in {shown.name for shown in figures("differences") if "." not in shown.name}
        or figure.name in {shown.name for shown in figures("counts")}
    )


def repetition(run: Mapping[str, Any]) -> tuple[Any, ...]:
    """Seed and repeat of a run."""
    return run["seed"], run.get("repeat", 0)


def _row(
    about: dict[str, Any],
    name: str,
    kind: str,
    figure: Figure | None,
    paired: bool,
    samples: Sequence[Sequence[float]],
) -> Change:
    sign = -1.0 if figure is not None and figure.higher_is_better else 1.0
    before, after = (np.asarray(sample, dtype=np.float64) for sample in samples)
    # Costs are multiplied by what slows a machine: they are compared as shares, by their logarithms.
    logarithms = kind == "cost" and before.min() > 0 and after.min() > 0
    if kind != "dB" and before.mean() == 0:
        kind = "absolute"
    if logarithms:
        x, y = np.log(before), np.log(after)
    else:
        scale = 1.0 if kind in ("dB", "absolute") else abs(float(before.mean()))
        x, y = before / scale, after / scale
    parts = [sign * (y - x)] if paired else [x, y]
    freedom = sum(len(part) - 1 for part in parts)
    squares = sum(float(((part - part.mean()) ** 2).sum()) for part in parts)
    n = min(map(len, parts))
    return Change(
        about,
        name,
        kind,
        paired,
        n,
        float(before.mean()),
        float(after.mean()),
        _is_primary(figure),
        logarithms,
        float(parts[0].mean()) if paired else sign * float(y.mean() - x.mean()),
        squares / freedom if n > 1 else None,
        freedom,
        sum(1 / len(part) for part in parts),
        tuple(parts[0].tolist()) if paired else (),
    )


def _words(row: Change) -> str:
    def amount(value: float) -> str:
        return {"dB": f"{value:.2f} dB", "absolute": f"{value:.4g}"}.get(row.kind, f"{value:.1%}")

    interval = ""
    if row.low is not None and row.high is not None:
        interval = f" [{amount(row.in_unit(row.low))} to {amount(row.in_unit(row.high))}]"
    return (
        f"{_label(tuple(row.about.values()))}: {row.quantity} {row.before:.4g} to {row.after:.4g}, worse by "
        f"{amount(row.worsening)}{interval}, {row.n} {'pairs' if row.paired else 'runs a side'}"
    )


def _label(group: tuple[Any, ...]) -> str:
    method, profile, budget, sequence, setting, width, height = group
    size = f", {width}x{height}" if width else ""
    return (
        f"{method} ({profile}{f', {budget}' if budget and budget != 'profile' else ''}) on "
        f"{sequence or 'all sequences'}{f'@{setting}' if setting else ''}{size}"
    )
