"""Which pairs are matched."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from extrags.poses.pairs import registration_pairs, spread_evenly, training_pairs


def test_all_pairs_of_a_short_sequence() -> None:
    train = np.array([0, 2, 3, 7])
    pairs = training_pairs(train, np.zeros(8, dtype=np.int64), exhaustive_below=4, sequential_overlap=1)
    assert pairs == list(combinations([0, 2, 3, 7], 2))


def test_a_long_sequence_has_neighbours_bridges_and_loops() -> None:
    train = np.arange(200)
    recording = np.repeat([0, 1], 100)
    pairs = training_pairs(train, recording, exhaustive_below=10, sequential_overlap=3)
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)
    assert {(50, 51), (50, 53), (50, 54), (50, 58), (50, 82)} <= set(pairs)
    assert (50, 55) not in pairs
    assert (98, 101) not in pairs
    # Frames spread over both recordings close loops and join them.
    assert (0, 199) in pairs
    assert len(pairs) < 200 * 11


def test_held_out_frames_meet_mapped_frames_only() -> None:
    held_out, mapped = np.array([1, 4]), np.array([0, 2, 3])
    recording = np.zeros(5, dtype=np.int64)
    pairs = registration_pairs(held_out, mapped, recording, exhaustive_below=3, sequential_overlap=1)
    assert pairs == [(1, 0), (1, 2), (1, 3), (4, 0), (4, 2), (4, 3)]

    mapped = np.arange(0, 400, 2)
    recording = np.zeros(500, dtype=np.int64)
    recording[400:] = 1
    pairs = registration_pairs(
        np.array([101, 450]), mapped, recording, exhaustive_below=20, sequential_overlap=2
    )
    assert {(101, 98), (101, 100), (101, 102), (101, 104)} <= set(pairs)
    assert {j for i, j in pairs if i == 450} == set(spread_evenly(mapped, 20).tolist())
    assert {j for _, j in pairs} <= set(mapped.tolist())


def test_spread_holds_both_ends() -> None:
    spread = spread_evenly(np.arange(7, 1007), 60)
    assert len(spread) == 60
    assert (spread[0], spread[-1]) == (7, 1006)
    assert spread_evenly(np.arange(5), 60).tolist() == [0, 1, 2, 3, 4]
