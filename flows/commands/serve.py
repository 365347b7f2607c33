"""`serve`: all deployments on this machine, in one process, without a work pool."""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from extrags.errors import ConfigError
from extrags.user_paths import expanded
from flows.commands.common import set_up_logging, store_root
from flows.commands.options import Parser, add_store
from flows.interruption import say_when_interrupted

if TYPE_CHECKING:
    from prefect.client.schemas.actions import DeploymentScheduleCreate
    from prefect.client.schemas.objects import ConcurrencyLimitConfig

    from flows.deployments import Declared

__all__ = ["add_arguments", "serve"]

ENDED = "nothing is served any more; runs that were going on are interrupted, and what they finished is kept"
PAUSED = f"{ENDED}; schedules are paused"
REASON_LETTERS = 300
"""Of what the server says about a deployment that it refuses."""


def add_arguments(parser: Parser) -> None:
    """The options of `extrags serve`."""
    parser.description = (
        "Register the deployments of prefect.yaml with the Prefect server at PREFECT_API_URL, and run what "
        "is asked of them, each run in a process of its own. For one machine: no work pool, no worker."
    )
    parser.set_defaults(command=serve)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="deployments to serve: FLOW/NAME, e.g. benchmark/weekly, or NAME where only one is called so "
        "(default: all)",
    )
    parser.add_argument("--file", metavar="FILE", help="where they are declared (default: those of extrags)")
    parser.add_argument(
        "--limit", type=int, default=1, metavar="N", help="runs at the same time (default: %(default)s)"
    )
    parser.add_argument(
        "--schedules", action="store_true", help="run them on their schedules, too; else on demand alone"
    )
    add_store(parser)


def serve(given: argparse.Namespace) -> int:
    """`extrags serve`; returns when it is interrupted.

    Raises:
        ConfigError: without a server, for an unknown or ambiguous name, a file that is wrong, or a deployment
            that the server refuses.
    """
    from flows.deployments import chosen_deployments, declared_deployments, usual_file

    if given.limit < 1:
        raise ConfigError(f"--limit is {given.limit}; expected 1 or more")
    declared = declared_deployments(expanded(given.file) if given.file else usual_file())
    set_up_logging(debug=given.debug, terminal=False)
    # Runs are processes with another working directory: what they find by is absolute.
    if given.store or os.environ.get("EXTRAGS_STORE"):
        os.environ["EXTRAGS_STORE"] = store_root(given)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Loads the flows, where names alone do not decide.
    chosen = chosen_deployments(declared, given.names)
    from prefect import serve as prefect_serve
    from prefect.settings import PREFECT_API_URL

    if not PREFECT_API_URL.value():
        raise ConfigError(
            "extrags serve needs a Prefect server that lasts: start one (prefect server start), and set "
            "PREFECT_API_URL to its address, http://127.0.0.1:4200/api"
        )
    made = [_deployment(item, schedules=given.schedules) for item in chosen]
    _register(chosen, made, pause=given.schedules)
    say_when_interrupted(PAUSED if given.schedules else ENDED)
    # Prefect's handler of SIGTERM asks its runner to stop, and ends before that is awaited.
    warnings.filterwarnings("ignore", message="coroutine 'Runner.astop' was never awaited")
    prefect_serve(
        *made,
        limit=given.limit,
        # Schedules are as this command says, whatever they were before.
        pause_on_shutdown=given.schedules,
    )
    return 0


def _register(chosen: Sequence[Declared], made: Sequence[Any], *, pause: bool) -> None:
    """Register all deployments, or leave none of them on its schedule.

    Prefect does it again when it serves them, and one by one: those before one that is refused stay active.

    Args:
        chosen: as they are declared.
        made: what Prefect calls them.
        pause: those that are registered, where one is refused.

    Raises:
        ConfigError: for one that the server refuses.
    """
    import httpx
    from prefect.client.orchestration import get_client
    from prefect.deployments.runner import DeploymentApplyError

    registered = []
    for declared, item in zip(chosen, made, strict=True):
        try:
            registered.append(item.apply())
        except DeploymentApplyError as error:
            # A server that is gone pauses nothing, and its refusal is what is to be told.
            with suppress(httpx.HTTPError), get_client(sync_client=True) as client:
                for identity in registered if pause else ():
                    client.pause_deployment(identity)
            # Prefect appends the schema of the flow, a page for each setting.
            reason = str(error).partition("\n")[0][:REASON_LETTERS]
            raise declared.error(f"the server refuses it: {reason}") from error


def _deployment(declared: Declared, *, schedules: bool) -> Any:
    from prefect.types.entrypoint import EntrypointType

    if declared.unserved:
        raise declared.error(
            f"extrags serve does not support {', '.join(declared.unserved)}; use a work pool, or leave it out"
        )
    for name, value in declared.environment.items():
        if os.environ.get(name) != value:
            raise declared.error(
                f"work_pool.job_variables.env.{name}: all runs of extrags serve have its own environment, "
                "where that has another value; set it there, or use a work pool"
            )
    concurrency, when = _concurrency(declared), _schedules(declared, active=schedules)
    return declared.flow().to_deployment(
        name=declared.name,
        schedules=when,
        parameters=declared.parameters,
        description=declared.description or None,
        tags=list(declared.tags),
        concurrency_limit=concurrency,
        # Found wherever a run's process is started, unlike a path.
        entrypoint_type=EntrypointType.MODULE_PATH,
    )


def _concurrency(declared: Declared) -> ConcurrencyLimitConfig | None:
    """How many of its runs there may be at the same time.

    Raises:
        ConfigError: for a limit that is none of Prefect's.
    """
    from prefect.client.schemas.objects import ConcurrencyLimitConfig
    from pydantic import ValidationError

    limit = declared.concurrency_limit
    unknown = sorted(set(limit).difference(ConcurrencyLimitConfig.model_fields))
    if unknown:
        raise declared.error(f"concurrency_limit.{unknown[0]} is no field of Prefect")
    try:
        return ConcurrencyLimitConfig.model_validate(limit) if limit else None
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(("concurrency_limit", *map(str, fault["loc"])))
        raise declared.error(f"{place}: {fault['msg']}") from error


def _schedules(declared: Declared, *, active: bool) -> list[DeploymentScheduleCreate]:
    """When it runs, if it has a schedule.

    Raises:
        ConfigError: for times or a time zone that are none.
    """
    from prefect.client.schemas.actions import DeploymentScheduleCreate
    from prefect.client.schemas.schedules import CronSchedule
    from pydantic import ValidationError

    if declared.cron is None:
        return []
    try:
        cron = CronSchedule(cron=declared.cron, timezone=declared.timezone)
    except ValidationError as error:
        raise declared.error(f"schedules: {error.errors()[0]['msg']}") from error
    return [DeploymentScheduleCreate(schedule=cron, active=active)]
