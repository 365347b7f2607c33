"""`benchmark`: methods compared over sequences and seeds."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from extrags.config import LARGEST_SEED, PipelineConfig
from extrags.config.settings import parsed_words, settings_of
from extrags.errors import ConfigError
from flows.commands.common import (
    is_terminal,
    items,
    parsed_settings,
    set_up_logging,
    showing,
    stage_limits,
    store_root,
    write_json,
)
from flows.commands.options import (
    Parser,
    add_json,
    add_methods,
    add_runner,
    add_sequences,
    add_settings,
    add_store,
)
from flows.commands.run_checks import check_names
from flows.interruption import RESUMABLE, say_when_interrupted

if TYPE_CHECKING:
    from rich.table import Table

    from flows.history import Tolerance

__all__ = ["add_arguments", "benchmark", "parsed_seeds", "parsed_variants", "print_benchmark"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags benchmark`."""
    parser.description = (
        "Run every method on every sequence with every seed, and compare them pair by pair. What is in the "
        "store already is taken from there with the time it took when it was made."
    )
    parser.set_defaults(command=benchmark)
    add_sequences(parser, chosen=True)
    add_methods(parser)
    parser.add_argument(
        "--variant",
        dest="variants",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "METHOD|SETTING=VALUE"),
        help="a further method: coarse, or METHOD, with other settings; repeatable",
    )
    parser.add_argument(
        "--baseline",
        metavar="METHOD",
        help="what the others are compared with (default: 3dgs where it is a method, else the first)",
    )
    parser.add_argument("--seeds", nargs="+", default=["0"], metavar="N", help="e.g. 0,1,2 (default: 0)")
    parser.add_argument(
        "--profiles", nargs="+", default=["quick"], metavar="PROFILE", help="named settings (default: quick)"
    )
    parser.add_argument("--name", default="benchmark", help="title of the page")
    parser.add_argument(
        "--refresh",
        action="store_true",
        help="recompute everything, so that times are those of now, and add them to the history in the store",
    )
    parser.add_argument(
        "--max-psnr-loss",
        type=float,
        metavar="DB",
        help="with --refresh: exit code 1 when PSNR is lower than the median of the last runs by more",
    )
    parser.add_argument(
        "--max-slowdown",
        type=float,
        metavar="SHARE",
        help="with --refresh: exit code 1 when run time is longer than the median of the last runs by more, "
        "and by more than 5 s",
    )
    add_settings(parser)
    add_store(parser)
    add_runner(parser)
    add_json(parser)


def benchmark(given: argparse.Namespace) -> int:
    """`extrags benchmark`; exit code 1 when a run failed, or is worse than is tolerated.

    Raises:
        ConfigError: for wrong settings, methods or manifests.
        UnknownSequenceError: for a name that is not in the catalogue, or a pattern that matches none.
    """
    from extrags.config import profile_config
    from extrags.store import Store
    from flows.environment import has_own_home, prepare, without_heartbeat

    say_when_interrupted(RESUMABLE)
    terminal = is_terminal()
    set_up_logging(debug=given.debug, terminal=terminal, quiet=given.quiet)
    root = store_root(given)
    # Any: the flow wants the literal names, which are looked at below.
    methods: Any = items(given.methods)
    profiles: Any = items(given.profiles)
    seeds = parsed_seeds(given.seeds)
    variants = parsed_variants(given.variants)
    own_home = has_own_home()
    prepare(Store(root).state, debug=given.debug)
    from flows.benchmark import benchmark as flow
    from flows.benchmark import check_methods, check_repetitions
    from flows.estimate import expected_seconds
    from flows.history import BenchmarkRegressedError
    from flows.outcome import BenchmarkFailedError
    from flows.progress_display import RunInView, progress_display
    from flows.selection import absolute_manifests, chosen_sequences
    from flows.settings import task_runner
    from flows.temporary_server import start_early, temporary_server

    limits = stage_limits(given)

    # Prefect would say the same in a page of its own words.
    check_methods(methods, variants, given.baseline)
    check_repetitions(profiles, seeds)
    for profile in profiles:
        profile_config(profile)
    ways = len(profiles) * len(seeds) * (len(methods) + len(variants))
    chosen = chosen_sequences(given.sequences)
    # Each of its runs would fail, and with --refresh be on record in the history.
    check_names([item.name for item in chosen])
    view = RunInView(len(chosen) * ways, expected_seconds(profile_config(profiles[0])), "evaluate", root)
    if own_home:
        start_early()
    with temporary_server(), without_heartbeat(), progress_display(showing(given), view):
        measure = flow.with_options(task_runner=task_runner(given.runner))
        try:
            found = measure(
                sequences=absolute_manifests(given.sequences),
                profiles=profiles,
                methods=methods,
                seeds=seeds,
                settings=given.settings,
                variants=variants,
                baseline=given.baseline,
                store=root,
                name=given.name,
                limits=limits,
                refresh=given.refresh,
                tolerance=_tolerance(given),
            )
        except (BenchmarkFailedError, BenchmarkRegressedError) as error:
            # Said to Prefect; here what was measured is told, and the exit code is 1.
            found = error.result
    print_benchmark(found, to_stderr=given.json == "-")
    write_json(found, given.json)
    return 1 if found["regressions"] or any(case["error"] for case in found["cases"]) else 0


