"""Which pairs of frames are matched."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

__all__ = ["neighbouring_pairs", "registration_pairs", "spread_evenly", "training_pairs"]

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


def neighbouring_pairs(
    train: Int[np.ndarray, "n_train"], world_from_camera: Float[np.ndarray, "f 4 4"], *, neighbours: int
) -> list[Pair]:
    """Pairs of training frames that stand near each other and look the same way, whatever their order.

    A distance between centres as long as the median distance of a frame from its `neighbours`-th weighs as
    much as a turn by one radian: photographs of an object are not in the order of any path.

    Args:
        train: indices of the training frames.
        world_from_camera: poses of all frames.
        neighbours: frames that each frame is paired with.

    Returns:
        Pairs (i, j) with i before j in `train`, sorted, none twice.
    """
    count = min(neighbours, len(train) - 1)
    if count < 1:
        return []
    poses = world_from_camera[train]
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1)
    turn = np.arccos(np.clip(poses[:, :3, 2] @ poses[:, :3, 2].T, -1, 1))
    unit = float(np.median(np.sort(apart, axis=1)[:, count]))
    far = apart / max(unit, 1e-12) + turn
    np.fill_diagonal(far, np.inf)
    nearest = np.argsort(far, axis=1, kind="stable")[:, :count]
    places = {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row}
    return sorted((int(train[i]), int(train[j])) for i, j in places)


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
