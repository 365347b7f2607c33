"""Order of frames by the numbers in their names."""

from __future__ import annotations

import logging
import random
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import pytest

from extrags.frame_names import NameOrder, file_key, natural_key, order_for_fingerprint, tell_about_order


def test_natural_order() -> None:
    names = ["f10.png", "f9.png", "f09b.png", "f1.png", "a.png"]
    assert sorted(names, key=natural_key) == ["a.png", "f1.png", "f9.png", "f09b.png", "f10.png"]


def test_a_suffix_has_no_place_in_the_order() -> None:
    """Windows numbers copies so; the first was read last, as a blank comes before a dot."""
    names = ["frame.png", "frame (0).png", "frame (2).JPG", "frame (10).png", "frame-1.png"]
    assert sorted(set(names), key=file_key) == names
    assert sorted(["b.2", "b.10", "b"], key=file_key) == ["b", "b.2", "b.10"]
    assert sorted(["7.png", "007.png"], key=file_key) == ["007.png", "7.png"]


def test_an_order_counts_in_a_cache_key_where_it_was_another() -> None:
    assert order_for_fingerprint(["f10.png", "f9.png", "f_1.jpg", "f1.png"]) == {}
    assert order_for_fingerprint(["f (2).png", "f.png"]) == {"order": "without suffixes"}


def named(count: int, name: Callable[[int], str]) -> list[str]:
    return [f"{name(k)}.png" for k in range(count)]


def shuffled(names: list[str]) -> list[str]:
    return random.Random(0).sample(names, len(names))


def uneven_times() -> list[str]:
    """Times of a recorder as Python writes them: zeros at the end are dropped."""
    drawn = random.Random(0)
    return named(120, lambda k: repr(round(1305031102 + k / 30 + drawn.uniform(0, 0.02), 6)))


DECIMALS = {
    "zeros dropped": named(60, lambda k: f"{k * 0.05:g}"),
    "unit behind": named(60, lambda k: f"t{k * 0.05:g}s"),
    "one digit or none": named(30, lambda k: f"t{k * 0.1:g}s"),
    "inexact": named(60, lambda k: str(k * 0.05)),
    "quarters": named(30, lambda k: f"{k * 0.25:g}"),
    "four quarters": named(4, lambda k: f"{k * 0.25:g}"),
    "eighths": named(30, lambda k: f"{k * 0.125:g}"),
    "rounded": named(90, lambda k: f"f_{round(k / 30, 3):g}"),
    "within a second": named(17, lambda k: f"{12.1 + k * 0.05:g}"),
    "no zero in front": [name for name in uneven_times() if ".0" not in name],
    "frames missing": [name for k, name in enumerate(named(90, lambda k: f"{k * 0.05:g}")) if k % 29 != 7],
    "two cameras": [f"cam{camera}_{k * 0.05:g}.png" for camera in (1, 2) for k in range(40)],
    "folders": [f"{camera}/{k * 0.05:g}.png" for camera in "ab" for k in range(40)],
    "depth beside": [f"{k * 0.05:g}{kind}.png" for k in range(40) for kind in ("", "_depth")],
}
COUNTS = {
    "series": named(12, lambda k: f"frame_1.{k}"),
    "three of them": ["1.9.png", "1.10.png", "1.11.png"],
    "tenth missing": [name for name in named(13, lambda k: f"1.{k}") if name not in ("1.0.png", "1.10.png")],
    "every tenth from the fifth": named(13, lambda k: f"s1.{5 + 10 * k}"),
    "odd": named(26, lambda k: f"1.{7 + 2 * k}"),
    "several series": [f"s{series}.{k}.png" for series in (1, 2, 3) for k in range(1, 25)],
    "padded too little": named(129, lambda k: f"1.{k:02d}"),
    "identifier": named(12, lambda k: f"1.2.840.113.{k + 1}"),
    "point behind text": named(12, lambda k: f"scan.{k + 1}"),
    "numbers without point": named(12, lambda k: f"0000{k // 6}-21711-frame-{14626 + k}"),
    "time of day": named(90, lambda k: f"2026-01-01 10.{k // 60}.{k % 60}"),
    "version in front": named(30, lambda k: f"v1.2_{k}"),
}


@pytest.mark.parametrize("names", DECIMALS.values(), ids=DECIMALS)
def test_decimals_have_their_place(names: list[str]) -> None:
    order = NameOrder(reversed(names))
    assert sorted(names, key=natural_key) != names
    assert sorted(shuffled(names), key=order.key) == names
    assert order.doubtful is None
    assert order_for_fingerprint(names) == {"order": "decimals"}


