"""Tables in terminals of any width."""

from __future__ import annotations

import pytest
from rich.console import Console
from rich.table import Table

from flows.terminal import print_table


def table() -> Table:
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
        print_table(out, table())
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
