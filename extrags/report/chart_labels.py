"""Names of the rows of a chart, short enough to leave room for what is drawn, and told apart."""

from __future__ import annotations

import re
from collections.abc import Sequence

from extrags.escaped_text import escaped

__all__ = ["LONGEST_LABEL", "drawable", "row_labels"]

LONGEST_LABEL = 41
SHORTEST_END = 12
_NOT_DRAWN = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
"""Control characters but for the line feed, and what is no character: no SVG holds them, no font has them."""


def drawable(text: str) -> str:
    r"""The text with `\x1b`, as Python writes it, in place of each character that no chart can hold.

    Folders on disks of others can be named with any bytes.
    """
    return escaped(text, _NOT_DRAWN)


def row_labels(names: Sequence[str]) -> list[str]:
    """A label of at most `LONGEST_LABEL` letters for each name; different names have different labels.

    Long names lose their middle. Where they are then alike, what they share is shortened first; those that
    still coincide are numbered.

    Args:
        names: of the rows.
    """
    label_of = {name: _cut(_in_one_line(name), LONGEST_LABEL) for name in names}
    for alike in _coinciding(label_of):
        label_of |= dict(zip(alike, _without_shared([_in_one_line(name) for name in alike]), strict=True))
    for alike in _coinciding(label_of):
        taken = set(label_of.values())
        for name in alike[1:]:
            number = 2
            while (label := _numbered(label_of[name], number)) in taken:
                number += 1
            taken.add(label)
            label_of[name] = label
    return [label_of[name] for name in names]


def _in_one_line(text: str) -> str:
    return drawable(text).replace("\n", "\\n")


def _cut(text: str, length: int) -> str:
    """A text without its middle; its beginning and its end tell the most."""
    if len(text) <= length:
        return text
    kept = max(0, length - 1)
    end = kept // 2
    return f"{text[: kept - end]}…{text[len(text) - end :]}"


def _coinciding(label_of: dict[str, str]) -> list[list[str]]:
    """Names of one label, where there are several."""
    by_label: dict[str, list[str]] = {}
    for name, label in label_of.items():
        by_label.setdefault(label, []).append(name)
    return [names for names in by_label.values() if len(names) > 1]


def _without_shared(names: Sequence[str]) -> list[str]:
    """Labels that keep what the names differ in, and as much of their common beginning and end as fits."""
    begin = _alike(names)
    room = min(map(len, names)) - begin
    end = min(room, _alike([name[::-1] for name in names]))
    own = [name[begin : len(name) - end] for name in names]
    spare = LONGEST_LABEL - max(map(len, own))
    if spare < 2:
        return [_cut(part, LONGEST_LABEL) for part in own]
    # The beginning loses less: it holds the name of the sequence.
    before = min(begin, spare - min(end, SHORTEST_END, spare // 2))
    after = min(end, spare - before)
    head, tail = names[0][:begin], names[0][len(names[0]) - end :]
    return [f"{_cut(head, before)}{part}{_cut(tail, after)}" for part in own]


def _alike(names: Sequence[str]) -> int:
    """So many letters all names begin with."""
    return next(
        (place for place, letters in enumerate(zip(*names, strict=False)) if len(set(letters)) > 1),
        min(map(len, names)),
    )


def _numbered(label: str, number: int) -> str:
    mark = f" ({number})"
    return f"{_cut(label, LONGEST_LABEL - len(mark))}{mark}"
