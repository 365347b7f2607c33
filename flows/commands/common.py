"""What verbs share: settings from the command line, a finished run, JSON out, the log.

Nothing heavy is imported here: every verb loads this module before its options are known.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO, TypeVar

from extrags.errors import ConfigError, ExtragsError, StoreError
from extrags.redaction import CredentialFilter, without_credentials
from extrags.user_paths import expanded
from flows.commands.outputs import STANDARD_OUTPUT, write_output
from flows.printable import PrintableFormatter

if TYPE_CHECKING:
    from extrags.config import PipelineConfig
    from extrags.config.base import StageConfig
    from extrags.stages import StageName
    from extrags.store import Store
    from flows.limits import StageLimits
    from flows.outcome_records import OutcomeRecord
    from flows.wiring import SequenceRun

__all__ = [
    "StandardErrorHandler",
    "counted",
    "existing_store",
    "finished_run",
    "further_settings",
    "is_terminal",
    "items",
    "parsed_settings",
    "run_config",
    "run_options",
    "set_up_logging",
    "showing",
    "stage_limits",
    "store_root",
    "training_settings",
    "without_folders",
    "write_json",
    "write_page",
]

DEFAULT_METHOD = "extrags"

Settings = TypeVar("Settings", bound="StageConfig")


def parsed_settings(assignments: list[str]) -> dict[str, Any]:
    """`["coarse.iterations=500"]` to `{"coarse.iterations": 500}`; values are JSON or YAML.

    Raises:
        ConfigError: for an assignment without `=`, or a value that is no YAML.
    """
    settings: dict[str, Any] = {}
    for assignment in assignments:
        name, separator, text = assignment.partition("=")
        if not separator or not name:
            raise ConfigError(f"--set {assignment}: expected NAME=VALUE, e.g. coarse.iterations=500")
        settings[name.strip()] = _value(assignment, text)
    return settings


def _value(assignment: str, text: str) -> Any:
    try:
        # First, because YAML takes 1e-3 for a word.
        return json.loads(text)
    except ValueError:
        pass
    from extrags.yaml_text import read_yaml

    try:
        return read_yaml(text)
    except ValueError as error:
        raise ConfigError(f"--set {assignment}: the value is neither JSON nor YAML") from error


def items(given: list[str]) -> list[str]:
    """`["a,b", "c"]` to `["a", "b", "c"]`."""
    return [item for text in given for item in text.split(",") if item]


def counted(number: int, noun: str) -> str:
    """`1 run`, `2 runs`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def run_config(given: argparse.Namespace) -> PipelineConfig:
    """The settings of a run: its profile, then the seed, then what the command line overrides.

    Raises:
        ConfigError: for an unknown setting, a value out of range, or one that the method sets itself.
    """
    from flows.methods import check_not_pinned, method_config

    check_not_pinned(given.method, given.settings)
    return method_config(given.method, given.profile, given.settings, given.seed)


def existing_store(given: argparse.Namespace) -> Store:
    """The store of `--store`, for verbs that only look: they make none.

    Raises:
        StoreError: when there is none.
    """
    from extrags.store import Store

    store = Store(store_root(given))
    if not store.exists():
        raise StoreError(f"there is no store {store.root}")
    return store


def finished_run(
    given: argparse.Namespace, until: StageName, otherwise: str = "", coarse_by: str = ""
) -> SequenceRun:
    """A run that is in the store up to a stage, with the refs of what it made.

    Args:
        given: a verb's arguments: `sequence`, `method`, `profile`, `settings`, `seed`, `store`, `debug`.
        until: the last stage that is needed.
        otherwise: what else may be done where the run is not there, for the message.
        coarse_by: the option that takes the coarse scene, named where only that one is there.

    Raises:
        StoreError: when it is not in the store.
        ExtragsError: what made a stage fail that was looked up.
    """
    from extrags.store import Store
    from flows.environment import prepare

    root, config = store_root(given), run_config(given)
    missing = f"{given.sequence} with these settings is not finished in {root}; run it first{otherwise}"
    if not Store(root).exists():
        raise StoreError(f"{missing} (there is no such store)")
    prepare(Store(root).state, debug=given.debug, looks=True)
    from flows.methods import METHODS, profile_label
    from flows.runners import NotInStoreError, StoreRunner
    from flows.wiring import SequenceRun

    run = SequenceRun(
        given.sequence,
        config,
        root,
        StoreRunner(root),
        profile_label(given.profile, given.method),
        leave_out=METHODS[given.method].leave_out,
    )
    try:
        outcome = run.run(until)
    except NotInStoreError as error:
        if coarse_by and "coarse" in run.refs:
            missing += f", or take its coarse scene, which is there, with {coarse_by}"
        raise StoreError(f"{missing} ({error}){_on_record(root, given.sequence)}") from error
    if outcome.status == "failed":
        raise outcome.error or ExtragsError(f"{outcome.name} failed")
    return run


def _on_record(root: str, sequence: str) -> str:
    """What settings finished runs of a sequence had, for who has left some out; empty without such runs."""
    from data_catalog.names import comparable_name
    from extrags.store import Store
    from flows.outcome_records import outcome_records

    wanted = comparable_name(sequence)
    found = [
        record
        for record in sorted(outcome_records(Store(root)).values(), key=lambda item: str(item["ended"]))
        if comparable_name(str(record["sequence"])) == wanted
        and record["status"] == "ok"
        and record.get("report")
    ]
    if not found:
        return ""
    had = dict.fromkeys(_profile_method_and_seed(record) for record in found)
    # Records of earlier versions do not know the settings.
    last = f"; the last one had{run_options(found[-1])}" if "settings" in found[-1] else ""
    return f". Finished runs of it had {', '.join(had)}: give the same, and the same further settings{last}"


