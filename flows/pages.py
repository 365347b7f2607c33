"""The page that compares the sequences of a run."""

from __future__ import annotations

from collections.abc import Sequence

from extrags.store import Ref
from flows.outcome import SequenceOutcome
from flows.runners import Call, Runner
from tasks.report import PAGE, dataset_report

__all__ = ["dataset_page"]


def dataset_page(outcomes: Sequence[SequenceOutcome], name: str, profile: str, runner: Runner) -> str:
    """Make the page.

    Args:
        outcomes: one per sequence, failures among them.
        name: title.
        profile: name of the profile of the settings.
        runner: how artefacts are made.

    Returns:
        Where it stands.

    Raises:
        NotInStoreError: from a runner that only looks.
    """
    metrics = {
        f"{outcome.name} {which}": Ref(
            uri=outcome.artefacts[f"metrics_{which}"], digest=outcome.digests[f"metrics_{which}"]
        )
        for outcome in outcomes
        for which in ("coarse", "final")
        if f"metrics_{which}" in outcome.artefacts
    }
    failures = {
        outcome.name: next(
            (f"{row.stage}: {row.reason}" for row in outcome.stages if row.state == "failed"), "failed"
        )
        for outcome in outcomes
        if outcome.status == "failed"
    }
    inputs = {
        "name": name,
        "profile": profile,
        "sequences": [outcome.name for outcome in outcomes],
        "metrics": metrics,
        "failures": failures,
        "rows": [outcome.to_json() for outcome in outcomes],
    }
    (page,) = runner.run([Call(dataset_report, inputs)], name)
    return f"{page.ref.uri}/{PAGE}"
