"""`benchmark`: methods compared over sequences, profiles and seeds (its JSON: docs/json.md)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from typing import Annotated, Any

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from pydantic import Field

from extrags.config import PipelineConfig, ProfileName, Seed
from extrags.errors import ConfigError
from extrags.pipeline import HELD_OUT_TRAINED_ON
from extrags.redaction import without_credentials_in
from extrags.store import Store, digest_of
from flows.damage import again_after_damage
from flows.history import (
    BenchmarkRegressedError,
    Judgement,
    Tolerance,
    append_history,
    history_entry,
    history_of,
    judge,
    trend,
)
from flows.leases import run_lease
from flows.limits import DEFAULT_LIMITS, StageLimits
from flows.methods import METHODS, MethodName, method_config, pinned_settings
from flows.outcome import MAX_FAILED_SHARE, NOT_COUNTED, BenchmarkFailedError, SequenceOutcome
from flows.pages import benchmark_page, image_size
from flows.parameters import DIFFERENT, Sequences, Settings, StoreRoot, Variants
from flows.preflight import preflight
from flows.run_page import run_page
from flows.runners import PrefectRunner, Runner
from flows.selection import Chosen, chosen_sequences
from flows.sequence import open_store
from flows.settings import run_store
from flows.tables import benchmark_markdown, judgement_markdown
from flows.wiring import run_sequence
from tasks.evaluate import METRICS_FILE
from tasks.run_page import artifact_key, attempt

__all__ = ["Case", "benchmark", "case_of", "check_methods", "check_repetitions", "run_method"]

log = logging.getLogger(__name__)

PREFERRED_BASELINE = "3dgs"


@dataclass(frozen=True)
class Case:
    """One run of a benchmark."""

    method: str
    profile: str
    seed: int
    outcome: SequenceOutcome
    asked: str = ""
    """Digest of the method and settings that were asked for, without profile, seed and defaults."""
    settings: str = ""
    """Digest of all settings but the seed."""
    given: dict[str, Any] = field(default_factory=dict)
    """Settings that were given for its sequence beside the profile; not what a variant changes."""
    image_size: tuple[int, int] | None = None
    """Width and height in px; None where nothing was read."""


@flow(name="benchmark", flow_run_name="{name}", log_prints=False, persist_result=False)
def benchmark(
    sequences: Annotated[
        Sequences, Field(min_length=1, description="names, paths, patterns, or @FILE for a manifest")
    ],
    profiles: Annotated[
        list[ProfileName], Field(min_length=1, description="named settings", json_schema_extra=DIFFERENT)
    ] = ["quick"],  # noqa: B006
    methods: Annotated[
        list[MethodName], Field(min_length=1, description="what to compare", json_schema_extra=DIFFERENT)
    ] = ["coarse", "extrags"],  # noqa: B006
    seeds: Annotated[
        list[Seed], Field(min_length=1, description="one run per seed", json_schema_extra=DIFFERENT)
    ] = [0],  # noqa: B006
    settings: Annotated[
        Settings, Field(description="overrides for all runs; they do not reach what a method pins")
    ] = None,
    variants: Annotated[
        Variants,
        Field(
            description='further methods by name, e.g. {"no-light": {"coarse.light.enabled": false}}: '
            "`coarse`, or the method under the key `method`, with other settings"
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        Field(description="method the others are compared with; 3dgs if it is there, else the first"),
    ] = None,
    store: Annotated[
        StoreRoot, Field(description="directory or URL of the artefact store; EXTRAGS_STORE by default")
    ] = None,
    name: Annotated[str, Field(description="name of this run, for its table and page")] = "benchmark",
    limits: Annotated[StageLimits, Field(description="retries and time limits of stages")] = DEFAULT_LIMITS,
    refresh: Annotated[
        bool, Field(description="recompute everything, so that times are those of now; adds to the history")
    ] = False,
    tolerance: Annotated[
        Tolerance | None,
        Field(
            description="how much worse than the runs before it may be; without, it is not compared with them"
        ),
    ] = None,
    max_failed_share: Annotated[
        float, Field(ge=0, le=1, description="the benchmark counts as failed when more of its runs failed")
    ] = MAX_FAILED_SHARE,
) -> dict[str, Any]:
    """Measure every combination, and compare the methods pair by pair.

    Artefacts in the store are reused, with the time that was measured when they were computed. With `refresh`
    everything is made anew, once; figures and times are added to the history in the store, which the page
    shows as a trend. A run that fails does not stop the others.

    Returns:
        `{machine, protocol, methods: {NAME: WORDS}, cases: [{method, profile, sequence, setting, seed,
        asked, settings, image_size, seconds, spent_seconds, processor_seconds, peak_mib, metrics, ...}],
        comparison, regressions, not_judged, report}`; `metrics` is None for a failed run, whose `error`
        says why. `regressions` and `not_judged` are those of `flows.history.Judgement`, in words.
        `comparison` is
        `extrags.metrics.comparison.compare_runs`; beside `report` stand `per_view.json` and
        `comparison.json`.

    Raises:
        ConfigError: for an unknown method or baseline, a profile or seed that is given twice, a setting that
            is wrong, or a tolerance for what is not measured anew.
        BenchmarkRegressedError: when it is worse than the runs before by more than `tolerance`; page, tables
            and history have been written by then.
        BenchmarkFailedError: when more than `max_failed_share` of the runs failed; likewise.
        ExtragsError: when a model, weights or a package that the settings name is not there.
    """
    if tolerance is not None and not refresh:
        raise ConfigError("a tolerance needs refresh: what is taken from the store is as good as it was")
    baseline = check_methods(methods, variants or {}, baseline)
    check_repetitions(profiles, seeds)
    store = run_store(store)
    chosen = [
        replace(item, settings={**(settings or {}), **item.settings}) for item in chosen_sequences(sequences)
    ]
    open_store(store)
    runner = PrefectRunner(store, refresh, limits)
    wanted = [*methods, *(variants or {})]
    config = _checked_config(chosen, profiles, wanted, seeds, settings or {}, variants or {})
    words = {method: summary_of(method, variants or {}) for method in wanted}
    # Here and below, because they load torch and the kernels, which looking up a deployment must not.
    from extrags.raster.bench import machine

    about = machine()
    earlier = history_of(Store(store), name) if refresh else []

    passed: dict[tuple[int, str, int, str], SequenceOutcome] = {}

    def run_all() -> tuple[_Accounts, str]:
        page.restart()
        found = []
        for (number, item), profile, seed, method in product(enumerate(chosen), profiles, seeds, wanted):
            case = run_method(
                method,
                item.name,
                profile,
                seed,
                item.settings,
                store,
                runner,
                variants=variants,
                memory_limit_gb=limits.memory_gb,
            )
            page.sequence_ended(case.outcome, store)
            # Where the page met damage, all but that is found in the store now.
            place = (number, profile, seed, method)
            if place in passed:
                case.outcome.add_time_of(passed[place])
            passed[place] = case.outcome
            found.append(case)
        accounts = _accounts(name, found, about, earlier, tolerance)
        history: dict[str, Any] = {}
        if refresh:
            history = {"trend": trend([*earlier, accounts.entry]), **asdict(accounts.judgement)}
        outcomes = [case.outcome for case in found]
        return accounts, benchmark_page(outcomes, accounts.cases, words, baseline, name, runner, history)

    runs = len(chosen) * len(profiles) * len(seeds) * len(wanted)
    with run_lease(store), run_page(name, config, "evaluate", sequences=runs) as page:
        accounts, report = again_after_damage(Store(store), run_all)
        page.link(report, artifact_key("report", name), f"Report of {name}")
    if refresh:
        append_history(Store(store), accounts.entry)
    _tell(name, accounts, baseline)
    from extrags.metrics.comparison import compare_runs
    from extrags.metrics.registry import PROTOCOL_VERSION

    result = {
        "machine": about,
        "protocol": PROTOCOL_VERSION,
        "methods": words,
        "cases": accounts.cases,
        "comparison": compare_runs(accounts.cases, baseline),
        **asdict(accounts.judgement),
        "report": report,
    }
    if accounts.judgement.regressions:
        raise BenchmarkRegressedError(name, result)
    failed = sum(bool(case["error"]) for case in accounts.cases)
    if failed / len(accounts.cases) > max_failed_share:
        raise BenchmarkFailedError(name, result, max_failed_share)
    return result


def _checked_config(
    chosen: Sequence[Chosen],
    profiles: Sequence[str],
    wanted: Sequence[str],
    seeds: Sequence[int],
    settings: dict[str, Any],
    variants: dict[str, dict[str, Any]],
) -> PipelineConfig:
    """Report invalid settings and missing models before the first run, once for all sequences alike.

    Args:
        chosen: the sequences, each with all settings that are given for it.
        profiles: named settings.
        wanted: methods and variants, by name.
        seeds: of all stages.
        settings: those that are given for all sequences.
        variants: by name, what they change.

    Returns:
        Settings of the last run.

    Raises:
        ConfigError: for a setting that is wrong; names the sequence where it is given for that one alone.
        ExtragsError: see `flows.preflight.preflight`.
    """
    unlike = {digest_of(item.settings): item for item in chosen}.values()
    for item, profile, method in product(unlike, profiles, wanted):
        try:
            for seed in seeds:
                config = _config_of(method, profile, item.settings, variants, seed)
        except ConfigError as error:
            shared = item.settings == settings
            raise ConfigError(str(error) if shared else f"{item.name}: {error}") from error
        preflight(config, "evaluate", METHODS[_variant(method, variants)[0]].leave_out)
    return config


@dataclass(frozen=True)
class _Accounts:
    """What the runs of a benchmark came to.

    Args:
        cases: `case_of` of each.
        entry: of the history.
        judgement: against the runs before.
    """

    cases: list[dict[str, Any]]
    entry: dict[str, Any]
    judgement: Judgement


def _accounts(
    name: str,
    found: Sequence[Case],
    about: dict[str, Any],
    earlier: list[dict[str, Any]],
    tolerance: Tolerance | None,
) -> _Accounts:
    """Account for the runs of a benchmark.

    Args:
        name: of the benchmark.
        found: its runs.
        about: the machine.
        earlier: entries of the history.
        tolerance: how much worse than these it may be; None: not held against them.
    """
    cases = [case_of(case) for case in found]
    digests = [{"asked": case.asked, "settings": case.settings} for case in found]
    entry = history_entry(name, cases, digests, about)
    judgement = Judgement() if tolerance is None else judge(entry, earlier, tolerance)
    return _Accounts(cases, entry, judgement)


def _tell(name: str, accounts: _Accounts, baseline: str) -> None:
    """Log what could not be judged, and leave the tables as an artifact."""
    for line in accounts.judgement.not_judged:
        log.warning("not judged: %s", line)
    attempt(
        lambda: create_markdown_artifact(
            benchmark_markdown(accounts.cases, baseline) + judgement_markdown(accounts.judgement),
            key=artifact_key("benchmark", name),
            description=f"{len(accounts.cases)} runs",
        )
    )


def check_methods(
    methods: Sequence[str], variants: dict[str, dict[str, Any]], baseline: str | None = None
) -> str:
    """Check the names of methods, variants and baseline; returns the baseline.

    Raises:
        ConfigError: for unknown methods, duplicate names, a variant that would train on held-out frames or
            changes a stage that its method leaves out, or a baseline that is not among the methods.
    """
    for method in methods:
        if method not in METHODS:
            raise ConfigError(f"no method {method!r}; known: {', '.join(METHODS)}")
    wanted = [*methods, *variants]
    taken = [name for name in variants if name in METHODS]
    if taken:
        raise ConfigError(f"a variant cannot have a method's name: {', '.join(taken)}")
    if len(set(wanted)) != len(wanted):
        raise ConfigError(f"a method is named twice: {', '.join(wanted)}")
    for name, changed in variants.items():
        base = changed.get("method", "coarse")
        if base not in METHODS:
            raise ConfigError(f"variant {name}: no method {base!r}; known: {', '.join(METHODS)}")
        if "coarse.train_on" in changed:
            raise ConfigError(f"variant {name}: coarse.train_on cannot be changed; see the method oracle")
        for setting in changed:
            stage = setting.partition(".")[0]
            if stage in METHODS[base].leave_out:
                raise ConfigError(
                    f"variant {name}: {setting} has no effect on the method {base}, which leaves out the "
                    f"stage {stage}; name another method, as in --variant {name} extrags {setting}=VALUE"
                )
    if baseline is None:
        return PREFERRED_BASELINE if PREFERRED_BASELINE in wanted else wanted[0]
    if baseline not in wanted:
        raise ConfigError(f"the baseline {baseline!r} is not among the methods: {', '.join(wanted)}")
    return baseline


def check_repetitions(profiles: Sequence[str], seeds: Sequence[int]) -> None:
    """Check that no run would be there twice, which the comparison at the end refuses.

    Raises:
        ConfigError: for a profile or seed that is given twice.
    """
    for what, values in (("profile", profiles), ("seed", seeds)):
        if len(set(values)) < len(values):
            raise ConfigError(f"a {what} is given twice: {', '.join(map(str, values))}")


def summary_of(method: str, variants: dict[str, dict[str, Any]]) -> str:
    """A description of a method or variant."""
    if method not in variants:
        return METHODS[method].summary
    base, settings = _variant(method, variants)
    changed = ", ".join(f"{name} = {value}" for name, value in settings.items())
    return f"{base} with {changed or 'nothing changed'}"


def run_method(
    method: str,
    sequence: str,
    profile: str,
    seed: int,
    settings: dict[str, Any] | None,
    store: str,
    runner: Runner,
    *,
    variants: dict[str, dict[str, Any]] | None = None,
    memory_limit_gb: float | None = None,
) -> Case:
    """Run one case, or take it from the store. The error of a failed stage is in the outcome, not raised.

    Raises:
        ConfigError: for an unknown method or setting.
    """
    base, changed = _variant(method, variants or {})
    config = _config_of(method, profile, settings, variants or {}, seed)
    asked = digest_of([base, settings or {}, changed])
    outcome = run_sequence(
        sequence,
        config,
        store,
        runner,
        profile=profile,
        until="evaluate",
        leave_out=METHODS[base].leave_out or None,
        memory_limit_gb=memory_limit_gb,
        pinned=pinned_settings(base),
    )
    # Seeds are repetitions of the same: their means are compared over time.
    size = image_size(outcome, Store(store)) if outcome.refs else None
    return Case(
        method, profile, seed, outcome, asked, digest_of(config.with_seed(0)), dict(settings or {}), size
    )


def case_of(case: Case) -> dict[str, Any]:
    """A run as JSON.

    `seconds` is what its stages took when they were made, without evaluation and report,
    `processor_seconds` the processor time of all threads meanwhile (None where an earlier version made one
    of them), `spent_seconds` the part of `seconds` that was spent in this run, more where something was
    damaged and made again; `asked` is the digest of the method and the settings that were asked for;
    `peak_mib` is the largest resident memory of the process; `evaluation` where the figures of each view
    are; `settings` those that were given for its sequence beside the profile, and `image_size` width and
    height in px; `held_out_trained_on` is true of the oracle alone.
    """
    outcome = case.outcome
    rows = [row for row in outcome.stages if row.stage not in NOT_COUNTED]
    peaks = [row.peak_mib for row in rows if row.peak_mib is not None]
    processor = [row.processor_seconds for row in rows if row.tasks]
    name, _, setting = outcome.name.partition("@")
    failed = next((row for row in outcome.stages if row.state == "failed"), None)
    measured = outcome.final_metrics
    return {
        "method": case.method,
        "profile": case.profile,
        "sequence": name,
        "setting": setting or None,
        "seed": case.seed,
        "asked": case.asked,
        "settings": without_credentials_in(case.given),
        "image_size": case.image_size,
        "seconds": round(sum(row.made_seconds for row in rows), 3),
        "spent_seconds": round(sum(row.spent_seconds for row in rows), 3),
        "processor_seconds": None
        if None in processor
        else round(sum(value for value in processor if value is not None), 3),
        "peak_mib": max(peaks) if peaks else None,
        "metrics": outcome.metrics["final"] if failed is None else None,
        "evaluation": None if measured is None else f"{measured.uri}/{METRICS_FILE}",
        "held_out_trained_on": any(row.reason.startswith(HELD_OUT_TRAINED_ON) for row in rows),
        "error": "" if failed is None else f"{failed.stage}: {failed.reason}",
    }


def _variant(method: str, variants: dict[str, dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    """The method behind a name, and the settings a variant changes."""
    if method not in variants:
        return method, {}
    changed = dict(variants[method])
    return str(changed.pop("method", "coarse")), changed


def _config_of(
    method: str,
    profile: str,
    settings: dict[str, Any] | None,
    variants: dict[str, dict[str, Any]],
    seed: int,
) -> PipelineConfig:
    base, changed = _variant(method, variants)
    # A variant is a method with something changed: its settings come last.
    return method_config(base, profile, settings, seed).with_overrides(changed)
