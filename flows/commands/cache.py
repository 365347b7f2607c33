"""`cache ls`, `cache rm`, `cache gc`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from flows.commands.common import store_root, write_json
from flows.commands.options import Parser, add_json, add_store, add_verb

if TYPE_CHECKING:
    from extrags.store import Manifest, Ref, Store

__all__ = ["add_arguments", "gc", "ls", "rm"]


def add_arguments(parser: Parser) -> None:
    """The verbs below `extrags cache`."""
    parser.description = "Look into the artefact store and clean it."
    verbs = parser.add_subparsers(metavar="ls|rm|gc", required=True, parser_class=Parser)
    made = add_verb(verbs, "ls", ls, "list artefacts")
    made.add_argument("pattern", nargs="?", default="*", help="shell pattern over key, stage or sequence")
    made.add_argument("--verify", action="store_true", help="read every file and compare digests")
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
        description="Remove what killed runs left, debugging files of failures, and artefacts of former "
        "versions of their stage.",
    )
    add_store(made)


def ls(given: argparse.Namespace) -> int:
    """`extrags cache ls`; with `--verify`, exit code 1 when an artefact is damaged."""
    from rich.table import Table

    from extrags.store import Store
    from flows.terminal import console

    store = Store(store_root(given))
    manifests = store.ls(given.pattern)
    damaged = [item.key for item in manifests if given.verify and not store.verify(_ref(store, item))]
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
            cost = (f"{item.seconds:.1f}", _size(item.bytes))
            table.add_row(item.stage, item.label, item.started[:16], *cost, item.key + mark)
        out = console()
        out.print(table)
        total = _size(sum(item.bytes for item in manifests))
        out.print(f"{len(manifests)} artefacts, {total}, in {store.root}")
    rows = [item.model_dump(mode="json") | {"damaged": item.key in damaged} for item in manifests]
    write_json(rows, given.json)
    return 1 if damaged else 0


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


def _ref(store: Store, manifest: Manifest) -> Ref:
    from extrags.store import Ref

    return Ref(uri=store.backend.uri(manifest.key), digest=manifest.digest)


def _size(count: int) -> str:
    value = float(count)
    for unit in ("B", "KiB", "MiB"):
        if value < 1024:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1024
    return f"{value:.1f} GiB"
