"""`plan`: which stages a scene needs, and why."""

from __future__ import annotations

import argparse

from extrags.errors import ConfigError, ExtragsError
from flows.commands.common import write_json
from flows.commands.options import Parser, add_json, add_method, add_runner
from flows.commands.run import execute

__all__ = ["add_arguments", "plan"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags plan`."""
    parser.set_defaults(command=plan)
    parser.add_argument("sequence", metavar="SEQUENCE")
    add_method(parser)
    add_runner(parser)
    add_json(parser)


def plan(given: argparse.Namespace) -> int:
    """`extrags plan`.

    Raises:
        ConfigError: for a method that has no plan.
    """
    from extrags.pipeline import needs_plan
    from flows.methods import METHODS

    if not needs_plan(METHODS[given.method].leave_out):
        raise ConfigError(f"no stage of the method {given.method} depends on a plan, so it has none")
    (outcome,) = execute([given.sequence], given, until="assess").sequences
    if outcome.status == "failed":
        raise outcome.error or ExtragsError(f"{outcome.name} failed")
    from flows.console import print_plan

    if given.json != "-":
        print_plan(outcome)
    write_json({"sequence": outcome.name, **(outcome.plan or {})}, given.json)
    return 0
