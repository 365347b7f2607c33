"""`cache ls`, `cache usage`, `cache verify`, `cache rm`, `cache gc`."""

from __future__ import annotations

import argparse
import logging
import math
import re
import sys
from collections.abc import Collection
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, DamagedArtefactError, StoreError
from flows.commands.common import counted, existing_store, set_up_logging, write_json
from flows.commands.options import Parser, add_json, add_store, add_verb
from flows.commands.status import size_text
from flows.printable import in_one_line

if TYPE_CHECKING:
    from extrags.store import Store

__all__ = ["add_arguments", "age_s", "gc", "ls", "rm", "size_bytes", "usage", "verify"]

log = logging.getLogger(__name__)

SECONDS = {"h": 3600.0, "d": 86400.0, "w": 7 * 86400.0}
BYTES = {"": 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}


def add_arguments(parser: Parser) -> None:
    """The verbs below `extrags cache`."""
    parser.description = "List, verify and clean the artefact store."
    verbs = parser.add_subparsers(metavar="ls|usage|verify|rm|gc", required=True, parser_class=Parser)
    made = add_verb(verbs, "ls", ls, "list artefacts")
    made.add_argument("pattern", nargs="?", default="*", help="shell pattern over key, stage or sequence")
    made.add_argument("--verify", action="store_true", help="read every file and compare digests")
    add_store(made)
    add_json(made)
    made = add_verb(verbs, "usage", usage, "what each sequence uses, and when it was used last")
    add_store(made)
    add_json(made)
    made = add_verb(
        verbs,
        "verify",
        verify,
        "read every file of the store and say which artefacts are damaged",
        description="Compare every file of the store with what was stored; on an object store this downloads "
        "all of them. Exit code 1 when an artefact is damaged.",
    )
    made.add_argument(
        "--repair", action="store_true", help="set damaged artefacts aside; the next run recomputes them"
    )
    add_store(made)
    add_json(made)
    made = add_verb(
        verbs, "rm", rm, "remove artefacts, and of sequences the records of how their last runs ended"
    )
    made.add_argument(
        "patterns", nargs="+", metavar="PATTERN", help="shell pattern over key, stage or sequence"
    )
    add_store(made)
    made = add_verb(
        verbs,
        "gc",
        gc,
        "remove what can never be used again, and what the options say",
        description="Remove what killed runs left, debugging files of failures, damaged artefacts that were "
        "set aside, and artefacts of earlier versions of their stage. Each option removes more; never what a "
        "run that is going on uses, what was used within the last ten minutes, or what a kept artefact was "
        "made from.",
    )
    made.add_argument("--older-than", metavar="AGE", help="not used for so long: 12h, 30d, 8w")
    made.add_argument(
        "--max-size", metavar="SIZE", help="least recently used, until no more is left: 500MiB, 50GiB, 1TiB"
    )
    made.add_argument(
        "--keep-last", metavar="N", type=int, help="of each sequence, what its last N runs did not use"
    )
    made.add_argument("--unreachable", action="store_true", help="what no kept run used")
    made.add_argument(
        "--with-inputs",
        action="store_true",
        help="also what kept artefacts were made from, except by max-size",
    )
    made.add_argument("--dry-run", action="store_true", help="remove nothing, say what would be removed")
    add_store(made)
    add_json(made)


def ls(given: argparse.Namespace) -> int:
    """`extrags cache ls`; with `--verify`, exit code 1 when an artefact is damaged or unreadable.

    Raises:
        StoreError: when there is no such store.
    """
    from rich.markup import escape
    from rich.table import Table

    from flows.terminal import console, print_table

    store = _looked_into(given)
    manifests = [item for pattern in _spellings(given.pattern) for item in store.ls(pattern)]
    found, unreadable = _examined(store, [item.key for item in manifests] if given.verify else [])
    damaged = [damage.key for damage in found]
    if given.json != "-":
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("stage", no_wrap=True)
        table.add_column("sequence", no_wrap=True)
        table.add_column("made", no_wrap=True)
        table.add_column("seconds", justify="right")
        table.add_column("size", justify="right", no_wrap=True)
        table.add_column("key", overflow="fold")
        for item in manifests:
            mark = " [red]DAMAGED[/]" if item.key in damaged else ""
            mark = " [red]UNREADABLE[/]" if item.key in unreadable else mark
            cost = (f"{item.seconds:.1f}", size_text(item.bytes))
            names = (escape(item.stage), escape(item.label), escape(item.started[:16]))
            table.add_row(*names, *cost, escape(item.key) + mark)
        out = console()
        print_table(out, table)
        total = size_text(sum(item.bytes for item in manifests))
        out.print(f"{counted(len(manifests), 'artefact')}, {total}, in {store.root}", markup=False)
    rows = [
        item.model_dump(mode="json", exclude={"contents"}) | {"damaged": item.key in damaged}
        for item in manifests
    ]
    write_json(rows, given.json)
    return 1 if damaged or unreadable else 0