def _profile_method_and_seed(run: OutcomeRecord) -> str:
    method = "" if run["method"] == DEFAULT_METHOD else f" --method {run['method']}"
    seed = "" if run["seed"] is None else f" --seed {run['seed']}"
    return f"--profile {run['profile']}{method}{seed}"


def run_options(run: OutcomeRecord, *, elsewhere: bool = False) -> str:
    """The options that a run on record had, as a command line takes them, with a space before each.

    Args:
        run: its record.
        elsewhere: for another machine: of paths that this one alone knows, their last part.
    """
    settings = {**run.get("settings", {}), **run["variant"]}
    more = "".join(
        f" --set {shlex.quote(_assignment(name, value, elsewhere))}" for name, value in settings.items()
    )
    return f" {_profile_method_and_seed(run)}{more}"


def _assignment(name: str, value: Any, elsewhere: bool) -> str:
    """A setting as `--set` reads it: words have no quotes unless they would be read as something else."""
    if isinstance(value, str):
        value = without_folders(value) if elsewhere else value
        if parsed_settings([f"{name}={value}"])[name] == value:
            return f"{name}={value}"
    return f"{name}={json.dumps(value)}"


def without_folders(text: str) -> str:
    """A name, or a path; of one that this machine alone knows its last part."""
    return Path(text).name if Path(text).is_absolute() else text


def stage_limits(given: argparse.Namespace) -> StageLimits:
    """Retries and limits of time and memory from the command line; loads Prefect."""
    from flows.limits import StageLimits

    return StageLimits(
        retries=given.retries,
        time_limit_s=given.stage_time_limit,
        memory_gb=getattr(given, "memory_limit", None),
    )


def store_root(given: argparse.Namespace) -> str:
    """Root of the store as an absolute path or a URL."""
    from flows.settings import default_store

    root: str = given.store or default_store()
    return root if "://" in root else str(expanded(root).absolute())


def write_json(value: Any, target: str | None) -> None:
    """Write to a file, or to standard output for `-`; nothing for None.

    Raises:
        StoreError: when the file cannot be written.
    """
    if target is None:
        return
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    if target == STANDARD_OUTPUT:
        sys.stdout.write(text)
    else:
        write_output(target, text)


def write_page(page: str, target: str) -> str:
    """Write an HTML page; the absolute path of the file.

    Raises:
        StoreError: when it cannot be written.
    """
    write_output(target, without_credentials(page))
    return str(Path(target).absolute())


def set_up_logging(*, debug: bool, terminal: bool, quiet: bool = False) -> None:
    """Log lines to standard error: everything with `debug`, errors alone when quiet.

    Progress goes there where there is no terminal.
    """
    level = logging.ERROR if quiet else logging.WARNING if terminal else logging.INFO
    if debug:
        level = logging.INFO
    handler = StandardErrorHandler()
    # The handler's as well as the loggers': a run on a lasting server sends more to its log than is shown.
    handler.setLevel(level)
    handler.addFilter(CredentialFilter())
    handler.setFormatter(PrintableFormatter("%(asctime)s %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=level, handlers=[handler])
    for noisy in ("httpx", "httpcore", "prefect", "distributed", "distributed.scheduler", "asyncio"):
        logging.getLogger(noisy).setLevel(logging.WARNING if debug else logging.CRITICAL)


class StandardErrorHandler(logging.StreamHandler[TextIO]):
    """Writes to what standard error is at the time: the display of a run must know of each line.

    Prefect takes the place of handlers whose name begins with an underscore.
    """

    def __init__(self) -> None:
        logging.Handler.__init__(self)

    @property
    def stream(self) -> TextIO:  # type: ignore[override]
        """Standard error."""
        return sys.stderr


def is_terminal() -> bool:
    """Whether standard error goes to a terminal that can draw over what it shows; others get lines."""
    return sys.stderr.isatty() and os.environ.get("TERM", "").lower() not in ("dumb", "unknown")


def showing(given: argparse.Namespace) -> Literal["terminal", "log", "nothing"]:
    """Where the progress of a run goes: see `flows.progress_display`."""
    if given.quiet:
        return "nothing"
    return "terminal" if is_terminal() else "log"


def further_settings(texts: Sequence[str], model: type[StageConfig]) -> dict[str, Any]:
    """Settings of a training given as NAME=VALUE.

    Args:
        texts: of the command line.
        model: of the training's settings.

    Raises:
        ConfigError: for an unknown name, or a value that is none of its kind.
    """
    from extrags.config.settings import settings_of

    known = settings_of(model)
    found: dict[str, Any] = {}
    for text in texts:
        name, separator, value = text.partition("=")
        if not separator or name not in known:
            raise ConfigError(f"--set {text}: expected NAME=VALUE with one of {', '.join(sorted(known))}")
        found[name] = known[name].parse(value)
    return found


def training_settings(
    given: argparse.Namespace, model: type[Settings], names: Sequence[str], command: str
) -> Settings:
    """Settings of a training: those that have an option of their own, and those that `--set` gives.

    Args:
        given: the command line; an option that is None keeps the default.
        model: of the training's settings.
        names: of the options.
        command: named in errors.

    Raises:
        ConfigError: for an unknown setting, or a value out of its range.
    """
    from pydantic import ValidationError

    from extrags.config.settings import refused_settings, settings_of

    values = {name: getattr(given, name) for name in names if getattr(given, name) is not None}
    values |= further_settings(given.set, model)
    try:
        return model(**values)
    except ValidationError as error:
        raise ConfigError(f"{command}: {refused_settings(error, settings_of(model), values)}") from error
