"""`cache ls`, `cache verify`, `cache rm`, `cache gc`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.errors import DamagedArtefactError, StoreError
from flows.commands.common import store_root, write_json
from flows.commands.options import Parser, add_json, add_store, add_verb
from flows.commands.status import size_text

if TYPE_CHECKING:
    from extrags.store import Store

__all__ = ["add_arguments", "gc", "ls", "rm", "verify"]


def add_arguments(parser: Parser) -> None:
    """The verbs below `extrags cache`."""
    parser.description = "Look into the artefact store and clean it."
    verbs = parser.add_subparsers(metavar="ls|verify|rm|gc", required=True, parser_class=Parser)
    made = add_verb(verbs, "ls", ls, "list artefacts")
    made.add_argument("pattern", nargs="?", default="*", help="shell pattern over key, stage or sequence")
    made.add_argument("--verify", action="store_true", help="read every file and compare digests")
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
        "--repair", action="store_true", help="set damaged artefacts aside; the next run makes them anew"
    )
    add_store(made)
    add_json(made)
    made = add_verb(verbs, "rm", rm, "remove artefacts")
    made.add_argument(
        "patterns", nargs="+", metavar="PATTERN", help="shell pattern over key, stage or sequence"
    )
    add_store(made)
    made = add_verb(
        verbs,
        "gc",
        gc,
        "remove what can never be used again",
        description="Remove what killed runs left, debugging files of failures, damaged artefacts that were "
        "set aside, and artefacts of former versions of their stage.",
    )
    add_store(made)


def ls(given: argparse.Namespace) -> int:
    """`extrags cache ls`; with `--verify`, exit code 1 when an artefact is damaged."""
    from rich.table import Table

    from extrags.store import Store
    from flows.terminal import console

    store = Store(store_root(given))
    manifests = store.ls(given.pattern)
    damaged = [item.key for item in manifests if given.verify and store.examine(item.key)]
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
            cost = (f"{item.seconds:.1f}", size_text(item.bytes))
            table.add_row(item.stage, item.label, item.started[:16], *cost, item.key + mark)
        out = console()
        out.print(table)
        total = size_text(sum(item.bytes for item in manifests))
        out.print(f"{len(manifests)} artefacts, {total}, in {store.root}")
    rows = [item.model_dump(mode="json") | {"damaged": item.key in damaged} for item in manifests]
    write_json(rows, given.json)
    return 1 if damaged else 0


def verify(given: argparse.Namespace) -> int:
    """`extrags cache verify`; exit code 1 when an artefact is damaged, also if it is set aside.

    Raises:
        StoreError: when there is no such store.
    """
    from rich.markup import escape
    from rich.table import Table

    from extrags.store import Store
    from flows.terminal import console

    store = Store(store_root(given))
    if "://" not in store.root and not Path(store.root).is_dir():
        raise StoreError(f"there is no store {store.root}")
    checked, damaged = _examined(store)
    aside = [store.set_aside(damage) if given.repair else None for damage in damaged]
    if given.json != "-":
        out = console()
        if damaged:
            table = Table(box=None, pad_edge=False, header_style="bold")
            table.add_column("stage", no_wrap=True)
            for column in ("damage", "key", *(["set aside as"] if given.repair else [])):
                table.add_column(column, overflow="fold")
            for damage, place in zip(damaged, aside, strict=True):
                what = f"{damage.file}: {damage.problem}" if damage.file else damage.problem
                cells = (damage.stage, what, damage.key, *([place or ""] if given.repair else []))
                table.add_row(*map(escape, cells))
            out.print(table)
        out.print(f"{len(damaged)} of {checked} artefacts damaged in {store.root}")
        if damaged and not given.repair:
            out.print("with --repair they are set aside, and the next run makes them anew")
        elif damaged:
            out.print("the next run makes them anew; `extrags cache gc` removes what was set aside")
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
    write_json({"store": store.root, "artefacts": checked, "damaged": rows}, given.json)
    return 1 if damaged else 0


def _examined(store: Store) -> tuple[int, list[DamagedArtefactError]]:
    """Number of artefacts, and what is wrong with some of them; with a progress bar in a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from flows.terminal import console

    keys = store.keys()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bars = Progress(*columns, console=console(error=True), transient=True, disable=not sys.stderr.isatty())
    with bars:
        found = [store.examine(key) for key in bars.track(keys, description="reading")]
    return len(keys), [damage for damage in found if damage is not None]


def rm(given: argparse.Namespace) -> int:
    """`extrags cache rm`."""
    from extrags.store import Store

    store = Store(store_root(given))
    removed = [key for pattern in given.patterns for key in store.rm(pattern)]
    for key in removed:
        print(key)
    print(f"{len(removed)} artefacts removed from {store.root}")
    return 0


def gc(given: argparse.Namespace) -> int:
    """`extrags cache gc`."""
    import flows.wiring  # noqa: F401  (registers every stage with its version)
    from extrags.store import Store
    from tasks.locks import sweep_locks
    from tasks.stage import stage_versions

    store = Store(store_root(given))
    removed = [*store.gc(stage_versions()), *sweep_locks(store.locks)]
    for name in removed:
        print(name)
    print(f"{len(removed)} leftovers removed from {store.root}")
    return 0
