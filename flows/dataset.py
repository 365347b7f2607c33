"""`reconstruct-dataset`: many sequences; a failure of one never stops the others."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Annotated, Any

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from prefect.client.schemas.objects import State
from pydantic import Field

from extrags.config import ProfileName
from extrags.pipeline import StageName
from extrags.store import Store
from flows.damage import again_after_damage
from flows.leases import run_lease
from flows.limits import DEFAULT_LIMITS, StageLimits
from flows.methods import METHODS, MethodName, check_not_pinned, method_config, profile_label
from flows.outcome import DatasetFailedError, DatasetOutcome, SequenceFailedError, SequenceOutcome, StageRow
from flows.pages import dataset_page
from flows.preflight import preflight
from flows.run_page import run_page
from flows.runners import PrefectRunner
from flows.sequence import open_store, reconstruct_sequence
from flows.settings import DEFAULT_STORE, task_runner
from flows.tables import dataset_markdown
from tasks.run_page import artifact_key, attempt

__all__ = ["reconstruct_dataset"]

log = logging.getLogger(__name__)

MAX_FAILED_SHARE = 0.5
"""When most sequences fail, it is hardly the sequences' fault."""


@flow(name="reconstruct-dataset", flow_run_name="{name}", log_prints=False, persist_result=False)
def reconstruct_dataset(
    sequences: Annotated[list[str], Field(min_length=1, description="names or paths")],
    profile: Annotated[ProfileName, Field(description="named settings")] = "balanced",
    settings: Annotated[dict[str, Any] | None, Field(description="overrides by dotted name")] = None,
    seed: Annotated[int | None, Field(ge=0, description="seed of all stages")] = None,
    store: Annotated[str, Field(description="directory or URL of the artefact store")] = DEFAULT_STORE,
    refresh: Annotated[bool, Field(description="run every stage although its artefact is there")] = False,
    until: Annotated[StageName, Field(description="last stage to run")] = "report",
    runner: Annotated[str, Field(description="threads, dask or dask:ADDRESS")] = "threads",
    at_once: Annotated[int, Field(ge=1, description="sequences in work at the same time")] = 1,
    name: Annotated[str, Field(description="name of this run, for its table")] = "dataset",
    method: Annotated[
        MethodName, Field(description="the whole pipeline, or one it is compared with")
    ] = "extrags",
    limits: Annotated[StageLimits, Field(description="retries and time limits of stages")] = DEFAULT_LIMITS,
    max_failed_share: Annotated[
        float, Field(ge=0, le=1, description="the run counts as failed when more of its sequences failed")
    ] = MAX_FAILED_SHARE,
) -> DatasetOutcome:
    """Take every sequence through all stages, each as a flow run of its own.

    Returns:
        One outcome per sequence, in the order given; failures among them. The summary is an artifact.

    Raises:
        DatasetFailedError: when more than `max_failed_share` of the sequences failed; table and page have
            been written by then.
    """
    # Invalid settings, missing models and a read-only store affect all sequences: report them once.
    check_not_pinned(method, settings or {})
    config = method_config(method, profile, settings, seed)
    open_store(store)
    preflight(config, until, METHODS[method].leave_out)
    one = reconstruct_sequence.with_options(task_runner=task_runner(runner, at_once))

    def reconstruct(sequence: str) -> SequenceOutcome:
        state: State[Any] = one(
            sequence=sequence,
            profile=profile,
            settings=settings,
            seed=seed,
            store=store,
            refresh=refresh,
            until=until,
            method=method,
            limits=limits,
            return_state=True,
        )
        outcome = outcome_of(sequence, state)
        page.sequence_ended(outcome, store)
        return outcome

    def run_all() -> DatasetOutcome:
        page.restart()
        if at_once == 1:
            outcomes = [reconstruct(sequence) for sequence in sequences]
        else:
            with ThreadPoolExecutor(max_workers=at_once) as pool:
                # Flow and observer are in context variables, which threads do not inherit.
                futures = [pool.submit(copy_context().run, reconstruct, sequence) for sequence in sequences]
                outcomes = [future.result() for future in futures]
        report = None
        if until == "report":
            label = profile_label(profile, method)
            report = dataset_page(outcomes, name, label, PrefectRunner(store, refresh, limits))
        return DatasetOutcome(outcomes, report)

    with run_lease(store), run_page(name, config, until, sequences=len(sequences), bars=False) as page:
        found = again_after_damage(Store(store), run_all)
        if found.report is not None:
            page.link(found.report, artifact_key("report", name), f"Report of {name}")
    attempt(
        lambda: create_markdown_artifact(
            dataset_markdown(found.sequences),
            key=artifact_key("dataset", name),
            description=f"{len(sequences)} sequences, profile {profile}",
        )
    )
    if found.failed_share > max_failed_share:
        raise DatasetFailedError(found, max_failed_share)
    return found


def outcome_of(sequence: str, state: State[Any]) -> SequenceOutcome:
    """The outcome of a finished flow run, whether it ended well or not."""
    found = state.result(raise_on_failure=False)
    if isinstance(found, SequenceOutcome):
        return found
    if isinstance(found, SequenceFailedError):
        return found.outcome
    # Not a stage but the run itself failed (a crash of its task runner, say).
    reason = str(found) if found is not None else state.name or "unknown"
    log.error("%s: %s", sequence, reason)
    return SequenceOutcome(
        sequence,
        "failed",
        [StageRow("ingest", "failed", reason=reason)],
        error=found if isinstance(found, Exception) else None,
    )
