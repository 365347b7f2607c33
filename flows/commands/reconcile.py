"""`reconcile`: the ends of runs that could not tell them."""

from __future__ import annotations

import argparse
import time

from extrags.errors import ConfigError
from flows.commands.common import set_up_logging, store_root
from flows.commands.options import Parser, add_store
from flows.printable import in_one_line

__all__ = ["add_arguments", "reconcile"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags reconcile`."""
    parser.description = (
        "After a power loss: set flow runs that are still Running on the Prefect server, but whose process "
        "is gone, to Crashed, and have the server itself do so from now on, with an automation. Every run "
        "does the former when it starts. A run that lives is never touched."
    )
    parser.set_defaults(command=reconcile)
    add_store(parser)
    parser.add_argument(
        "--wait",
        action="store_true",
        help="judge runs of other machines as well: look again after the time in which each run that lives "
        "must have sent a heartbeat (5 minutes)",
    )


def reconcile(given: argparse.Namespace) -> int:
    """`extrags reconcile`."""
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    from prefect.settings import PREFECT_API_URL

    from flows.automation import NAME, provide_automation
    from flows.leases import second_look_seconds, settle_dead_runs

    if not PREFECT_API_URL.value():
        raise ConfigError("no Prefect server is known; set PREFECT_API_URL")
    print(f"automation {NAME!r}: {provide_automation()}")
    root = store_root(given)
    settled, missing = settle_dead_runs(root)
    if missing and given.wait:
        time.sleep(second_look_seconds())
        more, missing = settle_dead_runs(root, frozenset(missing))
        settled += more
    for run in settled:
        print(f"{in_one_line(run.name)} ({run.id}): Crashed")
    for run_id in sorted(missing, key=str):
        print(f"{run_id}: misses its heartbeats; --wait looks again")
    if not settled and not missing:
        print("all runs are as the server has them")
    return 0
