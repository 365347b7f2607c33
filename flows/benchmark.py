"""`benchmark`: run time against error over methods, profiles and seeds (JSON of design section 7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from pydantic import Field

from extrags.errors import ConfigError
from flows.outcome import SequenceFailedError, SequenceOutcome
from flows.runners import PrefectRunner, Runner
from flows.sequence import artifact_key, open_store
from flows.settings import DEFAULT_STORE, ProfileName, pipeline_config
from flows.tables import METRICS, figure, markdown_table
from flows.wiring import run_sequence

__all__ = ["METHODS", "MethodName", "benchmark", "case_of", "run_method"]

MethodName = Literal["coarse", "extrags", "classical", "real-only"]

METHODS: dict[str, str] = {
    "coarse": "the coarse scene alone",
    "extrags": "explored, restored by the diffusion, fine-tuned",
    "classical": "the same with the classical fill instead of the diffusion",
    "real-only": "fine-tuned on the real views alone: the control",
}

_EXPLORING = ("surface", "freespace", "explore", "enhance")
_LEFT_OUT = {
    "coarse": dict.fromkeys([*_EXPLORING, "finetune"], "the run measures the coarse scene"),
    "real-only": dict.fromkeys(_EXPLORING, "the run is a control on real views alone"),
}

NOT_COUNTED = frozenset({"evaluate", "report"})
"""Stages that measure a method are no part of its run time."""


@flow(name="benchmark", flow_run_name="{name}", log_prints=False, persist_result=False)
def benchmark(
    sequences: Annotated[list[str], Field(min_length=1, description="names or paths")],
    profiles: Annotated[list[ProfileName], Field(min_length=1, description="named settings")] = ["quick"],  # noqa: B006
    methods: Annotated[list[MethodName], Field(min_length=1, description="what to compare")] = [  # noqa: B006
        "coarse",
        "extrags",
    ],
    seeds: Annotated[list[int], Field(min_length=1, description="one run per seed")] = [0],  # noqa: B006
    settings: Annotated[dict[str, Any] | None, Field(description="overrides for all runs")] = None,
    store: Annotated[str, Field(description="directory or URL of the artefact store")] = DEFAULT_STORE,
    name: Annotated[str, Field(description="name of this run, for its table")] = "benchmark",
) -> dict[str, Any]:
    """Measure every combination.

    What is in the store already is not run again: its time is what it took when it was made. Delete it
    (`extrags cache rm`) to measure anew.

    Returns:
        `{machine, cases: [{method, profile, sequence, setting, seed, seconds, peak_mib, metrics}]}`.

    Raises:
        SequenceFailedError: when a run fails.
    """
    open_store(store)
    runner = PrefectRunner(store)
    cases = [
        run_method(method, sequence, profile, seed, settings, store, runner)
        for sequence in sequences
        for profile in profiles
        for seed in seeds
        for method in methods
    ]
    create_markdown_artifact(
        benchmark_markdown(cases), key=artifact_key("benchmark", name), description=f"{len(cases)} cases"
    )
    # Here, because it loads torch and the kernels, which looking up a deployment must not.
    from extrags.raster.bench import machine

    return {"machine": machine(), "cases": cases}


def run_method(
    method: str,
    sequence: str,
    profile: str,
    seed: int,
    settings: dict[str, Any] | None,
    store: str,
    runner: Runner,
) -> dict[str, Any]:
    """One case: run it, or take it from the store.

    Raises:
        ConfigError: for an unknown method.
        SequenceFailedError: when a stage fails.
    """
    if method not in METHODS:
        raise ConfigError(f"no method {method!r}; known: {', '.join(METHODS)}")
    overrides = dict(settings or {})
    if method == "classical":
        overrides["enhance.backend"] = "classical"
    config = pipeline_config(profile, overrides, seed)
    outcome = run_sequence(
        sequence,
        config,
        store,
        runner,
        profile=profile,
        until="evaluate",
        leave_out=_LEFT_OUT.get(method),
    )
    if outcome.status == "failed":
        raise SequenceFailedError(outcome) from outcome.error
    return case_of(outcome, method, profile, seed)


def case_of(outcome: SequenceOutcome, method: str, profile: str, seed: int) -> dict[str, Any]:
    """A finished run as a benchmark case.

    `seconds` is what its stages took when they were made, without evaluation and report; `peak_mib` the
    largest resident memory of the process meanwhile.
    """
    rows = [row for row in outcome.stages if row.stage not in NOT_COUNTED]
    peaks = [row.peak_mib for row in rows if row.peak_mib is not None]
    name, _, setting = outcome.name.partition("@")
    return {
        "method": method,
        "profile": profile,
        "sequence": name,
        "setting": setting or None,
        "seed": seed,
        "seconds": round(sum(row.made_seconds for row in rows), 3),
        "peak_mib": max(peaks) if peaks else None,
        "metrics": outcome.metrics["final"],
    }


def benchmark_markdown(cases: Sequence[dict[str, Any]]) -> str:
    """One row per case."""
    return markdown_table(
        ["sequence", "setting", "profile", "method", "seed", "seconds", "MiB", *METRICS],
        [
            [
                case["sequence"],
                case["setting"] or "",
                case["profile"],
                case["method"],
                case["seed"],
                f"{case['seconds']:.1f}",
                "" if case["peak_mib"] is None else f"{case['peak_mib']:.0f}",
                *(figure(name, (case["metrics"] or {}).get(name)) for name in METRICS),
            ]
            for case in cases
        ],
    )
