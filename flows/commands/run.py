"""`run`: sequences through all stages."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, DamagedArtefactError, ExtragsError, UnknownSequenceError
from flows.commands.common import run_config, set_up_logging, stage_limits, store_root, write_json
from flows.commands.options import Parser, add_json, add_method, add_runner
from flows.failures import describe_error

if TYPE_CHECKING:
    from extrags.config import PipelineConfig
    from extrags.pipeline import StageName
    from flows.outcome import DatasetOutcome

__all__ = ["add_arguments", "execute", "run"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags run`."""
    from extrags.pipeline import STAGES

    parser.description = (
        "Take each sequence through all stages. What is in the store already is not made again; a failure of "
        "one sequence does not stop the others."
    )
    parser.set_defaults(command=run)
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    add_method(parser)
    add_runner(parser)
    add_json(parser)
    parser.add_argument(
        "--until", choices=STAGES, default="report", metavar="STAGE", help="stop after this stage"
    )
    parser.add_argument(
        "--refresh", action="store_true", help="run every stage although its artefact is in the store"
    )
    parser.add_argument(
        "--at-once", type=int, default=1, metavar="N", help="sequences in work at the same time (default: 1)"
    )
    parser.add_argument(
        "--always-flow",
        action="store_true",
        help="start a flow run even if everything is in the store already",
    )


def run(given: argparse.Namespace) -> int:
    """`extrags run`."""
    if given.at_once < 1:
        raise ConfigError(f"--at-once is {given.at_once}; expected 1 or more")
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
    errors = [sequence.error for sequence in outcome.sequences if sequence.error is not None]
    for hint in dict.fromkeys(hint for error in errors for hint in describe_error(error)[1:]):
        print(f"extrags: {hint}", file=sys.stderr)
    write_json(outcome.to_json(seconds), given.json)
    return 0 if all(sequence.status == "ok" for sequence in outcome.sequences) else 1


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
    from extrags.store import Store
    from flows.environment import has_own_home, prepare, without_heartbeat
    from flows.methods import METHODS
    from flows.temporary_server import start_early, stop_early, temporary_server

    terminal = sys.stderr.isatty()
    set_up_logging(debug=given.debug, terminal=terminal)
    root, config = store_root(given), run_config(given)
    own_home = has_own_home()
    prepare(Store(root).state, debug=given.debug)
    always = refresh or always_flow
    if own_home and (always or not all(_may_be_finished(root, name, until) for name in sequences)):
        start_early()
    _check_names(sequences)
    if not always:
        # Nothing to make: no need to wait for a server.
        found = _from_store(sequences, config, root, given.profile, given.method, until)
        if found is not None:
            stop_early()
            return found
        if own_home:
            start_early()
    # The flow looks as well; here it is said without waiting for a server.
    from flows.preflight import preflight

    preflight(config, until, METHODS[given.method].leave_out)
    from flows.console import progress_bars
    from flows.dataset import reconstruct_dataset
    from flows.outcome import DatasetFailedError

    limits = stage_limits(given)
    with temporary_server(), without_heartbeat(), progress_bars(terminal=terminal):
        try:
            outcome: DatasetOutcome = reconstruct_dataset(
                sequences=sequences,
                profile=given.profile,
                settings=given.settings,
                seed=given.seed,
                store=root,
                refresh=refresh,
                until=until,
                runner=given.runner,
                at_once=at_once,
                method=given.method,
                limits=limits,
            )
        except DatasetFailedError as error:
            # Said to Prefect; here each sequence is reported, and the exit code is 1 if any failed.
            outcome = error.outcome
    if given.debug:
        for sequence in outcome.sequences:
            if sequence.error is not None:
                raise sequence.error
    return outcome


def _may_be_finished(root: str, sequence: str, until: StageName) -> bool:
    """False where a sequence was hardly ever taken to its last stage; answers before torch is imported.

    A guess: it decides when the server starts, not whether anything is made.
    """
    if until != "report" or "://" in root:
        return True
    for manifest in Path(root).glob("artefacts/report-v*/manifest.json"):
        try:
            if json.loads(manifest.read_bytes())["label"] == sequence:
                return True
        except (OSError, ValueError, KeyError):
            continue
    return False


def _from_store(
    sequences: list[str], config: PipelineConfig, root: str, profile: str, method: str, until: StageName
) -> DatasetOutcome | None:
    """Outcomes from the store alone; None as soon as anything is missing or wrong."""
    from flows.methods import METHODS, profile_label
    from flows.outcome import DatasetOutcome
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
    except (NotInStoreError, DamagedArtefactError):
        return None
    return DatasetOutcome(outcomes, page)


def _check_names(sequences: list[str]) -> None:
    """An unknown name is wrong usage and stops everything; a source that is wrong concerns its own run."""
    from data_catalog.catalog import resolve

    for sequence in sequences:
        try:
            resolve(sequence)
        except UnknownSequenceError:
            raise
        except ExtragsError:
            continue
    if len({str(Path(sequence)) for sequence in sequences}) != len(sequences):
        raise ConfigError("a sequence is named twice")
