"""Tables in terminals of any width; names in files of others, which do not steer the terminal."""

from __future__ import annotations

import io
import logging
from argparse import Namespace
from pathlib import PurePosixPath
from types import SimpleNamespace

import pytest
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from extrags.errors import SourceError
from flows.cli import main
from flows.commands.common import StandardErrorHandler, showing
from flows.printable import PrintableFormatter, printable
from flows.tables import markdown_table
from flows.terminal import console, print_table

EVIL = "a\x1b]0;title\x07\x1b[2J\x9b1A\r\u202eb"
SHOWN = r"a\x1b]0;title\x07\x1b[2J\x9b1A\r\u202eb"


def test_what_a_terminal_obeys_is_shown() -> None:
    assert printable(EVIL) == SHOWN
    assert printable("Polyp 3, 大腸\tα\n– ✓") == "Polyp 3, 大腸\tα\n– ✓"  # noqa: RUF001


@pytest.mark.parametrize("what", ["words", "text", "table"])
def test_on_the_console(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    out = console()
    monkeypatch.setattr(out, "file", io.StringIO())
    table = Table("name", "next")
    table.add_row(escape(EVIL), Text(EVIL))
    out.print({"words": escape(EVIL), "text": Text(EVIL), "table": table}[what])
    written = out.file.getvalue()  # type: ignore[attr-defined]
    assert r"\x1b[2J\x9b1A" in written
    assert not any(letter in written for letter in "\x1b\x07\x9b\r\u202e")


def test_colours_of_the_console_itself_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    out = console()
    monkeypatch.setattr(out, "file", io.StringIO())
    monkeypatch.setattr(out, "_color_system", 1)
    out.print("[red]no[/]")
    assert "\x1b[31mno\x1b[0m" in out.file.getvalue()  # type: ignore[attr-defined]


def test_a_name_is_no_emoji(monkeypatch: pytest.MonkeyPatch) -> None:
    out = console()
    monkeypatch.setattr(out, "file", io.StringIO())
    out.print("scan:a:1")
    assert out.file.getvalue() == "scan:a:1\n"  # type: ignore[attr-defined]


def test_in_errors(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "validate", EVIL]) == 2
    assert "\x1b" not in capsys.readouterr().err
    assert main(["data", "check", f"/nowhere/{EVIL}"]) != 0
    written = capsys.readouterr()
    assert "\x1b" not in written.err + written.out


def test_in_the_log() -> None:
    record = logging.makeLogRecord({"msg": "frame %s\n  of", "args": (EVIL,)})
    assert PrintableFormatter("%(message)s").format(record) == f"frame {SHOWN}\n  of"


BROKEN = "scan\n1\rof 2"
"""Folders can be called so."""


def test_a_name_with_line_breaks_stays_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    out = console()
    monkeypatch.setattr(out, "file", io.StringIO())
    table = Table("name", "next", box=None)
    table.add_row(escape(BROKEN), "ok")
    print_table(out, table)
    out.print(f"{BROKEN}: failed", markup=False)
    heads, row, line = out.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert heads.split() == ["name", "next"]
    assert row.split("  ")[0].strip() == r"scan\n1\rof 2"
    assert line == r"scan\n1\rof 2: failed"


def test_a_name_with_line_breaks_stays_in_its_row_of_a_page() -> None:
    assert markdown_table(["name"], [[BROKEN]]).splitlines()[2:] == [r"| scan\n1\rof 2 |"]


@pytest.mark.parametrize("given", [BROKEN, PurePosixPath(BROKEN), SourceError("no", file=BROKEN)])
def test_a_name_with_line_breaks_stays_in_its_line_of_the_log(given: object) -> None:
    record = logging.makeLogRecord({"msg": "%s: %d frames", "args": (given, 3)})
    (line,) = PrintableFormatter("%(message)s").format(record).splitlines()
    assert r"scan\n1\rof 2" in line
    assert record.args == (given, 3)


def test_a_name_with_line_breaks_stays_in_its_line_of_errors(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "validate", BROKEN]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_log_goes_where_standard_error_goes_at_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The display of a run takes its place: a line that went past it was drawn over, and left parts of it."""
    handler = StandardErrorHandler()
    display = io.StringIO()
    monkeypatch.setattr("sys.stderr", display)
    handler.handle(logging.LogRecord("", logging.WARNING, "", 0, "said", None, None))
    assert display.getvalue() == "said\n"


@pytest.mark.parametrize(
    ("terminal", "kind", "shown"),
    [(True, "xterm", "terminal"), (True, "dumb", "log"), (False, "xterm", "log")],
)
def test_a_terminal_that_cannot_draw_gets_lines_of_progress(
    terminal: bool, kind: str, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", SimpleNamespace(isatty=lambda: terminal))
    monkeypatch.setenv("TERM", kind)
    assert showing(Namespace(quiet=False)) == shown


def narrow_table() -> Table:
    made = Table(box=None, pad_edge=False)
    made.add_column("sequence", no_wrap=True)
    made.add_column("size")
    made.add_column("here")
    made.add_column("description", overflow="fold")
    made.add_row("c3vdv2/c1_cecum_t1@sparse", "1350x1080", "[green]yes[/]", "registered videos")
    made.add_row("phantom/0@sparse", "", "no", "")
    return made


def printed(width: int) -> str:
    out = Console(width=width)
    with out.capture() as captured:
        print_table(out, narrow_table())
    return captured.get()


@pytest.mark.parametrize("width", [20, 40, 60, 120])
def test_no_word_is_shortened_or_left_out(width: int) -> None:
    said = printed(width)
    assert "…" not in said
    words = ("c3vdv2/c1_cecum_t1@sparse", "1350x1080", "yes", "registered", "phantom/0@sparse")
    assert all(word in said for word in words)


def test_rows_are_lines_where_the_terminal_is_too_narrow() -> None:
    assert printed(40).splitlines() == [
        "c3vdv2/c1_cecum_t1@sparse: size 1350x1080, here yes, description registered videos",
        "phantom/0@sparse: here no",
    ]
    assert printed(120).startswith("sequence ")
