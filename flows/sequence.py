"""`reconstruct-sequence`: one sequence through all stages."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Annotated

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from pydantic import Field

from data_catalog.names import plain_name
from extrags.config import DEFAULT_PROFILE, ProfileName, Seed
from extrags.errors import ExtragsError, reason_of
from extrags.stages import StageName
from extrags.store import Store
from extrags.store.runs import file_killed, sweep_unreadable
from flows.cases import SequenceCase, record_outcome_quietly
from flows.leases import is_inner_run, run_lease
from flows.limits import DEFAULT_LIMITS, StageLimits
from flows.methods import METHODS, MethodName, pinned_settings, profile_label
from flows.outcome import SequenceFailedError, SequenceOutcome, failed_outcome
from flows.parameters import Settings, StoreRoot
from flows.preflight import preflight
from flows.run_page import run_page
from flows.runners import PrefectRunner
from flows.settings import run_store
from flows.tables import sequence_markdown
from flows.wiring import run_sequence
from flows.workloads import expected_work
from tasks.locks import sweep_locks
from tasks.run_page import artifact_key, attempt

__all__ = ["open_store", "reconstruct_sequence"]

log = logging.getLogger(__name__)


@flow(name="reconstruct-sequence", flow_run_name="{sequence}", log_prints=False, persist_result=False)
def reconstruct_sequence(
    sequence: Annotated[
        str, Field(min_length=1, description="DATASET/SEQUENCE[@SETTING], or the path of a folder")
    ],
    profile: Annotated[ProfileName, Field(description="named settings")] = DEFAULT_PROFILE,
    settings: Annotated[Settings, Field(description='overrides such as {"coarse.iterations": 500}')] = None,
    seed: Annotated[Seed | None, Field(description="seed of all stages")] = None,
    store: Annotated[
        StoreRoot, Field(description="directory or URL of the artefact store; EXTRAGS_STORE by default")
    ] = None,
    refresh: Annotated[bool, Field(description="run every stage although its artefact is there")] = False,
    until: Annotated[StageName, Field(description="last stage to run")] = "report",
    method: Annotated[
        MethodName, Field(description="the whole pipeline, or one it is compared with")
    ] = "extrags",
    limits: Annotated[StageLimits, Field(description="retries and time limits of stages")] = DEFAULT_LIMITS,
    variant: Annotated[
        Settings, Field(description="further overrides, which set this run apart from others of the sequence")
    ] = None,
) -> SequenceOutcome:
    """Reconstruct, explore, restore and evaluate one sequence.

    How it ended is left in the store (`flows.cases`), where `extrags status` and later runs find it.

    Returns:
        What was made; also as a Markdown artifact.

    Raises:
        SequenceFailedError: when a stage failed; what was finished stays in the store.
        ExtragsError: when something is missing that the run needs (`flows.preflight.preflight`); that is on
            record as well.
    """
    sequence = plain_name(sequence)
    case = SequenceCase(sequence, method, profile, seed, settings or {}, variant or {})
    config = case.config()
    store = run_store(store)
    with run_lease(store), run_page(sequence, config, until, work=expected_work(sequence, config)) as page:
        open_store(store)
        try:
            preflight(config, until, METHODS[method].leave_out)
        except ExtragsError as error:
            # Runs inside a dataset are put on record there.
            if not is_inner_run():
                outcome = failed_outcome(sequence, str(error), error)
                record_outcome_quietly(Store(store), case, outcome, until, config)
            raise
        outcome = run_sequence(
            sequence,
            config,
            store,
            PrefectRunner(store, refresh, limits),
            profile=profile_label(profile, method),
            until=until,
            leave_out=METHODS[method].leave_out,
            memory_limit_gb=limits.memory_gb,
            pinned=pinned_settings(method),
        )
        record_outcome_quietly(Store(store), case, outcome, until, config)
        # Of workers that died while others went on.
        for name in Store(store).sweep_scratch():
            log.info("removed what a killed worker left: %s", name)
        page.sequence_ended(outcome, store)
    attempt(
        lambda: create_markdown_artifact(
            sequence_markdown(outcome),
            key=artifact_key("sequence", sequence),
            description=f"{sequence}, profile {profile}",
        )
    )
    if outcome.status == "failed":
        raise SequenceFailedError(outcome) from outcome.error
    return outcome


def open_store(root: str) -> Store:
    """Open the store of a run, check that it can be written, and remove leftovers of killed runs.

    A run inside another one leaves them: that has just removed them, and on an object store it takes a
    request for every artefact. What cannot be removed costs a warning.

    Raises:
        StoreError: when it cannot be written. Prefect itself would run everything and keep nothing.
    """
    store = Store(root)
    store.check_writable()
    if is_inner_run():
        return store
    steps: tuple[Callable[[], list[str]], ...] = (
        store.sweep,
        lambda: sweep_locks(store.locks),
        lambda: file_killed(store),
        lambda: sweep_unreadable(store),
    )
    for step in steps:
        try:
            for name in step():
                log.info("removed what a killed run left: %s", name)
        except Exception as error:
            # Leftovers take room and do no other harm. Each fsspec backend raises its own kinds.
            place = getattr(error, "filename", None) or root
            log.warning("what killed runs left in %s could not all be removed: %s", place, reason_of(error))
    return store
