"""`bench pipeline`: run time against error of whole runs, over methods and budgets."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from extrags.output_files import write_file
from flows.commands.benchmark import parsed_seeds
from flows.commands.common import items, set_up_logging, write_json
from flows.commands.options import Parser, add_json, add_methods, add_output, add_sequences, add_settings
from flows.commands.outputs import output_folder
from flows.commands.run_checks import check_names
from flows.interruption import RESUMABLE, say_when_interrupted

__all__ = ["EXAMPLES", "add_arguments", "pipeline"]

EXAMPLES = """examples:
  extrags bench pipeline phantom/11@sparse --methods coarse,extrags --vary coarse.iterations=500,1500
  extrags bench pipeline phantom/11@sparse --budgets iterations gaussians --seeds 0,1,2 --repeats 2
  extrags bench pipeline phantom/11@sparse --profiles quick,balanced
  extrags bench pipeline phantom/11@sparse --vary ingest.width+ingest.height=120+96,160+128

--vary NAME=V,V      each value is a budget; several --vary are combined, every value with every other
--vary A+B=1+2,3+4   settings that change together, with a value for each (or one for all of them)
--budgets PRESET     one thing at a time: iterations, gaussians, views (parts and multiples of the run's),
                     size, steps, precision
A budget reaches the methods that have the stage and do not pin the setting."""


def add_arguments(parser: Parser) -> None:
    """The options of `extrags bench pipeline`."""
    from extrags.config import PROFILES
    from flows.budgets import PRESETS, SET_PRESETS

    parser.description = (
        "Run every method with every budget, measure what it costs and how good it is, and find the runs "
        "that no other beats in both. Each run is measured in a process of its own; nothing is taken from "
        "any store but the grid's, which begins empty. Called again, it goes on where it was, and runs anew "
        "what reads files that were changed. Exit code 1 when a run failed."
    )
    add_sequences(parser, chosen=True)
    add_methods(parser)
    parser.add_argument(
        "--profiles",
        nargs="+",
        default=["quick"],
        metavar="PROFILE",
        help=f"of {', '.join(PROFILES)} (default: quick)",
    )
    parser.add_argument(
        "--budgets",
        nargs="+",
        default=[],
        metavar="PRESET",
        help=f"of {', '.join((*PRESETS, *SET_PRESETS))}: see below (default: the run's settings alone)",
    )
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=V,V",
        help="values of a setting, each of them a budget: see below; repeatable",
    )
    parser.add_argument("--seeds", nargs="+", default=["0"], metavar="N", help="e.g. 0,1,2 (default: 0)")
    parser.add_argument(
        "--repeats", type=int, default=1, metavar="N", help="measure everything N times (default: 1)"
    )
    parser.add_argument(
        "--separate",
        action="store_true",
        help="do not share stages between runs (default: compute once, charge its time to each; memory "
        "is then not compared)",
    )
    add_output(
        parser,
        "DIR",
        output_folder,
        default="bench-pipeline",
        help="folder of the grid: stores, finished runs, grid.md, fronts.svg, results.json "
        "(default: bench-pipeline)",
    )
    add_settings(parser)
    add_json(parser)


def pipeline(given: argparse.Namespace) -> int:
    """`extrags bench pipeline`; exit code 1 when a run failed.

    Raises:
        ConfigError: for wrong settings, methods or manifests.
        UnknownSequenceError: for a name that is not in the catalogue, or a pattern that matches none.
    """
    say_when_interrupted(RESUMABLE)
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    # Read when torch is loaded; the processes of the runs inherit it.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if given.repeats < 1:
        raise ConfigError(f"--repeats {given.repeats}: expected 1 or more")
    from flows.environment import prepare

    folder = Path(given.output)
    prepare(folder.absolute() / "state", debug=given.debug)
    from extrags.report.fronts_plot import write_fronts_plot
    from flows.budgets import budgets_of, parsed_vary
    from flows.pipeline_grid import cells_of, run_grid
    from flows.preflight import preflight
    from flows.selection import chosen_sequences

    vary = [parsed_vary(text) for text in given.vary]
    presets, settings = items(given.budgets), given.settings or {}
    chosen = chosen_sequences(given.sequences)
    check_names([item.name for item in chosen])
    cells = cells_of(
        chosen,
        items(given.methods),
        items(given.profiles),
        lambda config: budgets_of(config, presets, vary),
        parsed_seeds(given.seeds),
        given.repeats,
        settings,
    )
    _check_models(cells, preflight)
    found = run_grid(cells, folder, separate=given.separate, settings=settings)
    text = json.dumps(found, indent=1)
    write_file(folder / "results.json", text)
    table = grid_markdown(found)
    write_file(folder / "grid.md", table)
    measured = any(cell["runs"] for cell in found["cells"])
    if measured:
        for suffix in (".svg", ".png"):
            write_fronts_plot(found, folder / f"fronts{suffix}")
    if given.json != "-":
        from flows.terminal import console

        # The console shows a line feed inside a text as such.
        for line in table.splitlines():
            console().print(line, markup=False, soft_wrap=True)
        told = f"results: {folder / 'results.json'}" + (f", {folder / 'fronts.svg'}" if measured else "")
        console().print(told, soft_wrap=True, markup=False)
    write_json(found, given.json)
    return 1 if any(case["error"] for case in found["cases"]) else 0


def _check_models(cells: Any, preflight: Any) -> None:
    """Missing models and weights are said before the first run."""
    from flows.methods import METHODS

    for cell in {(cell.method, cell.profile, cell.budget): cell for cell in cells}.values():
        preflight(cell.config(), "evaluate", METHODS[cell.method].leave_out)


def grid_markdown(found: dict[str, Any]) -> str:
    """The table of a grid: what each cell costs and how good it is, and which cells are on a front.

    Args:
        found: from `flows.pipeline_grid.run_grid`.
    """
    from extrags.metrics.registry import figures
    from extrags.report.benchmark import run_label

    shown = [
        figure
        for figure in figures("tables")
        if any(figure.name in cell["figures"] for cell in found["cells"])
    ]
    on = _front_members(found, [figure.name for figure in shown])
    header = ["sequence", "size", "method", "profile", "budget", "runs", "s", "processor s"]
    header += ["MiB" if found["separate"] else "MiB*"]
    header += [figure.label for figure in shown]
    lines = [f"| {' | '.join(header)} |", f"|{'---|' * 5}{'---:|' * (len(header) - 5)}"]
    for cell in found["cells"]:
        # What failed before it was read has no size.
        size = f"{cell['width']}x{cell['height']}" if cell["width"] else "-"
        row = [run_label(cell), size, cell["method"], cell["profile"], cell["budget"]]
        row += [str(cell["runs"]) + (f" ({cell['failed']} failed)" if cell["failed"] else "")]
        row += [_number(cell[key]) for key in ("seconds", "processor_seconds", "peak_mib")]
        for figure in shown:
            value = cell["figures"].get(figure.name)
            text = "-" if value is None else f"{value:.{figure.table_digits}f}"
            row.append(f"**{text}**" if (*_identity(cell), figure.name) in on else text)
        lines.append(f"| {' | '.join(row)} |")
    lines += ["", "Bold: on the front of this figure against processor time, within its sequence and size."]
    if not found["separate"]:
        # Stages do not give back all that they took.
        lines += ["", "*: depends on which run made what runs share; comparable with --separate alone."]
    if any(entry["left_off"] for entry in found["fronts"]):
        lines += [
            "What failed with a seed or repeat that others have is on no front: its means are of fewer runs."
        ]
    failed = [case for case in found["cases"] if case["error"]]
    lines += [""] * bool(failed)
    for case in failed:
        place = f"{case['method']}, {case['profile']}, {case['budget']}, seed {case['seed']}"
        lines.append(f"* {run_label(case)}, {place} failed: {case['error']}")
    return "\n".join(lines) + "\n"


def _front_members(found: dict[str, Any], names: list[str]) -> set[tuple[Any, ...]]:
    from extrags.metrics.fronts import SCENE

    return {
        (*(entry[key] for key in SCENE), point["method"], point["profile"], point["budget"], entry["figure"])
        for entry in found["fronts"]
        if entry["cost"] == "processor_seconds" and entry["figure"] in names
        for point in entry["front"]
    }


def _identity(cell: dict[str, Any]) -> tuple[Any, ...]:
    from extrags.metrics.fronts import CELL

    return tuple(cell[key] for key in CELL)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if value < 1000 else f"{value:.0f}"
