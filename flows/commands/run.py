"""`run`, `plan`, `report`: the verbs that take sequences through stages."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from data_catalog.catalog import resolve
from extrags.config import PipelineConfig
from extrags.errors import ConfigError, ExtragsError, StoreError, UnknownSequenceError
from extrags.pipeline import StageName, check_stage
from extrags.store import Store
from flows.commands.common import parsed_settings, set_up_logging, store_root, write_json
from flows.environment import prepare, without_heartbeat
from flows.methods import METHODS, method_config, profile_label, refuse_pinned
from flows.outcome import DatasetOutcome
from flows.preflight import preflight

__all__ = ["execute", "plan", "report", "run"]


def run(given: argparse.Namespace) -> int:
    """`extrags run`."""
    if given.at_once < 1:
        raise ConfigError(f"--at-once is {given.at_once}; expected 1 or more")
    check_stage(given.until)
    begun = time.monotonic()
    outcome = execute(
        given.sequences,
        given,
        until=given.until,
        refresh=given.refresh,
        at_once=given.at_once,
        always_flow=given.always_flow,
    )
    seconds = time.monotonic() - begun
    from flows.console import print_outcomes

    print_outcomes(outcome, seconds)
    write_json(outcome.to_json(seconds), given.json)
    return 0 if all(sequence.status == "ok" for sequence in outcome.sequences) else 1


def plan(given: argparse.Namespace) -> int:
    """`extrags plan`."""
    (outcome,) = execute([given.sequence], given, until="assess").sequences
    if outcome.status == "failed":
        raise outcome.error or ExtragsError(f"{outcome.name} failed")
    from flows.console import print_plan

    if given.json != "-":
        print_plan(outcome)
    write_json({"sequence": outcome.name, **(outcome.plan or {})}, given.json)
    return 0


def report(given: argparse.Namespace) -> int:
    """`extrags report`: from what is in the store, without running anything else."""
    set_up_logging(debug=given.debug, terminal=True)
    root, config = store_root(given), _config(given)
    prepare(Store(root).state, debug=given.debug)
    from flows.runners import DirectRunner, NotInStoreError, StoreRunner
    from flows.wiring import SequenceRun
    from tasks.report import PAGE

    _check_names([given.sequence])
    sequence = SequenceRun(
        given.sequence,
        config,
        root,
        StoreRunner(root),
        profile_label(given.profile, given.method),
        leave_out=METHODS[given.method].leave_out,
    )
    try:
        outcome = sequence.run("evaluate")
    except NotInStoreError as error:
        raise StoreError(
            f"{given.sequence} with these settings is not finished in {root}; run it first ({error})"
        ) from error
    if outcome.status == "failed":
        raise outcome.error or ExtragsError(f"{outcome.name} failed")
    sequence.runner = DirectRunner(root, refresh=True)
    sequence.report()
    page = sequence.store.open(sequence.refs["report"]) / PAGE
    if given.output:
        try:
            shutil.copyfile(page, given.output)
        except OSError as error:
            raise StoreError(f"{given.output} cannot be written: {error.strerror or error}") from error
    print(given.output or page)
    return 0


def execute(
    sequences: list[str],
    given: argparse.Namespace,
    *,
    until: StageName,
    refresh: bool = False,
    at_once: int = 1,
    always_flow: bool = False,
) -> DatasetOutcome:
    """Take sequences through stages: from the store if everything is there, else in a flow run.

    Raises:
        ConfigError: for wrong settings.
        UnknownSequenceError: for a name that is not in the catalogue.
        StoreError: for a store that cannot be written.
        WeightsError: when a model or weights that the settings name are not there.
        MissingDependencyError: when a package that the settings need is not there.
    """
    terminal = sys.stderr.isatty()
    set_up_logging(debug=given.debug, terminal=terminal)
    root, config = store_root(given), _config(given)
    _check_names(sequences)
    store = Store(root)
    prepare(store.state, debug=given.debug)
    if not refresh and not always_flow:
        # Nothing to make: no need to wait for a server.
        found = _from_store(sequences, config, root, given.profile, given.method, until)
        if found is not None:
            return found
    # The flow looks as well; here it is said without waiting for a server.
    preflight(config, until, METHODS[given.method].leave_out)
    from flows.console import watched
    from flows.dataset import reconstruct_dataset

    with without_heartbeat(), watched(terminal=terminal):
        outcome: DatasetOutcome = reconstruct_dataset(
            sequences=sequences,
            profile=given.profile,
            settings=parsed_settings(given.settings),
            seed=given.seed,
            store=root,
            refresh=refresh,
            until=until,
            runner=given.runner,
            at_once=at_once,
            method=given.method,
        )
    if given.debug:
        for sequence in outcome.sequences:
            if sequence.error is not None:
                raise sequence.error
    return outcome


def _from_store(
    sequences: list[str], config: PipelineConfig, root: str, profile: str, method: str, until: StageName
) -> DatasetOutcome | None:
    """Outcomes from the store alone; None as soon as anything is missing or wrong."""
    from flows.pages import dataset_page
    from flows.runners import NotInStoreError, StoreRunner
    from flows.wiring import run_sequence
    from tasks.progress import observed

    def ignore(_: object) -> None:
        """Looking is no progress."""

    runner = StoreRunner(root)
    label = profile_label(profile, method)
    try:
        with observed(ignore):
            outcomes = [
                run_sequence(
                    sequence,
                    config,
                    root,
                    runner,
                    profile=label,
                    until=until,
                    leave_out=METHODS[method].leave_out,
                )
                for sequence in sequences
            ]
            if any(outcome.status == "failed" for outcome in outcomes):
                return None
            page = dataset_page(outcomes, "dataset", label, runner) if until == "report" else None
    except NotInStoreError:
        return None
    return DatasetOutcome(outcomes, page)


def _config(given: argparse.Namespace) -> PipelineConfig:
    settings: dict[str, Any] = parsed_settings(given.settings)
    refuse_pinned(given.method, settings)
    return method_config(given.method, given.profile, settings, given.seed)


def _check_names(sequences: list[str]) -> None:
    """An unknown name is wrong usage and stops everything; a source that is wrong concerns its own run."""
    for sequence in sequences:
        try:
            resolve(sequence)
        except UnknownSequenceError:
            raise
        except ExtragsError:
            continue
    if len({str(Path(sequence)) for sequence in sequences}) != len(sequences):
        raise ConfigError("a sequence is named twice")
