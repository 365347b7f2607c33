"""Exact quantiles of values that lie frame by frame."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.frame_quantiles import median_of_frames, quantile_of_frames


def frames_of(seed: int, sizes: tuple[int, ...]) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    return [np.exp(generator.normal(0, 3, size)).astype(np.float32) for size in sizes]


@pytest.mark.parametrize("sizes", [(1,), (2,), (5, 0, 6), (40, 39), (1000, 3000, 500), (1, 1, 1)])
def test_as_numpy_finds_them(sizes) -> None:
    frames = frames_of(len(sizes), sizes)
    together = np.concatenate(frames)
    assert median_of_frames(lambda: frames) == np.median(together)
    for share in (0.0, 0.01, 0.25, 0.5, 0.999, 1.0):
        assert quantile_of_frames(lambda: frames, share) == np.quantile(together, share)


def test_values_that_are_all_alike_and_extremes() -> None:
    alike = [np.full(7, 3.25, np.float32), np.full(4, 3.25, np.float32)]
    assert median_of_frames(lambda: alike) == 3.25
    assert quantile_of_frames(lambda: alike, 0.9) == 3.25
    limits = np.finfo(np.float32)
    extremes = [np.array([limits.max, limits.tiny, 1], np.float32), np.array([np.inf, 2], np.float32)]
    assert median_of_frames(lambda: extremes) == 2
    assert quantile_of_frames(lambda: extremes, 0.0) == limits.tiny


def test_nothing() -> None:
    assert median_of_frames(list) is None
    assert quantile_of_frames(lambda: [np.zeros(0, np.float32)], 0.5) is None


def test_frames_are_taken_one_at_a_time() -> None:
    """Each is dropped before the next is made: the sum of all never lies in memory."""
    import weakref

    alive: list[weakref.ref] = []

    def frames():
        for seed in range(6):
            assert sum(ref() is not None for ref in alive) <= 1
            values = frames_of(seed, (100,))[0]
            alive.append(weakref.ref(values))
            yield values
            del values

    median_of_frames(frames)
    assert len(alive) == 12
