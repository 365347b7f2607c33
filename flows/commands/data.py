"""`data list`, `data show`, `data check`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.errors import SourceNotFoundError, StoreError, UnknownSequenceError, reason_of
from extrags.output_files import whole_file
from flows.commands.common import counted, set_up_logging, write_json
from flows.commands.options import Parser, add_json, add_profile, add_sequence, add_settings, add_verb
from flows.commands.outputs import output_file

if TYPE_CHECKING:
    from rich.console import Console

    from data_catalog import Descriptor
    from data_catalog.inspection import Inspection
    from extrags.config import IngestConfig
    from extrags.sequence import EndoscopicSequence

__all__ = ["add_arguments", "check", "list_all", "show"]


def add_arguments(parser: Parser) -> None:
    """The verbs below `extrags data`."""
    parser.description = "What sequences there are, what is in one, and what is wrong with one."
    verbs = parser.add_subparsers(metavar="list|show|check", required=True, parser_class=Parser)
    made = add_verb(verbs, "list", list_all, "all named sequences, and whether they can be read here")
    made.add_argument("pattern", nargs="?", default="*", help="shell pattern or beginning of a name")
    made.add_argument("--here", action="store_true", help="only those whose data are on this machine")
    add_json(made)
    made = add_verb(verbs, "show", show, "what is known about one sequence, and what its frames hold")
    add_sequence(made)
    add_profile(made)
    add_settings(made, "ingest")
    made.add_argument(
        "--picture",
        metavar="FILE.png",
        type=output_file,
        help="write a contact sheet: masks blue, highlights green, held-out framed",
    )
    add_json(made)
    made = add_verb(
        verbs,
        "check",
        check,
        "say what is wrong with a source",
        description="Read a source and say what is wrong with it: axes, pose direction, depth scale, mask "
        "polarity, intrinsics, exposure, parallax, names. Exit code 1 when anything is.",
    )
    made.add_argument(
        "sources",
        nargs="+",
        metavar="PATH|SEQUENCE",
        help="paths of folders, videos or DICOM files, or names in the catalogue",
    )
    add_profile(made)
    add_settings(made, "ingest")
    add_json(made)


def list_all(given: argparse.Namespace) -> int:
    """`extrags data list`."""
    from fnmatch import fnmatchcase

    from rich.markup import escape
    from rich.table import Table

    from data_catalog import list_sequences
    from extrags.errors import did_you_mean
    from flows.terminal import console, print_table

    sequences = [
        item
        for item in list_sequences()
        if (not given.here or item.available)
        and (fnmatchcase(item.name, given.pattern) or item.name.startswith(given.pattern))
    ]
    if not sequences:
        # Of families without end only the first few are in the list.
        named = _known(given.pattern)
        sequences = [named] if named is not None and (named.available or not given.here) else []
    if not sequences:
        near = did_you_mean(given.pattern, (item.name for item in list_sequences()))
        print(
            f"extrags: nothing in the list matches {given.pattern}{near or ';'} of phantom, caverns and "
            "ct_colon the first few are listed, @sparse and @distanced, and others are given by their whole "
            "name",
            file=sys.stderr,
        )
    if given.json != "-":
        table = Table(box=None, pad_edge=False, header_style="bold")
        for column in ("name", "frames", "size", "depth", "poses", "here", "description"):
            table.add_column(column, justify="right" if column == "frames" else "left")
        for item in sequences:
            table.add_row(
                escape(item.name),
                str(item.frames),
                f"{item.width}x{item.height}",
                "yes" if item.has_depth else "no",
                "yes" if item.has_poses else "no",
                "[green]yes[/]" if item.available else "no",
                escape(item.description),
            )
        out = console()
        print_table(out, table)
        here = sum(item.available for item in sequences)
        out.print(f"{counted(len(sequences), 'sequence')}, {here} of them can be read here")
    write_json([item.model_dump(mode="json") for item in sequences], given.json)
    return 0


def show(given: argparse.Namespace) -> int:
    """`extrags data show`."""
    from rich.markup import escape
    from rich.table import Table

    from data_catalog import resolve
    from flows.terminal import console

    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    found = _known(given.sequence)
    measured: dict[str, Any] | None = None
    try:
        source = resolve(given.sequence)
    except SourceNotFoundError:
        # A catalogue entry whose files are elsewhere is still worth describing.
        if found is None or given.picture:
            raise
    else:
        from data_catalog import read
        from data_catalog.inspection import facts

        sequence = read(source, _ingest(given))
        measured = facts(sequence)
        if given.picture:
            _write_picture(sequence, Path(given.picture))
    described: dict[str, Any] = (
        source.model_dump(mode="json", exclude_none=True)
        if found is None
        else found.model_dump(mode="json", exclude_none=True)
    )
    if given.json != "-":
        table = Table(box=None, show_header=False, pad_edge=False)
        for name, value in ((key, value) for key, value in described.items() if value not in ([], "")):
            table.add_row(f"[bold]{name}[/]", escape(_listed(value)))
        if measured is not None:
            table.add_row("", "")
            for name, value in measured.items():
                table.add_row(f"[bold]{name}[/]", _figure(name, value))
        console().print(table)
        if given.picture:
            console().print(f"picture: {given.picture}", soft_wrap=True, markup=False)
    write_json({**described, "measured": measured}, given.json)
    return 0


def check(given: argparse.Namespace) -> int:
    """`extrags data check`; exit code 1 when anything is wrong.

    Raises:
        UnknownSequenceError: names that are not known, once what was found in the other sources is said.
    """
    if given.debug:
        set_up_logging(debug=True, terminal=True)
    from data_catalog.inspection import inspect
    from flows.terminal import console

    config = _ingest(given)
    inspections, unknown = [], []
    out = console()
    for name in given.sources:
        try:
            found = inspect(name, config)
        except UnknownSequenceError as error:
            unknown.append(str(error))
            continue
        inspections.append(found)
        if given.json != "-":
            # One after another, since reading a recording may take minutes.
            _print_inspection(out, found)
    write_json([{"ok": found.ok, **found.model_dump(mode="json")} for found in inspections], given.json)
    if unknown:
        raise UnknownSequenceError("; ".join(unknown))
    return 0 if all(found.ok for found in inspections) else 1


def _print_inspection(out: Console, found: Inspection) -> None:
    from rich.markup import escape

    form = "" if found.format is None else f" ({found.format})"
    state = "[green]nothing is wrong[/]" if found.ok else f"[red]{counted(len(found.findings), 'problem')}[/]"
    out.print(f"[bold]{escape(found.name)}[/]{form}: {state}")
    if found.conventions:
        out.print(f"  read as: {escape(found.conventions)}", soft_wrap=True)
    for note in found.notes:
        out.print(f"  note: {escape(note)}", soft_wrap=True)
    for finding in found.findings:
        color = "red" if finding.kind == "error" else "yellow"
        out.print(
            f"  [{color}]{finding.kind}[/] {escape(finding.topic)}: {escape(str(finding))}",
            soft_wrap=True,
        )
    if found.facts is not None:
        shares = ("masked_share", "specular_share", "saturated_share")
        told = ", ".join(f"{name.removesuffix('_share')} {found.facts[name]:.1%}" for name in shares)
        out.print(f"  {counted(found.facts['frames'], 'frame')}; pixels {told}")


def _known(name: str) -> Descriptor | None:
    """The catalogue's entry; None for a path."""
    from data_catalog import describe

    try:
        return describe(name)
    except UnknownSequenceError:
        return None


def _ingest(given: argparse.Namespace) -> IngestConfig:
    from flows.settings import pipeline_config

    return pipeline_config(given.profile, given.settings).ingest


def _write_picture(sequence: EndoscopicSequence, target: Path) -> None:
    from PIL import Image

    from data_catalog.inspection import contact_sheet

    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(target) as unfinished:
            Image.fromarray(contact_sheet(sequence)).save(unfinished)
    except (OSError, ValueError) as error:
        raise StoreError(f"{target} cannot be written: {reason_of(error)}") from error


def _listed(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _figure(name: str, value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_figure(key, part)}" for key, part in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name.endswith("_share"):
        return f"{value:.2%}"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
