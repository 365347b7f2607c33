"""`compare`: runs of one sequence side by side, on a page."""

from __future__ import annotations

import argparse
from dataclasses import replace

from extrags.errors import ConfigError
from flows.commands.common import existing_store, items, set_up_logging, write_page
from flows.commands.options import Parser, add_output, add_store
from flows.commands.outputs import output_file

__all__ = ["add_arguments", "compare"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags compare`."""
    from extrags.config import PROFILES
    from flows.methods import METHODS

    parser.description = (
        "Make a page that compares finished runs of one sequence side by side: figures with their "
        "differences to the first, the same held-out views, settings that differ. Nothing is run."
    )
    parser.set_defaults(command=compare)
    parser.add_argument(
        "runs",
        nargs="+",
        metavar="RUN",
        help="a sequence, for all of its runs on record, the oldest first; or the page of a run: its file, "
        "its folder or the key of its report",
    )
    for name, known in (("methods", METHODS), ("profiles", PROFILES)):
        parser.add_argument(
            f"--{name}",
            nargs="+",
            default=[],
            metavar=name[:-1].upper(),
            help=f"of the runs of a sequence, those of these {name}: {', '.join(known)}",
        )
    parser.add_argument("--seeds", nargs="+", default=[], metavar="N", help="the same by seed")
    parser.add_argument(
        "--views", type=int, default=6, metavar="N", help="held-out views in pictures (default: %(default)s)"
    )
    add_store(parser)
    add_output(parser, "FILE", output_file, default="comparison.html", help="the page (default: %(default)s)")


def compare(given: argparse.Namespace) -> int:
    """`extrags compare`.

    Raises:
        ConfigError: for fewer than two runs, or runs of different sequences.
        StoreError: when there is no such store, something of a run is gone, or the page cannot be written.
        ShapeError: when the held-out views of the runs are not the same.
    """
    from flows.commands.benchmark import parsed_seeds
    from flows.environment import prepare

    if given.views < 1:
        raise ConfigError(f"--views {given.views}: expected 1 or more")
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    store = existing_store(given)
    prepare(store.state, debug=given.debug, looks=True)
    from flows.recorded_runs import chosen_runs, compared_run, held_out_digest, run_names

    runs = chosen_runs(
        store,
        given.runs,
        methods=items(given.methods),
        profiles=items(given.profiles),
        seeds=parsed_seeds(given.seeds) if given.seeds else (),
    )
    from extrags.report.run_comparison import build_run_comparison
    from extrags.sequence import EndoscopicSequence

    refs = [run.ref(store, "sequence") for run in runs]
    first = refs[0]
    if first is None:
        raise ConfigError(f"{runs[0].sequence}: its page {runs[0].report.key} knows no frames")
    sequence = replace(store.load(EndoscopicSequence, first), name=runs[0].shown_name)
    # Most runs share their frames, which may be gigabytes.
    digests = {first: held_out_digest(sequence)}
    for ref in refs:
        if ref is not None and ref not in digests:
            digests[ref] = held_out_digest(store.load(EndoscopicSequence, ref))
    shown = [
        replace(compared_run(store, run, name, given.output), held_out="" if ref is None else digests[ref])
        for run, ref, name in zip(runs, refs, run_names(runs), strict=True)
    ]
    page = build_run_comparison(sequence, shown, views=given.views)
    print(write_page(page, given.output))
    return 0
