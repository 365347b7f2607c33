"""Names of image files: their suffixes, and the order of frames that the numbers in names tell.

Runs of digits are numbers: 9 comes before 10. Where two runs are joined by a point, as in `0.5` and `0.15`,
they are two counts (0.5 comes before 0.15: frames 5 and 15 of series 0) or one decimal number (0.15 comes
before 0.5). One name does not say which; the names of a folder do (`NameOrder`). So do they where all are
hexadecimal numbers: `0a` comes behind `09`, and not before `04`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import groupby, pairwise
from math import gcd
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

__all__ = [
    "COLOR_SUFFIXES",
    "NameOrder",
    "file_key",
    "is_gap",
    "names_in_folders",
    "natural_key",
    "order_for_fingerprint",
    "tell_about_order",
    "usual_step",
]

logger = logging.getLogger(__name__)

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

_NUMBER = re.compile(r"\d+(?:\.\d+)*")
_HEXADECIMAL = re.compile(r"[0-9a-fA-F]+")
_JOINED = re.compile(r"\d\.\d")
_FEWEST_STEPS = 3
"""Fewer tell nothing of a spacing."""
_EVEN_SHARE = 0.9
_LONG_FRACTION = 3
"""Digits of uneven numbers, always as many, from which on they are times: counts would be consecutive."""
_MANY = 44
"""Counts among which none ends in 0 by chance with a probability below 1 %."""

_Key = tuple[tuple[int, int, str], ...]
_Pattern = tuple[str, tuple[str, ...]]
_Reading = Literal["decimals", "counts"]
_NO_COUNT: _Key = ((1, -1, ""),)


def natural_key(name: str) -> _Key:
    """Sort key that reads runs of digits as numbers: `9_color.png` comes before `10_color.png`."""
    parts = re.split(r"(\d+)", name)
    # Digits are compared as text of their length: numbers of any length, and of any script, have a place.
    digits = [part.lstrip("0") if part.isdecimal() else None for part in parts]
    return tuple(
        (0, 0, part) if number is None else (1, len(number), number)
        for part, number in zip(parts, digits, strict=True)
        if part
    )


def file_key(name: str) -> tuple[_Key, str]:
    """Sort key of an image's name or path: by `natural_key` without suffix, `a.png` before `a (2).png`."""
    return natural_key(_stem(name)), name


@dataclass(frozen=True)
class _Parted:
    """A name without suffix, parted at its numbers.

    Args:
        folder: with the slash behind it; empty without any.
        texts: before, between and behind the numbers; one more than these.
        numbers: runs of digits, joined by points.
    """

    folder: str
    texts: tuple[str, ...]
    numbers: tuple[str, ...]

    @classmethod
    def of(cls, name: str) -> _Parted:
        folder, slash, rest = _stem(name).rpartition("/")
        return cls(folder + slash, tuple(_NUMBER.split(rest)), tuple(_NUMBER.findall(rest)))

    @property
    def pattern(self) -> _Pattern:
        """What names of one series share."""
        return self.folder, self.texts

    def key(self, decimals: frozenset[int], counts: frozenset[int] = frozenset()) -> _Key:
        """Sort key by the numbers; `natural_key` of the name where neither is given.

        Args:
            decimals: places of numbers that are decimals.
            counts: places of numbers that are counts, of which one without a point comes first.
        """
        before, *behind = self.texts
        parts = natural_key(self.folder + before)
        for place, (number, text) in enumerate(zip(self.numbers, behind, strict=True)):
            whole, _, fraction = number.partition(".")
            if place in decimals:
                # Digits are compared from the point on; where there are none, the number is the smallest.
                parts = (*parts, *natural_key(whole), (0, 0, "."), (1, 0, fraction))
            elif place in counts:
                parts = (*parts, *natural_key(whole), (0, 0, "."), *(natural_key(fraction) or _NO_COUNT))
            else:
                parts = (*parts, *natural_key(number))
            parts = (*parts, *natural_key(text))
        return parts


