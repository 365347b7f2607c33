"""Comparison of runs: statistics over seeds, and paired differences between methods.

A run is a mapping with `method`, `profile`, `sequence`, `setting`, `seed` and `metrics` (the tree of
`EvaluationResult`). Methods are compared in pairs only: two runs that share everything but the method. Over
a dataset, the mean difference of each sequence is one sample: seeds of one sequence are no independent
evidence. `PROTOCOL.md`, section 7, has the rules in words.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from extrags.errors import ConfigError
from extrags.metrics.registry import Figure, figures

__all__ = ["CEILING", "Spread", "compare_runs", "dataset_of", "figure_of", "paired", "spread"]

Run = Mapping[str, Any]

CEILING = "oracle"
"""The method that trains on the held-out frames as well: the ceiling of the representation."""
RESAMPLES = 10_000
"""Bootstrap samples of sequences behind the interval of a share."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Statistics of a sample of metric values, or of their differences.

    Args:
        n: sample size.
        mean: sample mean.
        deviation: sample standard deviation (n - 1 in the denominator); None for a single value.
        low: lower end of the 95 % confidence interval of the mean (Student's t); None for a single value.
        high: upper end of the interval; None for a single value.
        smallest: minimum of the sample.
        largest: maximum of the sample.
    """

    n: int
    mean: float
    deviation: float | None
    low: float | None
    high: float | None
    smallest: float
    largest: float


def spread(values: Sequence[float]) -> Spread:
    """Mean, standard deviation and 95 % confidence interval of a sample.

    Raises:
        ConfigError: for an empty sample.
    """
    if not values:
        raise ConfigError("an empty sample has no spread")
    sample = np.asarray(values, dtype=np.float64)
    mean = float(sample.mean())
    deviation = low = high = None
    if len(sample) > 1:
        from scipy.stats import t

        deviation = float(sample.std(ddof=1))
        reach = float(t.ppf(0.975, len(sample) - 1)) * deviation / math.sqrt(len(sample))
        low, high = mean - reach, mean + reach
    return Spread(len(sample), mean, deviation, low, high, float(sample.min()), float(sample.max()))


def figure_of(metrics: Mapping[str, Any] | None, name: str) -> float | None:
    """Value of a metric by its dotted path, e.g. `observed.psnr`; None when the path does not exist."""
    node: Any = metrics
    for part in name.split("."):
        if not isinstance(node, Mapping):
            return None
        node = node.get(part)
    return None if node is None or isinstance(node, Mapping) else float(node)


def dataset_of(run: Run) -> str:
    """`phantom@sparse` for the runs of `phantom/3` in the setting `sparse`; `files` for those of paths."""
    name, _, rest = str(run["sequence"]).partition("/")
    dataset = "files" if name in ("", ".", "..") or "/" in rest else name
    return f"{dataset}@{run['setting']}" if run["setting"] else dataset


def paired(runs: Sequence[Run], method: str, baseline: str, name: str) -> list[tuple[Run, float]]:
    """Differences method - baseline between runs that are equal in everything but the method.

    Args:
        runs: of both, and of others.
        method: the method in question.
        baseline: the method it is compared with.
        name: of the figure.

    Returns:
        The runs of `method` that have a partner, with the difference; runs without a figure are left out.
    """
    others = {_identity(run): run for run in runs if run["method"] == baseline}
    found = []
    for run in runs:
        partner = others.get(_identity(run)) if run["method"] == method else None
        if partner is None:
            continue
        value, reference = figure_of(run["metrics"], name), figure_of(partner["metrics"], name)
        if value is not None and reference is not None:
            found.append((run, value - reference))
    return found


def compare_runs(runs: Sequence[Run], baseline: str) -> dict[str, Any]:
    """Spread and paired differences of all figures that any run has.

    Args:
        runs: the runs; failed ones (`metrics` None) are left out.
        baseline: method the others are compared with.

    Returns:
        `{baseline, sequences, datasets, paired_sequences, paired_datasets, ceiling_sequences,
        ceiling_datasets}`: lists of rows with what they are about (`sequence` and `setting`, or `dataset`;
        `profile`, `method`, `n_seeds` or `n_sequences`) and `figures`, by name a `Spread`. Paired rows hold
        differences method - baseline and, per figure, in how many of the `n` pairs the method is better.
        Ceiling rows hold the share of the way from the baseline to the method `oracle` (`CEILING`), and are
        there where it was run; a sequence on which the oracle is not better than the baseline is left out.
        `mean` is there the mean gain of the method over that of the oracle, `low` and `high` are its 95 %
        interval by bootstrap over sequences, `deviation` is None, and `smallest` and `largest` are shares of
        single sequences.

    Raises:
        ConfigError: when there is no run of the baseline, or a run occurs twice.
    """
    methods = list(dict.fromkeys(str(run["method"]) for run in runs))
    if runs and baseline not in methods:
        raise ConfigError(f"no run of the baseline {baseline!r}; methods here: {', '.join(methods)}")
    seen: set[tuple[Any, ...]] = set()
    for run in runs:
        key = (run["method"], *_identity(run))
        if key in seen:
            raise ConfigError(f"the run {key} is given twice")
        seen.add(key)
    measured = [run for run in runs if run["metrics"] is not None]
    known = [
        figure
        for figure in figures()
        if any(figure_of(run["metrics"], figure.name) is not None for run in measured)
    ]
    rivals = [method for method in methods if method != baseline]
    return {
        "baseline": baseline,
        "sequences": _grouped(measured, known, _by_sequence),
        "datasets": _grouped(measured, known, _by_dataset),
        "paired_sequences": _paired(measured, known, rivals, baseline, _by_sequence),
        "paired_datasets": _paired(measured, known, rivals, baseline, _by_dataset),
        "ceiling_sequences": _ceiling(measured, known, rivals, baseline, _by_sequence),
        "ceiling_datasets": _ceiling(measured, known, rivals, baseline, _by_dataset),
    }


def _identity(run: Run) -> tuple[Any, ...]:
    return (run["profile"], run["sequence"], run["setting"], run["seed"])


def _by_sequence(run: Run) -> dict[str, Any]:
    return {"sequence": run["sequence"], "setting": run["setting"], "profile": run["profile"]}


def _by_dataset(run: Run) -> dict[str, Any]:
    return {"dataset": dataset_of(run), "profile": run["profile"]}


def _grouped(
    runs: Sequence[Run],
    known: Sequence[Figure],
    about: Callable[[Run], dict[str, Any]],
) -> list[dict[str, Any]]:
    rows = []
    for group, members in _groups(runs, lambda run: {**about(run), "method": run["method"]}):
        found = {}
        for figure in known:
            values = [
                (run, value)
                for run in members
                if (value := figure_of(run["metrics"], figure.name)) is not None
            ]
            sample = _sample(values, about)
            if sample:
                found[figure.name] = asdict(spread(sample))
        rows.append({**group, **_sizes(members), "figures": found})
    return rows


def _paired(
    runs: Sequence[Run],
    known: Sequence[Figure],
    methods: Sequence[str],
    baseline: str,
    about: Callable[[Run], dict[str, Any]],
) -> list[dict[str, Any]]:
    rows = []
    for method in methods:
        for group, members in _groups(runs, about):
            found: dict[str, Any] = {}
            partners: dict[int, Run] = {}
            for figure in known:
                differences = paired(members, method, baseline, figure.name)
                partners |= {id(run): run for run, _ in differences}
                sample = _sample(differences, about)
                if sample:
                    sign = 1 if figure.higher_is_better else -1
                    better = sum(sign * value > 0 for value in sample)
                    found[figure.name] = {**asdict(spread(sample)), "better": better}
            if found:
                sizes = _sizes(list(partners.values()))
                rows.append({**group, "method": method, "baseline": baseline, **sizes, "figures": found})
    return rows


def _ceiling(
    runs: Sequence[Run],
    known: Sequence[Figure],
    methods: Sequence[str],
    baseline: str,
    about: Callable[[Run], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Share of the way from the baseline to the oracle: a ratio of means over seeds and sequences.

    Seeds count that baseline, method and oracle all have.
    """

    def gains(
        members: Sequence[Run], method: str, figure: Figure
    ) -> dict[tuple[Any, ...], tuple[Run, float]]:
        sign = 1 if figure.higher_is_better else -1
        pairs = paired(members, method, baseline, figure.name)
        return {_identity(run): (run, sign * value) for run, value in pairs}

    rows = []
    for method in methods:
        if method == CEILING:
            continue
        for group, members in _groups(runs, about):
            found = {}
            counted: dict[int, Run] = {}
            for figure in known:
                whole, part = (gains(members, name, figure) for name in (CEILING, method))
                by_sequence: dict[Any, list[tuple[float, float]]] = {}
                partners: dict[Any, list[Run]] = {}
                # In the order of the runs: that of a set differs from process to process, and so do sums.
                for key, (run, gain) in part.items():
                    if key not in whole:
                        continue
                    sequence = (run["sequence"], run["setting"])
                    by_sequence.setdefault(sequence, []).append((gain, whole[key][1]))
                    partners.setdefault(sequence, []).append(run)
                means = {name: np.mean(values, axis=0).tolist() for name, values in by_sequence.items()}
                # An oracle that is not above the baseline is no ceiling.
                below = sorted(name for name, (_, way) in means.items() if way > 0)
                counted |= {id(run): run for name in below for run in partners[name]}
                if below:
                    share = _share([means[name][0] for name in below], [means[name][1] for name in below])
                    found[figure.name] = asdict(share)
            if found:
                sizes = _sizes(list(counted.values()))
                rows.append({**group, "method": method, "baseline": baseline, **sizes, "figures": found})
    return rows


def _share(gains: Sequence[float], ways: Sequence[float]) -> Spread:
    """Mean gain as a share of the mean way, all ways positive, and its interval by bootstrap over sequences.

    A mean of the single shares would be that of the sequence whose way is next to nothing.
    """
    gain, way = np.asarray(gains, dtype=np.float64), np.asarray(ways, dtype=np.float64)
    shares = gain / way
    mean = float(gain.mean() / way.mean())
    low = high = None
    if len(gain) > 1:
        chosen = np.random.default_rng(0).integers(len(gain), size=(RESAMPLES, len(gain)))
        drawn = gain[chosen].mean(axis=1) / way[chosen].mean(axis=1)
        low, high = (float(end) for end in np.quantile(drawn, [0.025, 0.975]))
    return Spread(len(gain), mean, None, low, high, float(shares.min()), float(shares.max()))


def _sample(values: Sequence[tuple[Run, float]], about: Callable[[Run], dict[str, Any]]) -> list[float]:
    """The sample of a group: for a sequence the values of its seeds, for a dataset its sequences' means."""
    if about is _by_sequence:
        return [value for _, value in values]
    by_sequence: dict[Any, list[float]] = {}
    for run, value in values:
        by_sequence.setdefault((run["sequence"], run["setting"]), []).append(value)
    return [float(np.mean(found)) for found in by_sequence.values()]


def _groups(
    runs: Sequence[Run], about: Callable[[Run], dict[str, Any]]
) -> list[tuple[dict[str, Any], list[Run]]]:
    groups: dict[tuple[Any, ...], tuple[dict[str, Any], list[Run]]] = {}
    for run in runs:
        row = about(run)
        groups.setdefault(tuple(row.values()), (row, []))[1].append(run)
    return list(groups.values())


def _sizes(runs: Sequence[Run]) -> dict[str, int]:
    return {
        "n_sequences": len({(run["sequence"], run["setting"]) for run in runs}),
        "n_seeds": len({run["seed"] for run in runs}),
    }
