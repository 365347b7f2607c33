"""`run`: sequences through all stages."""

from __future__ import annotations

import argparse
import json
import logging
import re
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from extrags.errors import (
    ConfigError,
    DamagedArtefactError,
    ExtragsError,
    SourceError,
    UnknownSequenceError,
)
from flows.commands.common import (
    items,
    run_config,
    set_up_logging,
    showing,
    stage_limits,
    store_root,
    write_json,
)
from flows.commands.options import Parser, add_json, add_method, add_runner, add_sequences, add_stages
from flows.failures import describe_error
from flows.outcome import DatasetFailedError, DatasetOutcome, SequenceOutcome, StageRow

if TYPE_CHECKING:
    from extrags.stages import StageName
    from flows.cases import SequenceCase

__all__ = ["Several", "add_arguments", "execute", "parsed_matrix", "parsed_methods", "run"]

log = logging.getLogger(__name__)


def add_arguments(parser: Parser) -> None:
    """The options of `extrags run`."""
    parser.description = (
        "Take each sequence through all stages. What is in the store already is not made again; a failure of "
        "one sequence does not stop the others."
    )
    parser.set_defaults(command=run)
    add_sequences(parser, chosen=True, nargs="*")
    parser.add_argument(
        "--manifest",
        metavar="FILE",
        action="append",
        default=[],
        help="take the sequences of a file: one a line, or YAML or JSON with settings of each; repeatable",
    )
    add_method(parser)
    add_runner(parser)
    add_json(parser)
    add_stages(parser)
    parser.add_argument(
        "--at-once", type=int, default=1, metavar="N", help="sequences in work at the same time (default: 1)"
    )
    parser.add_argument(
        "--memory-limit",
        type=float,
        metavar="GB",
        help="refuse a sequence whose estimated peak memory is higher, and name settings that fit; of each "
        "sequence in work (default: no limit)",
    )
    parser.add_argument(
        "--only",
        choices=("failed", "changed", "missing"),
        help="failed: the last run failed; changed: some stage is out of date; missing: never completed",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        default=[],
        metavar="METHOD",
        help="several methods instead of --method, each on every sequence",
    )
    parser.add_argument(
        "--seeds", nargs="+", default=[], metavar="N", help="several seeds instead of --seed: 0,1,2"
    )
    parser.add_argument(
        "--matrix",
        action="append",
        default=[],
        metavar="NAME=VALUE,VALUE",
        help="several values of a setting, each on every sequence; repeatable: every combination is run",
    )
    parser.add_argument(
        "--always-flow",
        action="store_true",
        help="start a flow run even if everything is in the store already",
    )


def run(given: argparse.Namespace) -> int:
    """`extrags run`."""
    from flows.commands.benchmark import parsed_seeds

    if given.at_once < 1:
        raise ConfigError(f"--at-once is {given.at_once}; expected 1 or more")
    sequences = [*given.sequences, *(f"@{file}" for file in given.manifest)]
    if not sequences:
        raise ConfigError(
            "the following arguments are required: SEQUENCE or --manifest FILE (see extrags run --help)"
        )
    begun = time.monotonic()
    outcome = execute(
        sequences,
        given,
        until=given.until,
        refresh=given.refresh,
        at_once=given.at_once,
        always_flow=given.always_flow,
        several=Several(
            only=given.only,
            methods=tuple(parsed_methods(given.methods, given.method)),
            seeds=tuple(parsed_seeds(given.seeds) if given.seeds else [given.seed]),
            matrix=parsed_matrix(given.matrix),
        ),
    )
    seconds = time.monotonic() - begun
    from flows.console import print_failures, print_outcomes

    if given.quiet:
        print_failures(outcome)
    elif not outcome.sequences:
        print(f"extrags: no sequence is {given.only}; nothing to do", file=sys.stderr)
    else:
        print_outcomes(outcome, seconds)
    errors = [sequence.error for sequence in outcome.sequences if sequence.error is not None]
    for hint in dict.fromkeys(hint for error in errors for hint in describe_error(error)[1:]):
        print(f"extrags: {hint}", file=sys.stderr)
    write_json(outcome.to_json(seconds), given.json)
    return 0 if all(sequence.status == "ok" for sequence in outcome.sequences) else 1


@dataclass(frozen=True)
class Several:
    """What makes more, or fewer, than one run of each sequence; see `flows.dataset.reconstruct_dataset`."""

    only: Literal["failed", "changed", "missing"] | None = None
    methods: tuple[str, ...] = ()
    seeds: tuple[int | None, ...] = ()
    matrix: Mapping[str, list[Any]] = field(default_factory=dict)


def parsed_methods(given: list[str], single: str) -> list[str]:
    """`["3dgs,extrags"]` to a list of methods; without any the one of `--method`.

    Raises:
        ConfigError: for an unknown method.
    """
    from flows.methods import METHODS

    methods = items(given) or [single]
    for method in methods:
        if method not in METHODS:
            raise ConfigError(f"no method {method!r}; known: {', '.join(METHODS)}")
    return methods


