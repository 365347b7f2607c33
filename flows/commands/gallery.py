"""`gallery`: pictures of finished runs with their figures, as a Markdown page."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, StoreError
from flows.commands.common import items, set_up_logging, store_root
from flows.commands.options import Parser, add_store

if TYPE_CHECKING:
    from extrags.report.gallery import GalleryRun

DEFAULT_METHOD = "extrags"

__all__ = ["add_arguments", "gallery"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags gallery`."""
    from extrags.config import PROFILES
    from flows.methods import METHODS

    parser.description = (
        "Make a Markdown page with a held-out and a virtual view of each sequence that the store has a "
        "finished run of: its last one. Nothing is run."
    )
    parser.set_defaults(command=gallery)
    parser.add_argument(
        "patterns", nargs="*", metavar="PATTERN", help="sequences, with * and ? (default: all on record)"
    )
    for name, known in (("methods", METHODS), ("profiles", PROFILES)):
        parser.add_argument(
            f"--{name}",
            nargs="+",
            default=[],
            metavar=name[:-1].upper(),
            help=f"only runs of these {name}: {', '.join(known)}",
        )
    add_store(parser)
    parser.add_argument("--name", default="Gallery", help="title of the page (default: %(default)s)")
    parser.add_argument(
        "--kb",
        type=int,
        default=1000,
        metavar="N",
        help="bound on all images together (default: %(default)s)",
    )
    parser.add_argument(
        "-o", "--out", metavar="FOLDER", default="gallery", help="for page and images (default: %(default)s)"
    )


def gallery(given: argparse.Namespace) -> int:
    """`extrags gallery`.

    Raises:
        ConfigError: when the images cannot be as small as is asked for.
        StoreError: when there is no such run, or something of one is gone.
    """
    from extrags.store import Store
    from flows.environment import prepare

    if given.kb < 1:
        raise ConfigError(f"--kb {given.kb}: expected 1 or more")
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    store = Store(store_root(given))
    prepare(store.state, debug=given.debug)
    from flows.recorded_runs import gallery_run, last_runs

    chosen = last_runs(store, given.patterns, methods=items(given.methods), profiles=items(given.profiles))
    if not chosen:
        wanted = f" of {', '.join(given.patterns)}" if given.patterns else ""
        raise StoreError(f"no finished run{wanted} is on record in {store.root}")
    from extrags.report.gallery import build_gallery

    runs = [gallery_run(store, run) for run in chosen]
    try:
        page = build_gallery(
            runs,
            Path(given.out),
            title=given.name,
            command=_commands(runs, given.out),
            largest_bytes=1000 * given.kb,
        )
    except OSError as error:
        raise StoreError(f"the gallery cannot be written: {error}") from error
    print(page)
    return 0


def _commands(runs: Sequence[GalleryRun], folder: str) -> str:
    """What makes the runs and their gallery, for another machine: without a place of this one."""
    made: dict[str, list[str]] = {}
    for run in runs:
        method = "" if run.method == DEFAULT_METHOD else f" --method {run.method}"
        made.setdefault(f"{method} --profile {run.profile}", []).append(shlex.quote(run.sequence.name))
    lines = [f"extrags run {' '.join(names)}{how}" for how, names in made.items()]
    names = [shlex.quote(run.sequence.name) for run in runs]
    out = "" if Path(folder).is_absolute() else f" --out {shlex.quote(Path(folder).as_posix())}"
    return "\n".join([*lines, f"extrags gallery {' '.join(names)}{out}"])
