"""`bench explore`: ways to choose virtual views beside each other, against the true surface."""

from __future__ import annotations

import argparse
import os
from typing import Any

from extrags.errors import ConfigError
from flows.commands.benchmark import parsed_seeds
from flows.commands.common import items, set_up_logging, store_root, write_json
from flows.commands.options import Parser, add_json, add_profile, add_sequences, add_settings, add_store
from flows.interruption import RESUMABLE, say_when_interrupted

__all__ = ["add_arguments", "explore"]

COLUMNS = {
    "never_seen": "never seen",
    "never_seen_well": "never seen, well",
    "badly_seen": "badly seen",
    "held_out": "held-out pixels",
}


def add_arguments(parser: Parser) -> None:
    """The options of `extrags bench explore`."""
    parser.description = (
        "Reconstruct each sequence once per seed, choose virtual views in each way, and measure what they "
        "show of the true surface: of what training never saw (seen at all, and seen well), of what it saw "
        "badly, and of the never-observed pixels of held-out frames. For sequences with a true surface: "
        "phantoms, and recordings with true depth. `clairvoyant` and `free-viewpoint` know the true surface."
    )
    add_sequences(parser, chosen=False)
    parser.add_argument(
        "--ways",
        nargs="+",
        default=[],
        metavar="WAY",
        help="extrags, paper, paper-no-illumination, paper-no-fold, exploregs, frontier, random, perturbed, "
        "clairvoyant, free-viewpoint (default: all)",
    )
    parser.add_argument(
        "--views",
        nargs="+",
        default=["40", "80", "160", "240"],
        metavar="N",
        help="numbers of virtual views, real starts not counted (default: 40 80 160 240)",
    )
    parser.add_argument(
        "--seeds", nargs="+", default=["0"], metavar="N", help="seeds of all stages and ways (default: 0)"
    )
    parser.add_argument(
        "--end-use",
        nargs="*",
        metavar="N",
        help="also restore so many views of each way, fine-tune with them and measure the held-out frames "
        "(default: the largest of --views); takes minutes per way",
    )
    add_profile(parser, "quick")
    add_store(parser)
    add_settings(parser)
    add_json(parser)


def explore(given: argparse.Namespace) -> int:
    """`extrags bench explore`."""
    say_when_interrupted(RESUMABLE)
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    # Read when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from extrags.store import Store
    from flows.environment import prepare

    root = store_root(given)
    views = _numbers("--views", given.views)
    if not views:
        raise ConfigError(f"--views {' '.join(given.views)}: expected one or more whole numbers")
    seeds = parsed_seeds(given.seeds)
    end_use = [] if given.end_use is None else _numbers("--end-use", given.end_use) or [max(views)]
    prepare(Store(root).state, debug=given.debug)
    from flows.exploration_ways import WAYS, bench_explore, check_ways
    from flows.methods import method_config
    from flows.terminal import console

    ways = check_ways(items(given.ways) or list(WAYS))
    config = method_config("extrags", given.profile, given.settings, seeds[0])
    lpips = None
    if end_use:
        from tasks.weights import lpips_by_net, lpips_weights

        lpips = lpips_by_net(lpips_weights(config.evaluate))
    out = console()
    with out.status("") as status:
        found = bench_explore(
            given.sequences,
            given.profile,
            given.settings,
            root,
            ways=ways,
            views=views,
            seeds=seeds,
            end_use=end_use,
            lpips=lpips,
            report=lambda what: status.update(what),
        )
    if given.json != "-":
        _print(found)
    write_json(found, given.json)
    return 0


def _numbers(option: str, given: list[str]) -> list[int]:
    numbers = []
    for text in items(given):
        if not text.isdecimal():
            raise ConfigError(f"{option} {text}: expected a whole number")
        numbers.append(int(text))
    return numbers


def _print(found: dict[str, Any]) -> None:
    """A table per sequence and seed: a row per way, figures at each number of views."""
    from rich.table import Table

    from flows.terminal import console, print_table

    out = console()
    counts = [str(count) for count in found["views"]]
    for sequence, seed in dict.fromkeys((case["sequence"], case["seed"]) for case in found["cases"]):
        cases = [case for case in found["cases"] if (case["sequence"], case["seed"]) == (sequence, seed)]
        truth = cases[0]["truth"]
        out.print(
            f"{sequence}, seed {seed}: of {truth['area_mm2'] / 100:.0f} cm2 within reach training never saw "
            f"{truth['never_seen_share']:.1%} and saw {truth['badly_seen_share']:.1%} badly; "
            f"{truth['held_out_pixels']} held-out pixels. Shares in percent at {' / '.join(counts)} views",
            soft_wrap=True,
            markup=False,
        )
        table = Table(box=None, pad_edge=False, header_style="bold")
        end_use = list(cases[0].get("end_use", {}))
        for column in ("way", *COLUMNS.values(), "views", "renders", "seconds"):
            table.add_column(column)
        for count in end_use:
            table.add_column(f"dB at {count}: whole, never observed")
        for case in cases:
            shares = [" ".join(_percent(case["after"][n][name]) for n in counts) for name in COLUMNS]
            row = [case["way"], *shares, str(case["n_views"]), str(case["renders"]), f"{case['seconds']:.1f}"]
            for count in end_use:
                figures = case["end_use"][count]
                row.append(", ".join(_db(figures[group]["psnr"]) for group in ("whole", "unobserved")))
            table.add_row(*row)
        print_table(out, table)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f}"


def _db(psnr: float | None) -> str:
    return "-" if psnr is None else f"{psnr:.2f}"