def verify(given: argparse.Namespace) -> int:
    """`extrags cache verify`; exit code 1 when an artefact is damaged, set aside or not, or unreadable.

    Raises:
        StoreError: when there is no such store.
    """
    from rich.markup import escape
    from rich.table import Table

    from extrags.store.manifest import stage_of
    from flows.terminal import console, print_table

    store = _looked_into(given)
    keys = store.keys()
    damaged, unreadable = _examined(store, keys)
    aside = [_set_aside(store, damage) if given.repair else None for damage in damaged]
    if given.json != "-":
        out = console()
        if damaged or unreadable:
            table = Table(box=None, pad_edge=False, header_style="bold")
            table.add_column("stage", no_wrap=True)
            for column in ("damage", "key", *(["set aside as"] if given.repair else [])):
                table.add_column(column, overflow="fold")
            for damage, place in zip(damaged, aside, strict=True):
                what = f"{damage.file}: {damage.problem}" if damage.file else damage.problem
                cells = (damage.stage, what, damage.key, *([place or ""] if given.repair else []))
                table.add_row(*map(escape, cells))
            for key, problem in unreadable.items():
                table.add_row(*map(escape, (stage_of(key), problem, key)))
            print_table(out, table)
        out.print(f"{len(damaged)} of {len(keys)} artefacts damaged in {store.root}", markup=False)
        if unreadable:
            # They may be whole: whoever may read them can tell.
            out.print(f"{counted(len(unreadable), 'artefact')} could not be read", markup=False)
        if damaged and not given.repair:
            out.print("with --repair they are set aside, and the next run recomputes them")
        elif damaged:
            out.print("the next run recomputes them; `extrags cache gc` removes what was set aside")
    rows = [
        {
            "stage": damage.stage,
            "key": damage.key,
            "file": damage.file,
            "problem": damage.problem,
            "set_aside": place,
        }
        for damage, place in zip(damaged, aside, strict=True)
    ]
    others = [{"stage": stage_of(key), "key": key, "problem": told} for key, told in unreadable.items()]
    found = {"store": store.root, "artefacts": len(keys), "damaged": rows, "unreadable": others}
    write_json(found, given.json)
    return 1 if damaged or unreadable else 0


def _set_aside(store: Store, damage: DamagedArtefactError) -> str | None:
    """Where a damaged artefact is now; None where it stays, with a warning if it cannot be moved."""
    try:
        return store.set_aside(damage)
    except StoreError as error:
        log.warning("%s", error)
        return None


