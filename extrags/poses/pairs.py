"""Which pairs of frames are matched."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Int

__all__ = ["registration_pairs", "spread_evenly", "training_pairs"]

Pair = tuple[int, int]


def training_pairs(
    train: Int[np.ndarray, "n_train"],
    recording: Int[np.ndarray, "f"],
    *,
    exhaustive_below: int,
    sequential_overlap: int,
) -> list[Pair]:
    """Pairs of training frames to match.

    All of them when there are at most `exhaustive_below` frames. Else, within each recording, neighbours
    up to `sequential_overlap` frames apart and those 2^k apart, which bridge short failures; and all
    pairs of `exhaustive_below` frames spread evenly over everything, which close loops and join
    recordings.

    Args:
        train: indices of the training frames, in the order of time.
        recording: recording of every frame of the sequence.
        exhaustive_below: see above.
        sequential_overlap: see above.

    Returns:
        Pairs (i, j) with i before j in `train`, sorted, none twice.
    """
    if len(train) <= exhaustive_below:
        return [(int(i), int(j)) for i, j in combinations(train, 2)]
    pairs: set[Pair] = set()
    for number in np.unique(recording[train]):
        members = train[recording[train] == number]
        offsets = set(range(1, sequential_overlap + 1))
        offsets |= {1 << k for k in range(len(members).bit_length())}
        for offset in offsets:
            pairs |= {(int(i), int(j)) for i, j in zip(members, members[offset:], strict=False)}
    pairs |= {(int(i), int(j)) for i, j in combinations(spread_evenly(train, exhaustive_below), 2)}
    return sorted(pairs)


def registration_pairs(
    held_out: Int[np.ndarray, "n_test"],
    mapped: Int[np.ndarray, "n_mapped"],
    recording: Int[np.ndarray, "f"],
    *,
    exhaustive_below: int,
    sequential_overlap: int,
) -> list[Pair]:
    """Pairs (held-out frame, mapped training frame) to match; never two held-out frames.

    All mapped frames when there are at most `exhaustive_below`. Else the nearest
    `2 * sequential_overlap` in time of the same recording, and `exhaustive_below` spread evenly.
    """
    if len(mapped) <= exhaustive_below:
        return [(int(i), int(j)) for i in held_out for j in mapped]
    spread = spread_evenly(mapped, exhaustive_below)
    pairs: set[Pair] = set()
    for frame in held_out:
        same = mapped[recording[mapped] == recording[frame]]
        nearest = same[np.argsort(np.abs(same - frame), kind="stable")][: 2 * sequential_overlap]
        pairs |= {(int(frame), int(other)) for other in (*nearest, *spread)}
    return sorted(pairs)


def spread_evenly(frames: Int[np.ndarray, "n"], count: int) -> Int[np.ndarray, "m"]:
    """At most `count` of the frames, the first and the last among them."""
    if len(frames) <= count:
        return frames
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(np.int64))
    return np.asarray(frames[chosen])
