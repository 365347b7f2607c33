"""Matches against a float64 reference, and independent of how the work is cut."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Int, UInt8

import extrags.poses.matching as matching_module
from extrags.poses.matching import MAX_ANGLE, MAX_RATIO, mutual_matches

Descriptors = UInt8[np.ndarray, "n 128"]


def of_unit_length(values: np.ndarray) -> Descriptors:
    """In bytes, 512 long, as COLMAP stores them."""
    long = 512 * values / np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(np.minimum(np.rint(long), 255).astype(np.uint8))


@pytest.fixture(scope="module")
def images() -> tuple[Descriptors, Descriptors]:
    """700 features, of which 400 are in the other image too, in another order and with noise."""
    rng = np.random.default_rng(3)
    first = rng.gamma(0.7, size=(700, 128))
    noise = rng.uniform(0.1, 1.2, (400, 1)) * rng.gamma(0.7, size=(400, 128))
    second = np.concatenate([first[:400] + noise, rng.gamma(0.7, size=(250, 128))])
    return of_unit_length(first), of_unit_length(second[rng.permutation(650)])


def reference(first: Descriptors, second: Descriptors) -> Int[np.ndarray, "k 2"]:
    """Feature by feature, in float64."""
    cosine = first.astype(np.float64) @ second.astype(np.float64).T / 512**2
    angle = np.arccos(np.clip(cosine, -1, 1))

    def nearest(of: np.ndarray) -> int:
        order = np.argsort(of, kind="stable")
        clear = of[order[0]] <= MAX_ANGLE and of[order[0]] < MAX_RATIO * of[order[1]]
        return int(order[0]) if clear else -1

    there = [nearest(row) for row in angle]
    back = [nearest(column) for column in angle.T]
    return np.array([(i, j) for i, j in enumerate(there) if j >= 0 and back[j] == i])


def test_they_are_those_of_the_reference(images: tuple[Descriptors, Descriptors]) -> None:
    expected = reference(*images)
    assert 100 < len(expected) < 390
    np.testing.assert_array_equal(mutual_matches(*images), expected)


def test_how_the_work_is_cut_changes_nothing(
    images: tuple[Descriptors, Descriptors], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = mutual_matches(*images)
    monkeypatch.setattr(matching_module, "_ROWS_AT_ONCE", 7)
    np.testing.assert_array_equal(mutual_matches(*images), whole)


def test_two_that_are_alike_match_nothing(images: tuple[Descriptors, Descriptors]) -> None:
    first = images[0]
    assert mutual_matches(first, first).tolist() == [[i, i] for i in range(len(first))]
    twice = np.concatenate([first, first[:1]])
    assert mutual_matches(first, twice).tolist() == [[i, i] for i in range(1, len(first))]
    assert mutual_matches(twice, first).tolist() == [[i, i] for i in range(1, len(first))]


def test_one_feature_and_none(images: tuple[Descriptors, Descriptors]) -> None:
    first = images[0]
    assert mutual_matches(first[:1], first[:1]).tolist() == [[0, 0]]
    assert mutual_matches(first, first[:0]).shape == (0, 2)
    assert mutual_matches(first[:0], first).shape == (0, 2)
