"""`gallery`: pictures of finished runs with their figures, as a Markdown page."""

from __future__ import annotations

import argparse
import datetime
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from extrags import __version__
from extrags.errors import ConfigError, StoreError, reason_of
from extrags.source_commit import source_commit
from flows.commands.common import existing_store, items, run_options, set_up_logging, without_folders
from flows.commands.options import Parser, add_output, add_store
from flows.commands.outputs import output_folder

if TYPE_CHECKING:
    from flows.outcome_records import OutcomeRecord

__all__ = ["add_arguments", "gallery"]

PAGE_SUFFIXES = frozenset({".md", ".markdown", ".html", ".htm"})
TITLE, LARGEST_KB = "Gallery", 1000
"""What the page is called, and how large its images are together, where nothing else is asked for."""


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
    parser.add_argument("--name", default=TITLE, help="title of the page (default: %(default)s)")
    parser.add_argument(
        "--kb",
        type=int,
        default=LARGEST_KB,
        metavar="N",
        help="bound on all images together (default: %(default)s)",
    )
    add_output(
        parser, "FOLDER", _page_folder, default="gallery", help="for page and images (default: %(default)s)"
    )


def _page_folder(text: str) -> str:
    """As `output_folder`; the name of a page is that of a file, though other verbs take it.

    Raises:
        ArgumentTypeError: for a file or the name of a page, or when nothing can be made there.
    """
    place = output_folder(text)
    if Path(place).suffix.lower() in PAGE_SUFFIXES and not Path(place).exists():
        raise argparse.ArgumentTypeError(
            f"{text} is the name of a page; expected a folder, into which index.md and its images are written"
        )
    return place


def gallery(given: argparse.Namespace) -> int:
    """`extrags gallery`.

    Raises:
        ConfigError: when the images cannot be as small as is asked for.
        StoreError: when there is no such store, no run of one of the patterns, or something of one is gone.
    """
    from flows.environment import prepare

    if given.kb < 1:
        raise ConfigError(f"--kb {given.kb}: expected 1 or more")
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    store = existing_store(given)
    prepare(store.state, debug=given.debug, looks=True)
    from flows.recorded_runs import gallery_run, last_runs, nearest_on_record

    methods, profiles = items(given.methods), items(given.profiles)
    chosen = last_runs(store, given.patterns, methods=methods, profiles=profiles)
    # One by one: a page without a sequence that was asked for would pass for one with all of them.
    absent = [
        pattern
        for pattern in given.patterns
        if not last_runs(store, [pattern], methods=methods, profiles=profiles)
    ]
    if absent or not chosen:
        wanted = f" of {', '.join(absent)}" if absent else ""
        near = nearest_on_record(store, absent)
        raise StoreError(f"no finished run{wanted} is on record in {store.root}{near}")
    from extrags.report.gallery import build_gallery

    runs = [gallery_run(store, run) for run in chosen]
    try:
        page = build_gallery(
            runs,
            Path(given.output),
            title=given.name,
            command=_commands([run.record for run in chosen if run.record is not None], given),
            largest_bytes=1000 * given.kb,
            made=_made(),
        )
    except OSError as error:
        file = error.filename or given.output
        raise StoreError(f"the gallery cannot be written: {file}: {reason_of(error)}") from error
    print(page)
    return 0


def _made() -> str:
    """By what and when, so that a page can be told to be of an earlier version."""
    commit = source_commit()
    version = f"{__version__} ({commit[:9]})" if commit else __version__
    return f"extrags {version} on {datetime.datetime.now(datetime.UTC):%Y-%m-%d}"


def _commands(runs: Sequence[OutcomeRecord], given: argparse.Namespace) -> str:
    """What makes the runs and their gallery, for another machine: without a place of this one."""
    made: dict[str, list[str]] = {}
    for run in runs:
        options = run_options(run, elsewhere=True)
        made.setdefault(options, []).append(shlex.quote(without_folders(run["sequence"])))
    lines = [f"extrags run {' '.join(names)}{how}" for how, names in made.items()]
    options = "".join(
        f" --{name} {' '.join(items(chosen))}"
        for name, chosen in (("methods", given.methods), ("profiles", given.profiles))
        if chosen
    )
    options += "" if given.name == TITLE else f" --name {shlex.quote(given.name)}"
    options += "" if given.kb == LARGEST_KB else f" --kb {given.kb}"
    place = Path(given.output)
    output = "" if place.is_absolute() else f" --output {shlex.quote(place.as_posix())}"
    names = " ".join(shlex.quote(without_folders(run["sequence"])) for run in runs)
    return "\n".join([*lines, f"extrags gallery {names}{options}{output}"])