def parsed_matrix(given: list[str]) -> dict[str, list[Any]]:
    """`["coarse.iterations=500,1000"]` to `{"coarse.iterations": [500, 1000]}`.

    Values are written as for the setting's own flag; those that hold commas themselves between brackets:
    `enhance.channels=[8,8,16],[16,16,32]`.

    Raises:
        ConfigError: for an unknown setting, one that is given twice, or a wrong value.
    """
    from extrags.config import PipelineConfig
    from extrags.config.settings import settings_of, unknown_setting

    known = settings_of(PipelineConfig)
    matrix: dict[str, list[Any]] = {}
    for text in given:
        name, separator, values = text.partition("=")
        if not separator or not values:
            raise ConfigError(f"--matrix {text}: expected NAME=VALUE,VALUE, e.g. coarse.iterations=500,1000")
        if name not in known:
            raise unknown_setting(name, known)
        if name in matrix:
            raise ConfigError(f"--matrix {name} is given twice; give all of its values at once")
        # A comma between brackets belongs to the value.
        matrix[name] = [known[name].parse(value) for value in re.split(r",(?![^\[]*\])", values)]
    return matrix


def execute(
    sequences: list[str],
    given: argparse.Namespace,
    *,
    until: StageName,
    refresh: bool = False,
    at_once: int = 1,
    always_flow: bool = False,
    several: Several | None = None,
) -> DatasetOutcome:
    """Take sequences through stages: from the store if everything is there, else in a flow run.

    Raises:
        ConfigError: for wrong settings or manifests.
        UnknownSequenceError: for a name that is not in the catalogue, or a pattern that matches none.
        StoreError: for a store that cannot be written.
        WeightsError: when a model or weights that the settings name are not there.
        MissingDependencyError: when a package that the settings need is not there.
    """
    from extrags.store import Store
    from flows.environment import has_own_home, prepare, without_heartbeat
    from flows.temporary_server import start_early, stop_early, temporary_server

    terminal = sys.stderr.isatty()
    set_up_logging(debug=given.debug, terminal=terminal, quiet=given.quiet)
    root = store_root(given)
    several = several or Several(methods=(given.method,), seeds=(given.seed,))
    if several.methods == (given.method,):
        # Wrong usage is said before anything is made or loaded.
        run_config(given)
    own_home = has_own_home()
    prepare(Store(root).state, debug=given.debug)
    always = refresh or always_flow
    if own_home and (always or not all(_may_be_finished(root, name, until) for name in sequences)):
        start_early()
    from flows.cases import cases_of, selected
    from flows.expectation import expectations, expected_words
    from flows.methods import METHODS
    from flows.selection import absolute_manifests, chosen_sequences

    chosen = chosen_sequences(sequences)
    _check_names([item.name for item in chosen])
    every = cases_of(
        chosen,
        methods=several.methods,
        profile=given.profile,
        seeds=several.seeds,
        settings=given.settings,
        matrix=several.matrix,
    )
    cases = selected(every, several.only, root, until)
    if not cases:
        stop_early()
        return DatasetOutcome([])
    try:
        _check_working_distance(cases)
    except ConfigError:
        stop_early()
        raise
    if not always:
        # Nothing to make: no need to wait for a server.
        found = _from_store(cases, root, until, several_seeds=len(several.seeds) > 1)
        if found is not None:
            stop_early()
            return found
    # The flow looks as well; here it is said without waiting for a server, which writes into the store.
    Store(root).check_writable()
    if own_home:
        start_early()
    if len(cases) == 1:
        refused = _wrong_source(cases[0], until)
        if refused is not None:
            stop_early()
            _record(cases[0], refused, root, until)
            return _raised(DatasetOutcome([refused]), given)
    from flows.preflight import preflight

    for method in several.methods:
        first = next((case for case in cases if case.method == method), None)
        if first is not None:
            preflight(first.config(), until, METHODS[method].leave_out)
    if terminal and not given.quiet and len(cases) > 1:
        # Elsewhere it is a line of the log.
        expected = expectations(cases, root, until, refresh=refresh)
        print(
            f"extrags: {expected_words(expected, at_once, processes=given.runner != 'threads')}",
            file=sys.stderr,
        )
    from flows.dataset import reconstruct_dataset
    from flows.estimate import expected_seconds
    from flows.progress_display import RunInView, progress_display
    from flows.workloads import expected_work

    # Names were checked by the parser; flows have literals for them.
    arguments: dict[str, Any] = {
        "sequences": absolute_manifests(sequences),
        "profile": given.profile,
        "settings": given.settings,
        "store": root,
        "refresh": refresh,
        "until": until,
        "runner": given.runner,
        "at_once": at_once,
        "method": several.methods[0],
        "methods": list(several.methods) if len(several.methods) > 1 else None,
        "seed": several.seeds[0],
        "seeds": list(several.seeds) if len(several.seeds) > 1 else None,
        "matrix": dict(several.matrix) or None,
        "only": several.only,
        "limits": stage_limits(given),
    }
    first_config = cases[0].config()
    expected_of = expected_seconds(first_config, expected_work(cases[0].sequence, first_config))
    view = RunInView(len(cases), expected_of, until, root)
    with temporary_server(), without_heartbeat(), progress_display(showing(given), view):
        try:
            outcome: DatasetOutcome = reconstruct_dataset(**arguments)
        except DatasetFailedError as error:
            # Said to Prefect; here each sequence is reported, and the exit code is 1 if any failed.
            outcome = error.outcome
    return _raised(outcome, given)


