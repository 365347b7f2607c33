"""The pages that compare the sequences of a run, and the methods of a benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from extrags.stages import Part
from extrags.store import Store
from flows.outcome import NOT_COUNTED, SequenceOutcome
from flows.runners import Call, Runner
from tasks.benchmark import benchmark_report
from tasks.report import PAGE, dataset_report

__all__ = ["benchmark_page", "dataset_page", "image_size"]

COMPARED_VIEWS = 4
"""Held-out views of each sequence that are shown side by side."""


def dataset_page(
    outcomes: Sequence[SequenceOutcome],
    settings: Sequence[Mapping[str, Any]],
    name: str,
    profile: str,
    store: Store,
    runner: Runner,
) -> str:
    """Make the page.

    Args:
        outcomes: one per sequence, failures among them.
        settings: that were given for each beside the profile, by dotted name.
        name: title.
        profile: name of the profile of the settings.
        store: with the artefacts of the runs.
        runner: how artefacts are made.

    Returns:
        Where it stands.

    Raises:
        NotInStoreError: from a runner that only looks.
    """
    parts: dict[str, Part] = {"coarse": "metrics_coarse", "final": "metrics_final"}
    metrics = {
        f"{outcome.title} {which}": outcome.refs[part]
        for outcome in outcomes
        for which, part in parts.items()
        if part in outcome.refs
    }
    failures = {
        outcome.title: next(
            (f"{row.stage}: {row.reason}" for row in outcome.stages if row.state == "failed"), "failed"
        )
        for outcome in outcomes
        if outcome.status == "failed"
    }
    inputs = {
        "name": name,
        "profile": profile,
        "sequences": [outcome.title for outcome in outcomes],
        "metrics": metrics,
        "reports": {
            outcome.title: outcome.refs["report"] for outcome in outcomes if "report" in outcome.refs
        },
        "failures": failures,
        "settings": [dict(given) for given in settings],
        "sizes": [image_size(outcome, store) for outcome in outcomes],
        "rows": [outcome.to_json() for outcome in outcomes],
    }
    (page,) = runner.run([Call(dataset_report, inputs)], name)
    return f"{page.ref.uri}/{PAGE}"


def image_size(outcome: SequenceOutcome, store: Store) -> tuple[int, int] | None:
    """Width and height of the images of a run in px; None where nothing was read.

    Raises:
        StoreError: when the store cannot be read.
    """
    if "ingest" not in outcome.refs:
        return None
    counts = store.manifest(outcome.refs["ingest"]).counts
    return int(counts["width"] or 0), int(counts["height"] or 0)


def benchmark_page(
    outcomes: Sequence[SequenceOutcome],
    cases: Sequence[Mapping[str, Any]],
    methods: Mapping[str, str],
    baseline: str,
    name: str,
    runner: Runner,
    history: Mapping[str, Any] | None = None,
) -> str:
    """Make the page of a benchmark.

    Of each sequence and setting, the first seed and profile in which both came to figures is shown in
    pictures: the baseline beside the last of the other methods that is not the ceiling.

    Args:
        outcomes: of the runs.
        cases: the same as JSON, in the same order.
        methods: what each method is, in words.
        baseline: method the others are compared with.
        name: title.
        runner: how artefacts are made.
        history: `{trend, regressions, not_judged}` (`flows.history`).

    Returns:
        Where it stands.
    """
    # Here, because it loads torch, which looking up a deployment must not.
    from extrags.metrics.comparison import CEILING

    rivals = [method for method in methods if method != baseline]
    contender = ([method for method in rivals if method != CEILING] or rivals)[-1:]
    pictures = [pair for method in contender for pair in _pairs(cases, baseline, method)]
    shown = sorted({pair[side] for pair in pictures for side in ("baseline", "contender")}, key=int)
    keys = ("method", "profile", "sequence", "setting", "seed", "settings", "image_size")
    inputs = {
        "name": name,
        "baseline": baseline,
        "methods": dict(methods),
        "runs": [{key: case[key] for key in keys} for case in cases],
        "metrics": {
            str(index): outcome.final_metrics
            for index, (outcome, case) in enumerate(zip(outcomes, cases, strict=True))
            if case["metrics"] is not None
        },
        "failures": {str(index): case["error"] for index, case in enumerate(cases) if case["error"]},
        "pictures": pictures,
        "sequences": {index: outcomes[int(index)].refs["sequence"] for index in shown},
        "renders": {index: outcomes[int(index)].final_renders for index in shown},
        "views": COMPARED_VIEWS,
        "rows": [
            {"seconds": case["seconds"], "peak_mib": case["peak_mib"], "stages": _made(outcome)}
            for outcome, case in zip(outcomes, cases, strict=True)
        ],
        "history": dict(history or {}),
    }
    (page,) = runner.run([Call(benchmark_report, inputs)], name)
    return f"{page.ref.uri}/{PAGE}"


def _made(outcome: SequenceOutcome) -> list[dict[str, Any]]:
    """What the stages that count in a run's time consist of, and how long they took when they were made."""
    return [
        {key: row.to_json()[key] for key in ("artefacts", "made_seconds")}
        for row in outcome.stages
        if row.stage not in NOT_COUNTED
    ]


def _pairs(cases: Sequence[Mapping[str, Any]], baseline: str, contender: str) -> list[dict[str, str]]:
    """Runs by index that share all but the method, one pair for each sequence and setting."""
    measured = {
        (case["sequence"], case["setting"], case["profile"], case["seed"], case["method"]): str(index)
        for index, case in enumerate(cases)
        if case["metrics"] is not None
    }
    pairs: dict[tuple[Any, ...], dict[str, str]] = {}
    for key, index in measured.items():
        *shared, method = key
        other = measured.get((*shared, contender))
        if method == baseline and other is not None:
            label = f"profile {key[2]}, seed {key[3]}"
            pairs.setdefault(key[:2], {"baseline": index, "contender": other, "label": label})
    return list(pairs.values())
