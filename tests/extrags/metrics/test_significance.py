"""Noise of changes against scipy's t tests, and what is pooled."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from extrags.metrics.significance import Change, changes_over_sequences, judge_changes


def change(
    differences: np.ndarray, *, sequence: str = "phantom/0", quantity: str = "psnr", kind: str = "dB"
) -> Change:
    """Of pairs, positive is worse; of times, of logarithms."""
    n = len(differences)
    return Change(
        about=dict.fromkeys(("profile", "budget", "setting", "width", "height"))
        | {"method": "coarse", "sequence": sequence},
        quantity=quantity,
        kind=kind,
        paired=True,
        n=n,
        before=20.0,
        after=20.0 - float(differences.mean()),
        primary=True,
        logarithms=kind == "cost",
        change=float(differences.mean()),
        variance=float(differences.var(ddof=1)) if n > 1 else None,
        freedom=n - 1,
        share=1 / n,
        differences=tuple(differences.tolist()),
    )


def pairs(seed: int, n: int, deviation: float = 1.0, mean: float = 0.3) -> np.ndarray:
    return np.random.default_rng(seed).normal(mean, deviation, n)


def test_enough_pairs_are_a_t_test_of_their_own() -> None:
    samples = [pairs(0, 6), pairs(1, 8, deviation=0.1)]
    rows = [change(sample, sequence=f"phantom/{k}") for k, sample in enumerate(samples)]
    judge_changes(rows)
    for row, sample in zip(rows, samples, strict=True):
        expected = stats.ttest_1samp(sample, 0).confidence_interval(0.95)
        assert (row.low, row.high) == pytest.approx((expected.low, expected.high))
        assert row.p_worse == pytest.approx(stats.ttest_1samp(sample, 0, alternative="greater").pvalue)
        assert row.p_better == pytest.approx(stats.ttest_1samp(sample, 0, alternative="less").pvalue)


def test_over_all_sequences_every_pair_is_one_of_a_sample() -> None:
    samples = [pairs(2, 2), pairs(3, 3), pairs(4, 1)]
    (row,) = changes_over_sequences(
        [change(sample, sequence=f"phantom/{k}") for k, sample in enumerate(samples)]
    )
    judge_changes([row])
    whole = np.concatenate(samples)
    expected = stats.ttest_1samp(whole, 0).confidence_interval(0.95)
    assert row.n == 6
    assert row.change == pytest.approx(whole.mean())
    assert (row.low, row.high) == pytest.approx((expected.low, expected.high))
    assert row.before == 20.0
    assert row.after == pytest.approx(20.0 - np.mean([sample.mean() for sample in samples]))


@pytest.mark.parametrize(("groups", "times"), [(2, 2), (3, 3), (6, 4)])
def test_few_pairs_have_the_noise_of_all_groups_and_room_for_being_the_noisiest(
    groups: int, times: int
) -> None:
    """A group of two has at most all of the noise; one of many up to twice the pooled deviation."""
    samples = [pairs(10 + k, 3) for k in range(groups)]
    # One without any noise is as much of the pool as the others.
    samples[-1] = np.full(3, 0.25)
    rows = [change(sample, sequence=f"phantom/{k}") for k, sample in enumerate(samples)]
    judge_changes(rows)
    within = np.concatenate([sample - sample.mean() for sample in samples])
    pooled = float((within**2).sum()) / (2 * groups)
    for row, sample in zip(rows, samples, strict=True):
        variance = max(times * pooled, sample.var(ddof=1))
        expected = stats.t.interval(0.95, 2 * groups, sample.mean(), np.sqrt(variance / 3))
        assert (row.low, row.high) == pytest.approx(expected)


def test_a_group_noisier_than_its_pool_keeps_its_own_noise() -> None:
    samples = [pairs(20, 3, deviation=9.0), *(pairs(21 + k, 3, deviation=0.01) for k in range(5))]
    rows = [change(sample, sequence=f"phantom/{k}") for k, sample in enumerate(samples)]
    judge_changes(rows)
    # Of six groups of equal weight it would be a sixth of its variance, four times.
    expected = stats.t.interval(0.95, 12, samples[0].mean(), samples[0].std(ddof=1) / np.sqrt(3))
    assert (rows[0].low, rows[0].high) == pytest.approx(expected)


def test_times_have_the_noise_of_the_machine_as_well() -> None:
    """Of known size: a tenth. It is added once, since pairs of one sitting share it."""
    sample = pairs(30, 7, deviation=0.2)
    row = change(sample, quantity="seconds", kind="cost")
    memory = change(sample, quantity="peak_mib", kind="cost")
    judge_changes([row, memory])
    own = sample.var(ddof=1) / 7
    whole = own + 0.1**2
    freedom = whole**2 / (own**2 / 6)
    expected = stats.t.interval(0.95, freedom, sample.mean(), np.sqrt(whole))
    assert (row.low, row.high) == pytest.approx(expected)
    assert row.low is not None
    assert row.to_json()["interval"][0] == pytest.approx(np.exp(row.low) - 1)
    plain = stats.ttest_1samp(sample, 0).confidence_interval(0.95)
    assert (memory.low, memory.high) == pytest.approx((plain.low, plain.high))


def test_the_threshold_is_holms() -> None:
    """Of three, the level of 2 % is first divided by three, then by two, then by none."""

    def with_chance(chance: float) -> Change:
        """Pairs that are worse by the quantile of a chance, in decibels that matter."""
        shape = np.array([-1.0, -0.5, 0.0, 0.5, 1.0]) * 2
        error = shape.std(ddof=1) / np.sqrt(5)
        return change(shape + float(stats.t.isf(chance, 4)) * error)

    def found_worse(*chances: float) -> list[bool]:
        rows = [with_chance(chance) for chance in chances]
        judge_changes(rows)
        assert [row.p_worse for row in rows] == pytest.approx(chances)
        return [row.verdict == "worse" for row in rows]

    third = 0.02 / 3
    assert found_worse(0.99 * third, 0.0099, 0.0199) == [True, True, True]
    assert found_worse(1.01 * third, 0.0099, 0.0199) == [False, False, False]
    assert found_worse(0.0199, 0.0101, 0.99 * third) == [False, False, True]
    assert found_worse(0.0199) == [True]
    assert found_worse(0.0201) == [False]


def test_the_least_change_that_could_be_found_is_the_threshold_of_the_first() -> None:
    sample = pairs(40, 9)
    row, other = change(sample), change(pairs(41, 9), sequence="phantom/1")
    judge_changes([row, other])
    error = sample.std(ddof=1) / 3
    assert row.least == pytest.approx(float(stats.t.isf(0.02 / 2, 8)) * error)
