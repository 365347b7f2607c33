"""`retention`: removes from the store what a policy does not keep, and old runs from Prefect's database."""

from __future__ import annotations

import datetime
import logging
from typing import Annotated

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import (
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterEndTime,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import StateType
from prefect.exceptions import ObjectNotFound
from pydantic import Field

from extrags.errors import StoreError
from extrags.store import Store
from extrags.store.retention import Policy
from flows.cleaning import clean_store
from flows.leases import FLOWS, run_lease
from flows.parameters import StoreRoot
from flows.settings import run_store
from tasks.run_page import artifact_key, attempt
from tasks.stage import all_stage_versions

__all__ = ["prune_flow_runs", "retention"]

log = logging.getLogger(__name__)

BATCH = 200
"""The most that a server returns at once."""
DAY_S = 86400.0
MOST_GIB = 2.0**40
"""Larger than any store; without a bound, a number may be too large for bytes."""
MOST_DAYS = 36_500.0
"""A hundred years; dates do not go back for ever."""
ENDED = [StateType.COMPLETED, StateType.FAILED, StateType.CANCELLED, StateType.CRASHED]


@flow(name="retention", log_prints=False, persist_result=False)
def retention(
    store: Annotated[
        StoreRoot, Field(description="directory or URL of the artefact store; EXTRAGS_STORE by default")
    ] = None,
    older_than_days: Annotated[
        float | None,
        Field(gt=0, le=MOST_DAYS, allow_inf_nan=False, description="remove artefacts not used for so long"),
    ] = None,
    max_gib: Annotated[
        float | None,
        Field(
            ge=0,
            le=MOST_GIB,
            allow_inf_nan=False,
            description="remove the least recently used until the store is no larger",
        ),
    ] = None,
    keep_last: Annotated[
        int | None, Field(ge=1, description="of each sequence, keep what its last runs used")
    ] = None,
    unreachable: Annotated[bool, Field(description="remove what no kept run used")] = False,
    with_inputs: Annotated[
        bool, Field(description="also what kept artefacts were made from, except by max_gib")
    ] = False,
    flow_runs_days: Annotated[
        float | None,
        Field(
            gt=0,
            le=MOST_DAYS,
            allow_inf_nan=False,
            description="delete flow runs of extrags that ended so long ago",
        ),
    ] = None,
    dry_run: Annotated[bool, Field(description="only say what would be removed")] = False,
) -> dict[str, int]:
    """Clean the store and Prefect's database; runs that are going on are spared.

    Returns:
        Numbers of `artefacts`, `bytes`, `leftovers` and `flow_runs` that were removed, or would be, and of
        artefacts that were `skipped`, because their manifests cannot be read.

    Raises:
        ConfigError: for a store that is relative to where a worker was started.
        StoreError: when there is no such store, or something could not be removed; all else has been by
            then, and the artifact says what.
    """
    store = run_store(store)
    place = Store(store)
    if not place.exists():
        raise StoreError(f"there is no store {store}")
    with run_lease(store):
        policy = Policy(
            older_than_s=None if older_than_days is None else older_than_days * DAY_S,
            max_bytes=None if max_gib is None else int(max_gib * 2**30),
            keep_last=keep_last,
            unreachable=unreachable,
            versions=all_stage_versions(),
            with_inputs=with_inputs,
        )
        cleaned = clean_store(place, policy, dry_run=dry_run)
        removed = cleaned.artefacts.removed
        for item in removed:
            log.info("%s %s: %s", "would remove" if dry_run else "removed", item.key, item.reason)
        runs = 0
        if flow_runs_days is not None:
            limit = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=flow_runs_days)
            runs = prune_flow_runs(limit, dry_run=dry_run)
    found = {
        "artefacts": len(removed),
        "bytes": sum(item.bytes for item in removed),
        "leftovers": len(cleaned.leftovers),
        "flow_runs": runs,
        "skipped": len(cleaned.artefacts.skipped),
    }
    lines = [f"| {name} | {count} |" for name, count in found.items()]
    attempt(
        lambda: create_markdown_artifact(
            "\n".join([f"| {'would be' if dry_run else ''} removed | number |", "|---|---:|", *lines]),
            key=artifact_key("retention", store),
            description=f"retention of {store}",
        )
    )
    cleaned.check()
    return found


def prune_flow_runs(before: datetime.datetime, *, dry_run: bool = False) -> int:
    """Delete flow runs of extrags that ended before a time, with their task runs; in batches.

    Args:
        before: with time zone.
        dry_run: only count them.

    Returns:
        Their number.
    """
    ended = FlowRunFilter(
        end_time=FlowRunFilterEndTime(before_=before),
        state=FlowRunFilterState(type=FlowRunFilterStateType(any_=ENDED)),
    )
    ours = FlowFilter(name=FlowFilterName(any_=list(FLOWS)))
    deleted = 0
    with get_client(sync_client=True) as client:
        while True:
            # What is deleted moves the rest forward; what is only counted does not.
            batch = client.read_flow_runs(
                flow_filter=ours, flow_run_filter=ended, limit=BATCH, offset=deleted if dry_run else 0
            )
            for run in batch:
                if not dry_run:
                    try:
                        client.delete_flow_run(run.id)
                    except ObjectNotFound:
                        continue  # With its parent, or by another run of this flow.
                deleted += 1
            if len(batch) < BATCH:
                return deleted
