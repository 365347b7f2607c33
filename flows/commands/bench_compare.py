"""`bench compare`: a regression told from noise."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError, reason_of
from flows.commands.common import write_json
from flows.commands.options import Parser, add_json

__all__ = ["NOT_JUDGED", "add_arguments", "compare"]

NOT_JUDGED = 3
"""Exit code where something seems worse that could not be judged: neither all well nor a regression."""


def add_arguments(parser: Parser) -> None:
    """The options of `extrags bench compare`."""
    parser.description = (
        "Compare two results of `bench pipeline` or `benchmark`: pairs of runs with the same seed and repeat "
        "where there are such, else the two samples. A difference is a regression when it matters (costs "
        "5 %, 0.1 dB, other figures 1 %) and is beyond noise (t test with the noise of all sequences and "
        "methods, Holm's correction, 5 %; times also beyond what a machine's speed changes between two "
        "sittings); it takes two or more seeds, or several sequences, or repeats for costs. Times and "
        "memory are judged on one kind of machine only, figures by one version of the evaluation protocol "
        "only. "
        "Exit code 1 on a regression, or when runs fail that did not, or runs or figures are gone; "
        f"{NOT_JUDGED} when nothing is, but seeds are too few to judge what seems worse."
    )
    parser.add_argument("before", type=Path, metavar="A.json", help="the reference")
    parser.add_argument("after", type=Path, metavar="B.json", help="what is judged")
    parser.add_argument("--all", action="store_true", help="show what is noise or equal as well")
    add_json(parser)


def compare(given: argparse.Namespace) -> int:
    """`extrags bench compare`; exit code 1 on a regression, `NOT_JUDGED` where it could not be told."""
    from extrags.metrics.regression import compare_results

    found = compare_results(_read(given.before), _read(given.after))
    if given.json != "-":
        _print(found, every=given.all)
    write_json(found, given.json)
    return 1 if found["regressions"] else NOT_JUDGED if found["not_judged"] else 0


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {reason_of(error)}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is no JSON that can be read: {error}") from error
    if not isinstance(found, dict):
        raise ConfigError(f"{path} is no result of a benchmark: expected a JSON object")
    return found


def _print(found: dict[str, Any], *, every: bool) -> None:
    from rich.markup import escape
    from rich.table import Table

    from flows.terminal import console, print_table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("sequence", "method", "budget", "quantity", "before", "after", "worse by", "n", "verdict"):
        table.add_column(name)
    counts: dict[str, int] = {}
    for row in found["rows"]:
        counts[row["verdict"]] = counts.get(row["verdict"], 0) + 1
        if row["verdict"] in ("worse", "better") or every:
            name = f"{row['sequence']}@{row['setting']}" if row["setting"] else row["sequence"] or "all"
            changes = {"dB": "{:+.2f} dB", "share": "{:+.1%}", "absolute": "{:+.4g}"}
            change = changes[row["unit"]].format(row["worsening"])
            table.add_row(
                escape(name),
                escape(row["method"]),
                escape(row["budget"] or ""),
                row["quantity"],
                f"{row['before']:.4g}",
                f"{row['after']:.4g}",
                change,
                f"{row['n']}{'' if row['paired'] else ' unpaired'}",
                row["verdict"],
            )
    out = console()
    if table.rows:
        print_table(out, table)
    for line in (*found["failed"], *found["missing"]):
        out.print(line, markup=False, soft_wrap=True)
    for line in found["other_settings"]:
        out.print(line, markup=False, soft_wrap=True)
    if not found["times_judged"]:
        out.print("times and memory are not judged: the results are of different machines")
    elif not found["memory_judged"]:
        out.print("memory is not judged: runs shared stages in one of the results only", soft_wrap=True)
    before, after = found["protocols"]
    if None not in (before, after) and before != after:
        out.print(
            f"figures are not judged: they are of versions {before} and {after} of the evaluation protocol",
            soft_wrap=True,
        )
    told = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    out.print(f"compared: {told}", soft_wrap=True)
    for line in found["not_judged"]:
        out.print(f"not judged: {line}", markup=False, soft_wrap=True)
    if counts.get("not judged"):
        out.print(
            "not judged: too few seeds to tell a change of ten times what matters from noise; measure more "
            "--seeds, or --repeats for costs",
            soft_wrap=True,
        )