def _examined(store: Store, keys: Collection[str]) -> tuple[list[DamagedArtefactError], dict[str, str]]:
    """What is wrong with some artefacts, and why others cannot be read, by key.

    With a progress bar in a terminal.

    Raises:
        StoreError: when an object store does not answer, which tells nothing of a single artefact.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from flows.terminal import console

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bars = Progress(
        *columns, console=console(error=True), transient=True, disable=not (keys and sys.stderr.isatty())
    )
    damaged: list[DamagedArtefactError] = []
    unreadable: dict[str, str] = {}
    with bars:
        for key in bars.track(keys, description="reading"):
            try:
                damage = store.examine(key)
            except StoreError as error:
                if "://" in store.root:
                    raise
                unreadable[key] = str(error)
            else:
                damaged += [] if damage is None else [damage]
    return damaged, unreadable


def _spellings(pattern: str) -> list[str]:
    """A pattern, and where it names a sequence of the catalogue in another spelling, what artefacts have."""
    from data_catalog.names import plain_name

    return list(dict.fromkeys((pattern, plain_name(pattern))))


def rm(given: argparse.Namespace) -> int:
    """`extrags cache rm`.

    Raises:
        StoreError: when there is no such store, nothing in it matches, or a relative path is the name of
            sequences in other places, before anything is removed; when something could not be removed, once
            all else has been.
    """
    from data_catalog.names import path_of
    from extrags.store.records import remove_record
    from flows.outcome_records import removable_outcomes

    store = _looked_into(given)
    # Of all patterns before the first artefact goes: one that is refused leaves the store as it is.
    keys = dict.fromkeys(
        key
        for given_as in given.patterns
        for pattern in _spellings(given_as)
        for key in store.removable(pattern, here=path_of(pattern))
    )
    # How the runs of these sequences ended: without their artefacts it would be told for ever.
    outcomes = dict.fromkeys(
        name
        for given_as in given.patterns
        for pattern in _spellings(given_as)
        for name in removable_outcomes(store, pattern, here=path_of(pattern))
    )
    removed: list[str] = []
    problems: list[StoreError] = []
    for key in keys:
        try:
            if store.backend.discard(key):
                print(key)
                removed.append(key)
        except StoreError as error:
            problems.append(error)
    forgotten = 0
    for name in outcomes:
        try:
            remove_record(store, name)
            forgotten += 1
        except StoreError as error:
            problems.append(error)
    if not removed and not forgotten and not problems:
        raise StoreError(
            f"nothing in {store.root} matches {' or '.join(given.patterns)} (keys, stages and sequences as "
            "in extrags cache ls); nothing was removed"
        )
    print(f"{counted(len(removed), 'artefact')} removed from {store.root}")
    if forgotten:
        print(f"{counted(forgotten, 'record')} of how runs ended removed")
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise StoreError(f"{problems[0]}{more}") from problems[0]
    return 0


def usage(given: argparse.Namespace) -> int:
    """`extrags cache usage`.

    Raises:
        StoreError: when there is no such store.
    """
    from dataclasses import asdict

    from rich.markup import escape
    from rich.table import Table

    from extrags.store.retention import usage as usage_of
    from flows.terminal import console, print_table

    store = _looked_into(given)
    rows = usage_of(store)
    if given.json != "-":
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("sequence", no_wrap=True)
        for column in ("artefacts", "files", "size"):
            table.add_column(column, justify="right", no_wrap=True)
        for column in ("last made", "last used"):
            table.add_column(column, no_wrap=True)
        for row in rows:
            numbers = (str(row.artefacts), str(row.files), size_text(row.bytes))
            table.add_row(escape(row.sequence), *numbers, row.made[:16], row.used[:16])
        out = console()
        print_table(out, table)
        total = ", ".join(
            counted(number, noun)
            for number, noun in (
                (sum(row.artefacts for row in rows), "artefact"),
                (sum(row.files for row in rows), "file"),
            )
        )
        out.print(f"{total}, {size_text(sum(row.bytes for row in rows))}, in {store.root}", markup=False)
    write_json([asdict(row) for row in rows], given.json)
    return 0


def gc(given: argparse.Namespace) -> int:
    """`extrags cache gc`.

    Raises:
        ConfigError: for an age or a size that is none.
        StoreError: when there is no such store, or something could not be removed; all else has been by
            then.
    """
    from dataclasses import asdict

    from extrags.store.retention import Policy

    older_than_s = None if given.older_than is None else age_s(given.older_than)
    max_bytes = None if given.max_size is None else size_bytes(given.max_size)
    if given.keep_last is not None and given.keep_last < 1:
        raise ConfigError(f"--keep-last {given.keep_last}: expected 1 or more")
    store = _looked_into(given)
    # Here, because they load Prefect, which wrong usage must not wait for.
    from flows.cleaning import clean_store
    from tasks.stage import all_stage_versions

    policy = Policy(
        older_than_s=older_than_s,
        max_bytes=max_bytes,
        keep_last=given.keep_last,
        unreachable=given.unreachable,
        versions=all_stage_versions(),
        with_inputs=given.with_inputs,
    )
    cleaned = clean_store(store, policy, dry_run=given.dry_run)
    leftovers, removed, skipped = cleaned.leftovers, cleaned.artefacts.removed, cleaned.artefacts.skipped
    if given.json != "-":
        for name in leftovers:
            print(in_one_line(name))
        for item in removed:
            said = f"{item.sequence}  {size_text(item.bytes)}  {item.reason}"
            print(in_one_line(f"artefacts/{item.key}  {said}"))
        would = "would be " if given.dry_run else ""
        print(f"{counted(len(leftovers), 'leftover')} {would}removed from {store.root}")
        freed = size_text(sum(item.bytes for item in removed))
        print(f"{counted(len(removed), 'artefact')} of {freed} {would}removed")
        if skipped:
            print(f"{counted(len(skipped), 'artefact')} skipped, whose manifests cannot be read")
    rows = [asdict(item) for item in removed]
    found = {"dry_run": given.dry_run, "leftovers": leftovers, "artefacts": rows, "skipped": skipped}
    write_json(found, given.json)
    cleaned.check()
    return 0


def age_s(text: str) -> float:
    """`12h`, `30d` or `8w` in seconds.

    Raises:
        ConfigError: for anything else.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([hdw])", text)
    if found is None:
        raise ConfigError(f"{text!r} is no age; expected a number with h, d or w, such as 30d")
    return float(found[1]) * SECONDS[found[2]]


def size_bytes(text: str) -> int:
    """`500MiB` or `50GiB` in bytes.

    Raises:
        ConfigError: for anything else.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?([KMGT]iB|)", text)
    if found is None:
        raise ConfigError(f"{text!r} is no size; expected a number with KiB, MiB, GiB or TiB, such as 50GiB")
    size = float(found[1]) * BYTES[found[2]]
    if math.isinf(size):
        raise ConfigError(f"{text[:20]}... is larger than any store")
    return int(size)


def _looked_into(given: argparse.Namespace) -> Store:
    """The store; what it warns of, such as damage, are log lines.

    Raises:
        StoreError: when there is none.
    """
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    return existing_store(given)
