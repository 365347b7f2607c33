"""Spread and paired differences against scipy, and what counts as one sample."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy import stats

from extrags.errors import ConfigError
from extrags.metrics.comparison import compare_runs, dataset_of, figure_of, paired, spread


def run(method: str, sequence: str, seed: int, psnr: float | None, **more: Any) -> dict[str, Any]:
    metrics = {
        "psnr": psnr,
        "lpips_alex": None if psnr is None else 1 - psnr / 40,
        "observed": {"psnr": psnr},
    }
    found = {
        "method": method,
        "profile": "quick",
        "sequence": sequence,
        "setting": "sparse",
        "seed": seed,
        "metrics": metrics,
    }
    return found | more


def both(sequence: str, seed: int, psnr: float, gain: float) -> list[dict[str, Any]]:
    return [run("3dgs", sequence, seed, psnr), run("coarse", sequence, seed, psnr + gain)]


class TestSpread:
    def test_agrees_with_scipy(self) -> None:
        values = list(np.random.default_rng(0).normal(20, 2, 7))
        found = spread(values)
        expected = stats.ttest_1samp(values, 0).confidence_interval(0.95)
        assert found.mean == pytest.approx(np.mean(values))
        assert found.deviation == pytest.approx(stats.tstd(values))
        assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
        assert (found.n, found.smallest, found.largest) == (7, min(values), max(values))

    def test_one_value_has_no_deviation(self) -> None:
        found = spread([3.0])
        assert (found.mean, found.deviation, found.low, found.high) == (3.0, None, None, None)

    def test_nothing_has_no_spread(self) -> None:
        with pytest.raises(ConfigError, match="empty sample"):
            spread([])


class TestPaired:
    def test_is_the_paired_t_test(self) -> None:
        rng = np.random.default_rng(1)
        first, gains = rng.normal(20, 3, 6), rng.normal(1, 0.5, 6)
        runs = [item for seed in range(6) for item in both("phantom/0", seed, first[seed], gains[seed])]
        (row,) = compare_runs(runs, "3dgs")["paired_sequences"]
        figure = row["figures"]["psnr"]
        expected = stats.ttest_rel(first + gains, first).confidence_interval(0.95)
        assert (figure["low"], figure["high"]) == pytest.approx((expected.low, expected.high))
        assert figure["n"] == row["n_seeds"] == 6
        assert figure["better"] == (gains > 0).sum()

    def test_pairs_share_everything_but_the_method(self) -> None:
        runs = [
            run("3dgs", "phantom/0", 0, 10.0),
            run("3dgs", "phantom/0", 1, 20.0),
            run("3dgs", "phantom/0", 2, 90.0, setting="distanced"),
            run("coarse", "phantom/0", 0, 11.0),
            run("coarse", "phantom/0", 1, 22.0),
            run("coarse", "phantom/0", 2, 30.0),
            run("coarse", "phantom/0", 0, 99.0, profile="balanced"),
        ]
        assert [value for _, value in paired(runs, "coarse", "3dgs", "psnr")] == pytest.approx([1.0, 2.0])

    def test_better_knows_the_direction(self) -> None:
        runs = [item for seed, gain in enumerate((1.0, 2.0, -1.0)) for item in both("a/b", seed, 20.0, gain)]
        (row,) = compare_runs(runs, "3dgs")["paired_sequences"]
        assert row["figures"]["psnr"]["better"] == 2
        assert row["figures"]["lpips_alex"]["better"] == 2
        assert row["figures"]["lpips_alex"]["mean"] == pytest.approx(-row["figures"]["psnr"]["mean"] / 40)

    def test_sequences_are_the_sample_of_a_dataset(self) -> None:
        """Ten seeds of one sequence must not outvote the one seed of another."""
        runs = [item for seed in range(10) for item in both("phantom/0", seed, 20.0, 3.0)]
        runs += both("phantom/1", 0, 20.0, 1.0)
        runs += both("sinus/hopkins", 0, 20.0, 5.0)
        rows = {row["dataset"]: row for row in compare_runs(runs, "3dgs")["paired_datasets"]}
        figure = rows["phantom@sparse"]["figures"]["psnr"]
        assert (figure["mean"], figure["n"], figure["better"]) == (pytest.approx(2.0), 2, 2)
        assert rows["phantom@sparse"]["n_seeds"] == 10
        assert rows["sinus@sparse"]["figures"]["psnr"]["mean"] == pytest.approx(5.0)


class TestTables:
    def test_spread_of_each_method(self) -> None:
        runs = [item for seed in range(3) for item in both("phantom/0", seed, 20.0 + seed, 1.0)]
        comparison = compare_runs(runs, "3dgs")
        rows = {row["method"]: row for row in comparison["sequences"]}
        assert rows["3dgs"]["figures"]["psnr"]["mean"] == pytest.approx(21.0)
        assert rows["coarse"]["figures"]["observed.psnr"]["deviation"] == pytest.approx(1.0)
        assert "depth_absrel" not in rows["coarse"]["figures"]
        json.dumps(comparison, allow_nan=False)

    def test_failed_runs_are_left_out(self) -> None:
        runs = [*both("phantom/0", 0, 20.0, 1.0), run("coarse", "phantom/1", 0, None)]
        runs.append(run("3dgs", "phantom/1", 0, 10.0) | {"metrics": None})
        comparison = compare_runs(runs, "3dgs")
        assert [row["sequence"] for row in comparison["paired_sequences"]] == ["phantom/0"]

    def test_what_makes_no_sense_is_refused(self) -> None:
        runs = both("phantom/0", 0, 20.0, 1.0)
        with pytest.raises(ConfigError, match="no run of the baseline 'extrags'; methods here: 3dgs, coarse"):
            compare_runs(runs, "extrags")
        with pytest.raises(ConfigError, match="given twice"):
            compare_runs([*runs, runs[0]], "3dgs")

    def test_names(self) -> None:
        assert dataset_of(run("a", "phantom/3", 0, 1.0)) == "phantom@sparse"
        assert dataset_of(run("a", "phantom/3", 0, 1.0, setting=None)) == "phantom"
        assert dataset_of(run("a", "c3vdv2_sim", 0, 1.0, setting=None)) == "c3vdv2_sim"
        for path in ("/scans/left", "./left", "../left", "scans/monday/left"):
            assert dataset_of(run("a", path, 0, 1.0, setting=None)) == "files"
        assert figure_of({"a": {"b": 2}}, "a.b") == 2.0
        assert figure_of({"a": {"b": None}}, "a.b") is None
        assert figure_of(None, "a") is None


class TestCeiling:
    def test_share_of_the_way_to_the_oracle(self) -> None:
        runs = [
            # Ratios of means over seeds: (2 + 4) / (8 + 4) on the first sequence.
            *(run("3dgs", "phantom/0", seed, 20.0) for seed in (0, 1)),
            run("coarse", "phantom/0", 0, 22.0),
            run("coarse", "phantom/0", 1, 24.0),
            run("oracle", "phantom/0", 0, 28.0),
            run("oracle", "phantom/0", 1, 24.0),
            run("3dgs", "phantom/1", 0, 20.0),
            run("coarse", "phantom/1", 0, 27.0),
            run("oracle", "phantom/1", 0, 30.0),
            # An oracle below the baseline is no ceiling.
            run("3dgs", "phantom/2", 0, 20.0),
            run("coarse", "phantom/2", 0, 25.0),
            run("oracle", "phantom/2", 0, 19.0),
        ]
        comparison = compare_runs(runs, "3dgs")
        shares = {row["sequence"]: row["figures"]["psnr"]["mean"] for row in comparison["ceiling_sequences"]}
        assert shares == pytest.approx({"phantom/0": 0.5, "phantom/1": 0.7})
        (row,) = comparison["ceiling_datasets"]
        assert (row["method"], row["baseline"], row["figures"]["psnr"]["n"]) == ("coarse", "3dgs", 2)
        # Gains of 3 and 7 of 6 and 10.
        assert row["figures"]["psnr"]["mean"] == pytest.approx(10 / 16)
        assert (row["n_sequences"], row["n_seeds"]) == (2, 2)
        # Lower is better: the same share of the way down.
        assert row["figures"]["lpips_alex"]["mean"] == pytest.approx(10 / 16)

    def test_seeds_that_one_of_the_three_lacks_do_not_count(self) -> None:
        runs = [
            *(run("3dgs", "phantom/0", seed, value) for seed, value in ((0, 20.0), (1, 10.0))),
            *(run("coarse", "phantom/0", seed, value) for seed, value in ((0, 21.0), (1, 20.0))),
            run("oracle", "phantom/0", 0, 22.0),
        ]
        (row,) = compare_runs(runs, "3dgs")["ceiling_sequences"]
        assert row["figures"]["psnr"]["mean"] == pytest.approx(0.5)
        assert row["n_seeds"] == 1

    def test_a_sequence_with_hardly_any_way_to_go_decides_nothing(self) -> None:
        runs = []
        for number, best in enumerate((22.0, 22.0, 22.0, 20.002)):
            for method, value in (("3dgs", 20.0), ("coarse", 21.0), ("oracle", best)):
                runs.append(run(method, f"phantom/{number}", 0, value))
        (row,) = compare_runs(runs, "3dgs")["ceiling_datasets"]
        share = row["figures"]["psnr"]
        assert share["mean"] == pytest.approx(4 / 6.002)
        # In more than 2.5 % of all samples three of the four are the last one.
        assert pytest.approx(share["low"]) == 0.5
        assert share["high"] == pytest.approx(4 / 2.006)
        assert (share["n"], share["deviation"]) == (4, None)
        (first, *_) = compare_runs(runs, "3dgs")["ceiling_sequences"]
        assert (first["figures"]["psnr"]["low"], first["figures"]["psnr"]["high"]) == (None, None)

    def test_seeds_are_summed_in_the_order_of_the_runs(self) -> None:
        """Another order has other last bits, and that of a set of names differs from process to process."""
        gains = [1e16, 3.0, -1e16, 5.0] * 3
        runs = []
        for seed, gain in enumerate(gains):
            for method, value in (("3dgs", 0.0), ("coarse", gain), ("oracle", 1.0)):
                runs.append(run(method, "phantom/0", seed, value))
        (row,) = compare_runs(runs, "3dgs")["ceiling_sequences"]
        assert row["figures"]["psnr"]["mean"] == np.mean(np.array([gains, [1.0] * 12]).T, axis=0)[0]

    def test_without_an_oracle_there_is_none(self) -> None:
        comparison = compare_runs(both("phantom/0", 0, 20.0, 1.0), "3dgs")
        assert comparison["ceiling_sequences"] == comparison["ceiling_datasets"] == []