def _raised(outcome: DatasetOutcome, given: argparse.Namespace) -> DatasetOutcome:
    """The outcome; with `--debug` the first error in it is raised instead, for its traceback."""
    if given.debug:
        for sequence in outcome.sequences:
            if sequence.error is not None:
                raise sequence.error
    return outcome


def _check_working_distance(cases: Sequence[SequenceCase]) -> None:
    """Refuse `poses.working_distance_mm` where no poses are estimated, and warn where some are not.

    Only the poses stage looks at it, which sources with poses of their own skip.

    Raises:
        ConfigError: every sequence that it is given for has poses.
    """
    from data_catalog import describe, glance

    given, posed = set(), []
    for case in cases:
        config = case.config()
        if config.poses.working_distance_mm is None or config.poses.replace_given or case.sequence in given:
            continue
        given.add(case.sequence)
        try:
            about = glance(case.sequence, config.ingest) or describe(case.sequence)
        except (ConfigError, SourceError, UnknownSequenceError):
            # What is wrong with a source is said by the run, for each by itself.
            continue
        if about.has_poses:
            posed.append(case.sequence)
    if not posed:
        return
    first = posed[0] if len(posed) == 1 else f"{posed[0]} and {len(posed) - 1} more"
    problem = (
        f"{first}: poses.working_distance_mm makes estimated poses metric, and these are the source's own; "
        "ingest.scale_mm_per_unit (--scale) says what their unit is where it is arbitrary, and "
        "poses.replace_given estimates others in their place"
    )
    if len(posed) == len(given):
        raise ConfigError(problem)
    log.warning("%s", problem)


def _wrong_source(case: SequenceCase, until: StageName) -> SequenceOutcome | None:
    """How a run would fail whose source can be seen to be wrong without reading pictures; else None."""
    from data_catalog import glance
    from data_catalog.names import plain_name
    from extrags.stages import stages_until

    try:
        glance(case.sequence, case.config().ingest)
    except SourceError as error:
        rest = stages_until(until)[1:]
        rows = [StageRow("ingest", "failed", reason=str(error))]
        rows += [StageRow(stage, "skipped", reason="ingest failed") for stage in rest]
        return SequenceOutcome(plain_name(case.sequence), "failed", rows, error=error)
    return None


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
    cases: Sequence[SequenceCase], root: str, until: StageName, *, several_seeds: bool = False
) -> DatasetOutcome | None:
    """Outcomes from the store alone; None as soon as anything is missing or wrong.

    They are left on record as those of a flow run are.
    """
    from extrags.store import Store
    from flows.methods import METHODS, profile_label
    from flows.pages import dataset_page
    from flows.runners import NotInStoreError, StoreRunner
    from flows.wiring import run_sequence
    from tasks.progress import observed

    def ignore(_: object) -> None:
        """Looking is no progress."""

    runner = StoreRunner(root)
    outcomes = []
    try:
        with observed(ignore):
            for case in cases:
                outcome = run_sequence(
                    case.sequence,
                    case.config(),
                    root,
                    runner,
                    profile=profile_label(case.profile, case.method),
                    until=until,
                    leave_out=METHODS[case.method].leave_out,
                )
                if outcome.status == "failed":
                    return None
                outcome.variant = case.variant
                outcome.seed = case.seed if several_seeds else None
                outcomes.append(outcome)
            label = profile_label(cases[0].profile, ", ".join(dict.fromkeys(case.method for case in cases)))
            page = None
            if until == "report":
                given = [case.settings for case in cases]
                page = dataset_page(outcomes, given, "dataset", label, Store(root), runner)
    except (NotInStoreError, DamagedArtefactError):
        return None
    for case, outcome in zip(cases, outcomes, strict=True):
        _record(case, outcome, root, until)
    return DatasetOutcome(outcomes, page)


def _record(case: SequenceCase, outcome: SequenceOutcome, root: str, until: StageName) -> None:
    """Leave on record how a run ended and what it used, if the store can be written."""
    from extrags.store import Store
    from extrags.store.runs import recorded_run
    from flows.cases import record_outcome_quietly

    store = Store(root)
    with recorded_run(store, case.sequence) as used:
        if used is not None:
            used.add(key for row in outcome.stages for key in row.made)
    record_outcome_quietly(store, case, outcome, until, case.config())


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