def _tolerance(given: argparse.Namespace) -> Tolerance | None:
    """What the command line tolerates; None where it asks for no judgement.

    Raises:
        ConfigError: for a negative one, or one without `--refresh`.
    """
    from flows.history import Tolerance

    # What has no limit of its own is not judged.
    limits = {"psnr_db": given.max_psnr_loss, "seconds_share": given.max_slowdown}
    if all(value is None for value in limits.values()):
        return None
    if not given.refresh:
        raise ConfigError("--max-psnr-loss and --max-slowdown need --refresh")
    if any(value is not None and not value >= 0 for value in limits.values()):
        raise ConfigError("--max-psnr-loss and --max-slowdown: expected 0 or more")
    return Tolerance(**limits)


def parsed_seeds(given: list[str]) -> list[int]:
    """`["0,1", "2"]` to `[0, 1, 2]`.

    Raises:
        ConfigError: for anything but whole numbers from 0 to `LARGEST_SEED`, or a seed that is given twice.
    """
    texts = items(given)
    for text in texts:
        if not text.isdecimal():
            raise ConfigError(f"--seeds {text}: expected whole numbers from 0, e.g. --seeds 0,1,2")
    seeds = [int(text) for text in texts]
    if seeds and max(seeds) > LARGEST_SEED:
        raise ConfigError(f"--seeds {max(seeds)}: expected 0 to {LARGEST_SEED} (2^63 - 1)")
    if not seeds or len(set(seeds)) != len(seeds):
        raise ConfigError(f"--seeds {','.join(texts)}: expected one or more different seeds")
    return seeds


def parsed_variants(given: list[list[str]]) -> dict[str, dict[str, Any]]:
    """`[["dim", "coarse", "coarse.light.exponent=1"]]` to `{"dim": {"method": ..., "coarse...": 1}}`.

    Raises:
        ConfigError: for a variant without settings, a wrong value, or a name that is given twice.
    """
    variants: dict[str, dict[str, Any]] = {}
    for name, *rest in given:
        bases = [text for text in rest if "=" not in text]
        assigned = parsed_settings([text for text in rest if "=" in text])
        changed = parsed_words(assigned, settings_of(PipelineConfig))
        if "=" in name or len(bases) > 1 or not changed:
            raise ConfigError(
                f"--variant {' '.join([name, *rest])}: expected NAME [METHOD] SETTING=VALUE..., "
                "e.g. no-light coarse coarse.light.enabled=false"
            )
        if name in variants:
            raise ConfigError(f"--variant {name} is given twice")
        variants[name] = {**({"method": bases[0]} if bases else {}), **changed}
    return variants


def print_benchmark(found: dict[str, Any], *, to_stderr: bool) -> None:
    """What came out: differences to the baseline, spread over seeds, failures, and where the page is."""
    from rich.markup import escape

    from flows.tables import difference_figures, difference_text, spread_text, table_figures
    from flows.terminal import console, print_table

    out = console(error=to_stderr)
    comparison = found["comparison"]
    trees = [case["metrics"] for case in found["cases"]]
    columns, differences = table_figures(*trees), difference_figures(*trees)
    if comparison["paired_datasets"]:
        table = _table(
            f"differences to {escape(comparison['baseline'])}, mean over sequences [95 % interval]"
        )
        for column in ("dataset", "profile", "method", "sequences", *differences):
            table.add_column(column)
        for row in comparison["paired_datasets"]:
            about = (row["dataset"], row["profile"], row["method"], str(row["n_sequences"]))
            table.add_row(
                *map(escape, about),
                *(difference_text(name, row["figures"].get(name)) for name in differences),
            )
        print_table(out, table)
    table = _table("mean ± standard deviation over seeds")
    for column in ("sequence", "profile", "method", "seeds", *columns):
        table.add_column(column)
    for row in comparison["sequences"]:
        name = f"{row['sequence']}@{row['setting']}" if row["setting"] else row["sequence"]
        figures = (spread_text(metric, row["figures"].get(metric)) for metric in columns)
        about = (name, row["profile"], row["method"], str(row["n_seeds"]))
        table.add_row(*map(escape, about), *figures)
    print_table(out, table)
    for words in found["regressions"]:
        out.print(f"[red]worse: {escape(words)}[/]")
    for case in found["cases"]:
        if case["error"]:
            run = f"{case['sequence']} {case['method']} seed {case['seed']}"
            out.print(f"[red]{escape(run)} failed in {escape(case['error'])}[/]")
    out.print(f"report: {found['report']}", soft_wrap=True, markup=False)


def _table(title: str) -> Table:
    from rich.table import Table

    return Table(box=None, pad_edge=False, header_style="bold", title=title, title_justify="left")