class NameOrder:
    """The order of frames in which their names number them.

    Each folder decides for itself, and for each place of a number in names that are otherwise alike, whether
    numbers with a point are decimals or counts:

    - A number with several points (a version, a time of day, a DICOM identifier) is made of counts.
    - Where fractions have different numbers of digits, one that ends in 0 (`1.10` behind `1.9`) speaks for
      counts, as whoever drops zeros at the end drops all; so does one value written in two ways. A zero in
      front that others lack (`0.05` beside `0.1`) speaks for decimals, as counts are padded alike or not.
    - Else that reading holds in which the numbers are evenly spaced, of two the one without a gap. Where
      all fractions have as many digits, decimals run on from one whole number to the next, and counts
      begin anew: so they are decimals where some run on, in spite of pauses between others.
    - Of many uneven fractions of which none ends in 0, zeros were dropped: decimals.

    What is then undecided is read as counts. It is `doubtful` where that makes another order.

    Where all names are hexadecimal numbers of as many digits, some with letters and some without, they are
    such.

    Args:
        names: of images, or their paths; each counts once.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._decimal: dict[_Pattern, frozenset[int]] = {}
        self._judged: dict[_Pattern, dict[int, _Reading | None]] = {}
        self._open: dict[_Pattern, frozenset[int]] = {}
        self.doubtful: tuple[str, str] | None = None
        """Two names, the first of which is put before the second, and may come behind it."""
        distinct = sorted(set(names))
        self.is_hexadecimal = _are_hexadecimal(distinct)
        """Whether the names are hexadecimal numbers."""
        if self.is_hexadecimal:
            return
        parted = {name: _Parted.of(name) for name in distinct if _JOINED.search(name)}
        if not parted:
            return
        patterns = {item.pattern for item in parted.values() if any("." in text for text in item.numbers)}
        alike: dict[_Pattern, dict[str, _Parted]] = {pattern: {} for pattern in patterns}
        for name in distinct:
            item = parted.get(name) or _Parted.of(name)
            if item.pattern in alike:
                alike[item.pattern][name] = item
        for pattern, members in sorted(alike.items()):
            self._decide(pattern, members)

    def key(self, name: str) -> tuple[_Key, str]:
        """Sort key of one of the names."""
        if self.is_hexadecimal:
            return _hexadecimal_key(name), name
        item = _Parted.of(name)
        return item.key(self._decimal.get(item.pattern, frozenset())), name

    def other_key(self, name: str) -> tuple[_Key, str]:
        """As `key`, with what is undecided read as decimals."""
        if self.is_hexadecimal:
            return self.key(name)
        item = _Parted.of(name)
        decimal = self._decimal.get(item.pattern, frozenset()) | self._open.get(item.pattern, frozenset())
        return item.key(decimal), name

    def number(self, name: str) -> Decimal | None:
        """The last number of a name, of counts the last of them; None without any."""
        if self.is_hexadecimal:
            return Decimal(int(_last_part(name), 16))
        item = _Parted.of(name)
        if not item.numbers:
            return None
        last = item.numbers[-1]
        place = len(item.numbers) - 1
        if self._judged.get(item.pattern, {}).get(place) == "decimals":
            return Decimal(last)
        return Decimal(int(last.rpartition(".")[2]))

    def numbers(self, name: str) -> tuple[Decimal, ...]:
        """All numbers of a name: a decimal is one of them, counts that are joined by points are several."""
        if self.is_hexadecimal:
            return (Decimal(int(_last_part(name), 16)),)
        item = _Parted.of(name)
        decimals = self._decimal.get(item.pattern, frozenset())
        parts = [
            [number] if place in decimals else number.split(".") for place, number in enumerate(item.numbers)
        ]
        return tuple(Decimal(part) for number in parts for part in number)

    def _decide(self, pattern: _Pattern, members: dict[str, _Parted]) -> None:
        decimal: set[int] = set()
        undecided: set[int] = set()
        self._judged[pattern] = {}
        for place in range(len(pattern[1]) - 1):
            if not any("." in item.numbers[place] for item in members.values()):
                continue
            reading = _judged(list(members.values()), place)
            self._judged[pattern][place] = reading
            if reading == "decimals":
                decimal.add(place)
            elif reading is None:
                undecided.add(place)
        for place in sorted(undecided):
            pair = _differing(members, place)
            if pair is None:
                # Counts and decimals make one order, in which 1 comes before 1.1 whatever stands behind.
                decimal.add(place)
                undecided.discard(place)
            else:
                self.doubtful = self.doubtful or pair
        self._decimal[pattern] = frozenset(decimal)
        self._open[pattern] = frozenset(undecided)


def _are_hexadecimal(names: Sequence[str]) -> bool:
    """Whether names, without folder and suffix, are hexadecimal numbers of as many digits.

    Some have a letter, else they are decimal, and some have none, as ten of sixteen in a row: `a1` and `b1`
    are of two series.
    """
    bare = {_last_part(name) for name in names}
    return (
        len({len(name) for name in bare}) == 1
        and all(_HEXADECIMAL.fullmatch(name) for name in bare)
        and any(not name.isdecimal() for name in bare)
        and any(name.isdecimal() for name in bare)
    )


def _hexadecimal_key(name: str) -> _Key:
    folder, slash, _ = _stem(name).rpartition("/")
    # All have as many digits, and digits come before letters.
    return (*natural_key(folder + slash), (1, 0, _last_part(name).lower()))


def _last_part(name: str) -> str:
    return _stem(name).rpartition("/")[2]


def _judged(items: Sequence[_Parted], place: int) -> _Reading | None:
    """How the numbers at one place of names that are otherwise alike are to be read; None where in doubt."""
    numbers = [item.numbers[place] for item in items]
    if any(number.count(".") > 1 for number in numbers):
        return "counts"
    fractions = [fraction for _, _, fraction in (number.partition(".") for number in numbers) if fraction]
    digits = max(len(fraction) for fraction in fractions)
    shortest = min(len(fraction) for fraction in fractions)
    series: dict[tuple[str, ...], list[tuple[int, int, int | None]]] = {}
    for item, number in zip(items, numbers, strict=True):
        whole, _, fraction = number.partition(".")
        value = int(whole + fraction.ljust(digits, "0"))
        others = (*item.numbers[:place], *item.numbers[place + 1 :])
        series.setdefault(others, []).append((value, int(whole), int(fraction) if fraction else None))
    steps, onward, counted = _steps(series.values())
    varies = digits > shortest
    if varies:
        for_counts = 0 in steps or any(len(text) > 1 and text[-1] == "0" for text in fractions)
        for_decimals = any(len(text) > shortest and text[0] == "0" for text in fractions)
        if for_counts or for_decimals:
            return None if for_counts == for_decimals else "counts" if for_counts else "decimals"
    # Counts of each series begin anew: none goes on where the one before has ended.
    usual = usual_step(steps)
    begins_anew = bool(onward) and all(is_gap(step, usual) for step in onward)
    even = _is_even(steps) and not begins_anew
    even_counts = _is_even(counted)
    if even != even_counts:
        # Pauses of a recorder are gaps between decimals, and mostly begin and end at another whole number.
        usual_count = usual_step(counted)
        runs_on = not varies and any(not is_gap(step, usual_count) for step in onward)
        return "decimals" if even or runs_on else "counts"
    if even and not varies:
        return "decimals" if onward else None
    if even:
        without_gap, counts_without = _has_no_gap(steps), _has_no_gap(counted)
        return None if without_gap == counts_without else "decimals" if without_gap else "counts"
    if not varies:
        return "decimals" if digits >= _LONG_FRACTION and len(steps) >= _FEWEST_STEPS else None
    # Of every second or fifth count none need end in 0.
    shared = gcd(*counted) if counted else 0
    return "decimals" if len(fractions) >= _MANY and shared % 2 and shared % 5 else None


def _steps(
    series: Iterable[list[tuple[int, int, int | None]]],
) -> tuple[list[int], list[int], list[int]]:
    """Steps of values read as decimals, those of them to another whole number, and steps of counts."""
    steps: list[int] = []
    onward: list[int] = []
    counted: list[int] = []
    for members in series:
        ordered = sorted(members, key=lambda member: member[0])
        for (before, whole, _), (after, next_whole, _) in pairwise(ordered):
            steps.append(after - before)
            if next_whole != whole:
                onward.append(after - before)
        for _, of_whole in groupby(ordered, key=lambda member: member[1]):
            counts = sorted(count for _, _, count in of_whole if count is not None)
            counted += [after - before for before, after in pairwise(counts)]
    return steps, onward, counted


def usual_step(steps: Sequence[int]) -> int:
    """The median of steps; 0 without any."""
    return sorted(steps)[len(steps) // 2] if steps else 0


def is_gap(step: int, usual: int) -> bool:
    """Whether a step between decimals, in units of their last digit, is not the usual one, however rounded.

    Args:
        step: between two of them.
        usual: the median of all.
    """
    return abs(step - usual) > max(usual // 10, 1 if usual >= _LONG_FRACTION else 0)


def _is_even(steps: Sequence[int]) -> bool:
    usual = usual_step(steps)
    return len(steps) >= _FEWEST_STEPS and (
        sum(not is_gap(step, usual) for step in steps) >= _EVEN_SHARE * len(steps)
    )


def _has_no_gap(steps: Sequence[int]) -> bool:
    usual = usual_step(steps)
    return not any(is_gap(step, usual) for step in steps)


def _differing(members: dict[str, _Parted], place: int) -> tuple[str, str] | None:
    """Two neighbours in the order of counts that decimals have the other way round; None without any."""
    here: frozenset[int] = frozenset([place])
    ordered = sorted(members, key=lambda name: (members[name].key(frozenset(), here), name))
    keys = [members[name].key(here) for name in ordered]
    late = next((k for k in range(1, len(keys)) if keys[k] < keys[k - 1]), None)
    return None if late is None else (ordered[late - 1], ordered[late])


def _stem(name: str) -> str:
    stem, _, suffix = name.rpartition(".")
    return stem if f".{suffix.lower()}" in COLOR_SUFFIXES else name


def order_for_fingerprint(names: Iterable[str]) -> dict[str, Any]:
    """What a cache key must tell of the order of images, which is in none of their files.

    Args:
        names: of the images, or their paths.

    Returns:
        Nothing where neither suffixes nor decimals nor hexadecimal numbers make a difference to the order:
        earlier versions took suffixes into account and knew neither of the others, and their artefacts stay.
    """
    listed = sorted(sorted(names), key=natural_key)
    order = NameOrder(listed)
    if sorted(listed, key=order.key) != sorted(listed, key=file_key):
        return {"order": "hexadecimal" if order.is_hexadecimal else "decimals"}
    return {} if listed == sorted(listed, key=file_key) else {"order": "without suffixes"}


def tell_about_order(place: Path, order: NameOrder) -> None:
    """Warn where numbers with a point leave open in which order frames were recorded.

    Args:
        place: of the frames.
        order: of their names.
    """
    pair = order.doubtful
    if pair is not None:
        logger.warning(
            "%s: %s is read before %s: the numbers with a point in names of frames are taken for counts, "
            "9 before 10, but as decimal numbers they would be in another order, and nothing tells which is "
            "meant. Give all of them as many digits behind the point",
            place,
            *pair,
            extra={"topic": "order of frames", "field": "frame names"},
        )


def names_in_folders(
    names: Sequence[str], recording: Int[np.ndarray, "f"] | None, used: Int[np.ndarray, "m"]
) -> list[str]:
    """Names of frames as exporters write them: those of several recordings in folders of their own.

    Args:
        names: of all frames.
        recording: the index of each frame's recording; None where there is one.
        used: frames of either part of the split; exporters leave out the others, which do not make a
            recording of their own.

    Returns:
        `recording_N/NAME`, unless the name says a folder or all frames are of one recording.
    """
    if recording is None or len(np.unique(recording[used])) < 2:
        return list(names)
    return [
        name if "/" in name else f"recording_{int(number)}/{name}"
        for name, number in zip(names, recording, strict=True)
    ]