@pytest.mark.parametrize("names", COUNTS.values(), ids=COUNTS)
def test_counts_stay_counts(names: list[str]) -> None:
    order = NameOrder(reversed(names))
    assert sorted(shuffled(names), key=order.key) == names
    assert order.doubtful is None
    assert order_for_fingerprint(names) == {}


def test_times_with_pauses_are_decimals() -> None:
    """Five gaps in 46 frames were too many for even steps, and the frames were told to be several series."""
    paused = [0.0] * 20 + [3.0] * 15 + [13.0] * 15
    times = [1700000000 + k / 10 + paused[k] for k in range(50) if k not in (10, 11, 24, 30)]
    names = [f"{time:.6f}" for time in times]
    order = NameOrder(names)
    assert [order.number(name) for name in names] == [Decimal(name) for name in names]
    pairs = [f"{series}.{k:02d}.png" for series in range(1, 9) for k in (1, 2)]
    assert [NameOrder(pairs).number(name) for name in pairs] == [Decimal(1), Decimal(2)] * 8


def test_hexadecimal_numbers_have_their_place() -> None:
    """0a to 0f were read before 04, as numbers without digits before them."""
    names = named(20, lambda k: f"{k + 4:02x}")
    assert sorted(shuffled(names), key=NameOrder(names).key) == names
    assert order_for_fingerprint(names) == {"order": "hexadecimal"}
    assert [NameOrder(names).number(name) for name in names] == [Decimal(k + 4) for k in range(20)]
    paths = [f"{folder}/{k:03X}.png" for folder in ("p2", "p10") for k in range(8, 20)]
    assert sorted(shuffled(paths), key=NameOrder(paths).key) == paths


@pytest.mark.parametrize(
    "names",
    [
        ["9.png", "0a.png", "10.png"],
        ["09.png", "10.png"],
        ["f9.png", "f10.png"],
        ["0a.png", "04.png", "0g.png"],
        ["bad.png", "fed.png"],
        ["a1.png", "b1.png", "c2.png"],
    ],
)
def test_other_names_are_no_hexadecimal_numbers(names: list[str]) -> None:
    assert sorted(names, key=NameOrder(names).key) == sorted(names, key=file_key)
    assert not NameOrder(names).is_hexadecimal


def test_each_folder_and_each_kind_of_name_decides_for_itself() -> None:
    moments, series = DECIMALS["zeros dropped"], COUNTS["series"]
    names = [*(f"a/{name}" for name in moments), *(f"b/{name}" for name in series)]
    assert sorted(shuffled(names), key=NameOrder(names).key) == names
    together = [*series, *moments]
    assert sorted(shuffled(together), key=NameOrder(together).key) == together


def test_what_nothing_tells_is_counted_and_told(caplog: pytest.LogCaptureFixture) -> None:
    names = ["1.3.png", "1.7.png", "1.25.png"]
    order = NameOrder(names)
    assert sorted(names, key=order.key) == names
    assert sorted(names, key=order.other_key) == ["1.25.png", "1.3.png", "1.7.png"]
    with caplog.at_level(logging.WARNING):
        tell_about_order(Path("scan"), order)
    assert "scan: 1.7.png is read before 1.25.png" in caplog.text
    caplog.clear()
    tell_about_order(Path("scan"), NameOrder(DECIMALS["quarters"]))
    assert not caplog.records


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (named(24, lambda k: f"frame_{k / 10:.1f}"), ["0.0", "0.1", "0.2"]),
        (named(24, lambda k: f"frame_{k * 0.05:g}"), ["0", "0.05", "0.1"]),
        (named(24, lambda k: f"s{1 + k // 12}.{1 + k % 12:02d}"), ["1", "2", "3"]),
        (named(9, lambda k: f"cam2_{k:03d}"), ["0", "1", "2"]),
    ],
)
def test_numbers_of_frames(names: list[str], numbers: list[str]) -> None:
    order = NameOrder(names)
    assert [str(order.number(name)) for name in names[:3]] == numbers
    assert NameOrder(["a"]).number("a") is None


def test_all_numbers_of_a_name() -> None:
    order = NameOrder(["cut2_0.05.png", "cut2_0.1.png", "cut2_0.15.png", "v1.2.3_9.png"])
    assert order.numbers("cut2_0.05.png") == (2, Decimal("0.05"))
    assert order.numbers("v1.2.3_9.png") == (1, 2, 3, 9)
    assert order.numbers("none.png") == ()
