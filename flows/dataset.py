"""`reconstruct-dataset`: many sequences; a failure of one never stops the others."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Annotated, Any

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from prefect.client.schemas.objects import State
from prefect.states import Failed
from pydantic import Field

from extrags.config import DEFAULT_PROFILE, ProfileName, Seed
from extrags.stages import StageName
from extrags.store import Store
from flows.cases import Only, SequenceCase, cases_of, record_outcome_quietly, selected
from flows.damage import again_after_damage
from flows.expectation import Expectation, expectations, expected_words, longest_first
from flows.failures import release_locals
from flows.leases import run_lease
from flows.limits import DEFAULT_LIMITS, StageLimits
from flows.methods import MethodName, profile_label
from flows.outcome import (
    MAX_FAILED_SHARE,
    DatasetFailedError,
    DatasetOutcome,
    SequenceFailedError,
    SequenceOutcome,
    failed_outcome,
)
from flows.pages import dataset_page
from flows.parameters import DIFFERENT, Matrix, RunnerName, Sequences, Settings, StoreRoot
from flows.preflight import preflight_cases
from flows.run_page import run_page
from flows.runners import PrefectRunner, refreshed_once
from flows.selection import chosen_sequences
from flows.sequence import open_store, reconstruct_sequence
from flows.server_contact import check_server
from flows.settings import run_store, task_runner
from flows.tables import dataset_markdown
from flows.workloads import expected_work
from tasks.progress import stages_interrupted
from tasks.run_page import artifact_key, attempt

__all__ = ["reconstruct_dataset"]

log = logging.getLogger(__name__)


@flow(name="reconstruct-dataset", flow_run_name="{name}", log_prints=False, persist_result=False)
def reconstruct_dataset(
    sequences: Annotated[
        Sequences, Field(min_length=1, description="names, paths, patterns, or @FILE for a manifest")
    ],
    profile: Annotated[ProfileName, Field(description="named settings")] = DEFAULT_PROFILE,
    settings: Annotated[Settings, Field(description="overrides by dotted name")] = None,
    seed: Annotated[Seed | None, Field(description="seed of all stages")] = None,
    store: Annotated[
        StoreRoot, Field(description="directory or URL of the artefact store; EXTRAGS_STORE by default")
    ] = None,
    refresh: Annotated[bool, Field(description="run every stage although its artefact is there")] = False,
    until: Annotated[StageName, Field(description="last stage to run")] = "report",
    runner: Annotated[RunnerName, Field(description="threads, dask or dask:ADDRESS")] = "threads",
    at_once: Annotated[int, Field(ge=1, description="sequences in work at the same time")] = 1,
    name: Annotated[str, Field(description="name of this run, for its table")] = "dataset",
    method: Annotated[
        MethodName, Field(description="the whole pipeline, or one it is compared with")
    ] = "extrags",
    limits: Annotated[StageLimits, Field(description="retries and time limits of stages")] = DEFAULT_LIMITS,
    max_failed_share: Annotated[
        float, Field(ge=0, le=1, description="the run counts as failed when more of its sequences failed")
    ] = MAX_FAILED_SHARE,
    only: Annotated[
        Only | None, Field(description="only those whose last run failed, that have changed, or never ended")
    ] = None,
    methods: Annotated[
        list[MethodName] | None,
        Field(min_length=1, description="several methods instead of one", json_schema_extra=DIFFERENT),
    ] = None,
    seeds: Annotated[
        list[Seed] | None,
        Field(min_length=1, description="several seeds instead of one", json_schema_extra=DIFFERENT),
    ] = None,
    matrix: Annotated[
        Matrix, Field(description='several values of settings, e.g. {"coarse.iterations": [500, 1000]}')
    ] = None,
) -> DatasetOutcome:
    """Take every sequence through all stages, each as a flow run of its own.

    With several methods, seeds or values of settings every sequence is run with every combination. Where
    several are in work at the same time, those that are expected to take longest come first.

    Returns:
        One outcome per run, in the order given; failures among them. The summary is an artifact.

    Raises:
        ConfigError: for wrong settings or manifests.
        UnknownSequenceError: for a pattern that matches nothing.
        ServerLostError: when Prefect's server does not answer any more; a sequence whose run it missed for a
            moment has failed, and the others go on.
        DatasetFailedError: when more than `max_failed_share` of the sequences failed; table and page have
            been written by then.
    """
    store = run_store(store)
    every = cases_of(
        chosen_sequences(sequences),
        methods=methods or [method],
        profile=profile,
        seeds=seeds or [seed],
        settings=settings or {},
        matrix=matrix,
    )
    _check(every, store, until)
    cases = selected(every, only, store, until)
    expected = expectations(cases, store, until, refresh=refresh)
    if cases:
        log.info("%s: %s", name, expected_words(expected, at_once, processes=runner != "threads"))
    else:
        log.info("%s: none of %d runs is %s; nothing to do", name, len(every), only)
        return DatasetOutcome([])
    one = reconstruct_sequence.with_options(task_runner=task_runner(runner, at_once))

    def reconstruct(case: SequenceCase) -> SequenceOutcome:
        state: State[Any]
        lost: Exception | None = None
        try:
            state = one(
                sequence=case.sequence,
                profile=profile,
                settings=dict(case.settings) or None,
                seed=case.seed,
                store=store,
                refresh=refresh,
                until=until,
                method=case.method,
                limits=limits,
                variant=dict(case.changed) or None,
                return_state=True,
            )
        except Exception as error:
            # Not the run of the sequence, but what Prefect does round it: the others are tried all the same.
            lost, state = error, Failed(message=str(error), data=error)
        outcome = _case_outcome(case, state, store, until)
        outcome.seed = case.seed if len(seeds or ()) > 1 else None
        page.sequence_ended(outcome, store)
        if lost is not None:
            check_server(lost)
        return outcome

    passed: list[SequenceOutcome] = []

    def run_all() -> DatasetOutcome:
        page.restart()
        if at_once == 1:
            outcomes = [reconstruct(case) for case in cases]
        else:
            outcomes = _side_by_side(reconstruct, expected, at_once)
        # Where the page met damage, all but that is found in the store now.
        for earlier, outcome in zip(passed, outcomes, strict=False):
            outcome.add_time_of(earlier)
        passed[:] = outcomes
        report = None
        if until == "report":
            label = profile_label(profile, method if methods is None else ", ".join(methods))
            given = [case.settings for case in cases]
            pages = PrefectRunner(store, refresh, limits)
            report = dataset_page(outcomes, given, name, label, Store(store), pages)
        return DatasetOutcome(outcomes, report)

    config = cases[0].config()
    work = expected_work(cases[0].sequence, config)
    with (
        run_lease(store),
        run_page(name, config, until, sequences=len(cases), bars=False, work=work) as page,
        # Also where all are looked up again, since the page of all met damage.
        refreshed_once(),
    ):
        found = again_after_damage(Store(store), run_all)
        if found.report is not None:
            page.link(found.report, artifact_key("report", name), f"Report of {name}")
    attempt(
        lambda: create_markdown_artifact(
            dataset_markdown(found.sequences),
            key=artifact_key("dataset", name),
            description=f"{len(cases)} runs, profile {profile}",
        )
    )
    if found.failed_share > max_failed_share:
        raise DatasetFailedError(found, max_failed_share)
    return found


def _check(cases: Sequence[SequenceCase], store: str, until: StageName) -> None:
    """Report what affects all sequences once: invalid settings, missing models and a read-only store.

    Raises:
        ExtragsError: see `flows.sequence.open_store` and `flows.preflight.preflight_cases`.
    """
    open_store(store)
    preflight_cases(cases, until)


def _side_by_side(
    reconstruct: Callable[[SequenceCase], SequenceOutcome], expected: Sequence[Expectation], at_once: int
) -> list[SequenceOutcome]:
    """Run cases in threads, those that take longest first.

    Args:
        reconstruct: runs one.
        expected: the cases, in the order of the outcomes.
        at_once: in work at the same time.
    """
    with ThreadPoolExecutor(max_workers=at_once) as pool:
        try:
            # Flow and observer are in context variables, which threads do not inherit.
            futures = {
                item.case.title: pool.submit(copy_context().run, reconstruct, item.case)
                for item in longest_first(expected)
            }
            return [futures[item.case.title].result() for item in expected]
        except BaseException:
            # SIGTERM or Ctrl-C, say: what has begun ends at its next event, and nothing else begins.
            with stages_interrupted():
                pool.shutdown(cancel_futures=True)
            raise


def _case_outcome(case: SequenceCase, state: State[Any], store: str, until: StageName) -> SequenceOutcome:
    """The outcome of the flow run of a case; one that could not leave its record itself is recorded here."""
    outcome = outcome_of(case.sequence, state)
    outcome.variant = case.variant
    if not isinstance(state.result(raise_on_failure=False), SequenceOutcome | SequenceFailedError):
        record_outcome_quietly(Store(store), case, outcome, until, case.config())
    return outcome


def outcome_of(sequence: str, state: State[Any]) -> SequenceOutcome:
    """The outcome of a finished flow run, whether it ended well or not."""
    found = state.result(raise_on_failure=False)
    if isinstance(found, SequenceOutcome):
        return found
    if isinstance(found, Exception):
        release_locals(found)  # It is kept until the last sequence has ended.
    if isinstance(found, SequenceFailedError):
        return found.outcome
    # Not a stage but the run itself failed (a crash of its task runner, say).
    reason = str(found) if found is not None else state.name or "unknown"
    log.error("%s: %s", sequence, reason)
    return failed_outcome(sequence, reason, found if isinstance(found, Exception) else None)
