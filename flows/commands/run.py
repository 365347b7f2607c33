"""`run`: sequences through all stages."""

from __future__ import annotations

import argparse
import json
import os
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
)
from flows.commands.common import (
    is_terminal,
    items,
    run_config,
    set_up_logging,
    showing,
    stage_limits,
    store_root,
    write_json,
)
from flows.commands.options import (
    MISSING,
    Parser,
    add_json,
    add_method,
    add_runner,
    add_sequences,
    add_stages,
    number_above_zero,
    words_taken_by,
)
from flows.commands.run_checks import check_names, check_working_distance, wrong_source
from flows.failures import describe_error
from flows.interruption import RESUMABLE, say_when_interrupted
from flows.outcome import DatasetFailedError, DatasetOutcome, SequenceOutcome, failed_outcome
from flows.printable import in_one_line

if TYPE_CHECKING:
    from extrags.stages import StageName
    from flows.cases import SequenceCase
    from flows.selection import Chosen

__all__ = ["Several", "add_arguments", "execute", "parsed_matrix", "parsed_methods", "run"]


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
        type=number_above_zero,
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
        several = next((f"--{name}" for name in ("methods", "seeds") if getattr(given, name)), None)
        taken = "" if several is None else words_taken_by(several)
        raise ConfigError(f"{MISSING}SEQUENCE or --manifest FILE{taken} (see extrags run --help)")
    if given.seeds and given.seed is not None:
        raise ConfigError("--seeds replaces --seed: give one of the two")
    if given.methods and getattr(given, "said_method", False):
        raise ConfigError("--methods replaces --method: give one of the two")
    matrix = parsed_matrix(given.matrix)
    for name in matrix:
        if name in getattr(given, "said_settings", {}):
            raise ConfigError(f"--matrix {name} replaces --{name} and --set: give one of them")
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
            matrix=matrix,
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
        print(f"extrags: {in_one_line(hint)}", file=sys.stderr)
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
    from extrags.config.settings import listed_values, settings_of, unknown_setting

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
        matrix[name] = [known[name].parse(value) for value in listed_values(values)]
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
    from flows.environment import has_own_home, prepare
    from flows.selection import absolute_manifests, chosen_sequences
    from flows.temporary_server import start_early, stop_early

    say_when_interrupted(RESUMABLE)
    set_up_logging(debug=given.debug, terminal=is_terminal(), quiet=given.quiet)
    root = store_root(given)
    several = several or Several(methods=(given.method,), seeds=(given.seed,))
    if several.methods == (given.method,):
        # Wrong usage is said before anything is made or loaded.
        run_config(given)
    # So is a misspelled name, which would leave a store with nothing in it but Prefect's home.
    chosen = chosen_sequences(sequences)
    check_names([item.name for item in chosen])
    own_home = has_own_home()
    prepare(Store(root).state, debug=given.debug, looks=True)
    always = refresh or always_flow
    finished = not always and all(_may_be_finished(root, name, until) for name in sequences)
    # Without a home the store cannot be written; that is said below where something is to be made.
    if own_home and not finished and Path(os.environ["PREFECT_HOME"]).is_dir():
        start_early()
    cases = _cases(chosen, given, several, root, until)
    try:
        found = _without_flow(cases, root, until, always=always, several_seeds=len(several.seeds) > 1)
    except ConfigError:
        stop_early()
        raise
    if found is not None:
        stop_early()
        return found
    # The flow looks as well; here it is said without waiting for a server, which writes into the store.
    Store(root).check_writable()
    if own_home:
        start_early()
    refused = wrong_source(cases[0], until) if len(cases) == 1 else None
    if refused is not None:
        stop_early()
        _record(cases[0], refused, root, until)
        return _raised(DatasetOutcome([refused]), given)
    from flows.preflight import preflight_cases

    try:
        preflight_cases(cases, until)
    except ConfigError:
        raise  # Wrong usage is no run.
    except ExtragsError as error:
        if len(cases) == 1:
            _record(cases[0], failed_outcome(cases[0].sequence, str(error), error), root, until)
        raise

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
    return _raised(_in_a_flow(cases, given, arguments), given)


def _cases(
    chosen: Sequence[Chosen], given: argparse.Namespace, several: Several, root: str, until: StageName
) -> list[SequenceCase]:
    """What is to be run: every combination of sequences and of what makes several runs of one.

    Raises:
        ConfigError: for wrong settings.
        StoreError: when the store cannot be read.
    """
    from flows.cases import cases_of, selected

    every = cases_of(
        chosen,
        methods=several.methods,
        profile=given.profile,
        seeds=several.seeds,
        settings=given.settings,
        matrix=several.matrix,
    )
    return selected(every, several.only, root, until)


def _without_flow(
    cases: Sequence[SequenceCase], root: str, until: StageName, *, always: bool, several_seeds: bool
) -> DatasetOutcome | None:
    """The outcome where there is nothing to make, so that nobody waits for a server; None where there is.

    Raises:
        ConfigError: see `check_working_distance`.
    """
    if not cases:
        return DatasetOutcome([])
    check_working_distance(cases)
    return None if always else _from_store(cases, root, until, several_seeds=several_seeds)


def _in_a_flow(
    cases: Sequence[SequenceCase], given: argparse.Namespace, arguments: dict[str, Any]
) -> DatasetOutcome:
    """Run the cases in a flow run, and show how far it is.

    Args:
        cases: what the flow will run.
        given: the command line.
        arguments: of `flows.dataset.reconstruct_dataset`.
    """
    from flows.environment import without_heartbeat
    from flows.expectation import expectations, expected_words

    root, until, at_once = arguments["store"], arguments["until"], arguments["at_once"]
    if is_terminal() and not given.quiet and len(cases) > 1:
        # Elsewhere it is a line of the log.
        expected = expectations(cases, root, until, refresh=arguments["refresh"])
        print(
            f"extrags: {expected_words(expected, at_once, processes=given.runner != 'threads')}",
            file=sys.stderr,
        )
    from flows.dataset import reconstruct_dataset
    from flows.estimate import expected_seconds
    from flows.progress_display import RunInView, progress_display
    from flows.temporary_server import temporary_server
    from flows.workloads import expected_work

    config = cases[0].config()
    view = RunInView(
        len(cases), expected_seconds(config, expected_work(cases[0].sequence, config)), until, root
    )
    with temporary_server(), without_heartbeat(), progress_display(showing(given), view):
        try:
            outcome: DatasetOutcome = reconstruct_dataset(**arguments)
        except DatasetFailedError as error:
            # Said to Prefect; here each sequence is reported, and the exit code is 1 if any failed.
            outcome = error.outcome
    return outcome


def _raised(outcome: DatasetOutcome, given: argparse.Namespace) -> DatasetOutcome:
    """The outcome; with `--debug` the first error in it is raised instead, for its traceback."""
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
    from data_catalog.names import path_of
    from extrags.store import Store
    from extrags.store.runs import recorded_run
    from flows.cases import record_outcome_quietly

    store = Store(root)
    with recorded_run(store, case.sequence, place=path_of(case.sequence) or "") as used:
        if used is not None:
            used.add(key for row in outcome.stages for key in row.made)
    record_outcome_quietly(store, case, outcome, until, case.config())
