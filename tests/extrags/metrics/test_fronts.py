"""Pareto fronts of costs and figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from extrags.metrics.fronts import front_of, fronts, means_by_cell


def case(
    method: str, seconds: float, psnr: float | None, *, seed: int = 0, width: int = 160
) -> dict[str, Any]:
    return {
        "method": method,
        "profile": "quick",
        "budget": "profile",
        "sequence": "phantom/11",
        "setting": "sparse",
        "width": width,
        "height": 128,
        "seed": seed,
        "seconds": seconds,
        "processor_seconds": 2 * seconds,
        "peak_mib": 500.0,
        "metrics": None if psnr is None else {"psnr": psnr, "ssim": None},
    }


class TestFront:
    @pytest.mark.parametrize(
        ("points", "higher", "kept"),
        [
            ([(1, 20), (2, 25), (3, 24)], True, [0, 1]),
            ([(3, 30), (1, 20), (2, 25)], True, [1, 2, 0]),
            ([(1, 0.3), (2, 0.2), (2, 0.1)], False, [0, 2]),
            ([(1, 20), (1, 20)], True, [0]),
            ([], True, []),
        ],
    )
    def test_by_hand(self, points: list[tuple[float, float]], higher: bool, kept: list[int]) -> None:
        assert front_of(points, higher_is_better=higher) == kept

    @pytest.mark.parametrize("higher", [True, False])
    def test_is_what_nothing_dominates(self, higher: bool) -> None:
        values = np.random.default_rng(3).normal(size=(60, 2)).round(1)
        sign = -1 if higher else 1
        errors = values * [1, sign]
        undominated = {
            tuple(point)
            for point in errors
            if not any((other <= point).all() and (other < point).any() for other in errors)
        }
        kept = front_of([(cost, value) for cost, value in values], higher_is_better=higher)
        assert {tuple(errors[index]) for index in kept} == undominated


class TestCells:
    def test_means_over_seeds_without_failed_runs(self) -> None:
        runs = [case("a", 10, 20), case("a", 14, 22, seed=1), case("a", 1, None, seed=2)]
        (cell,) = means_by_cell(runs)
        assert (cell["runs"], cell["failed"], cell["seconds"]) == (2, 1, 12)
        assert cell["figures"] == {"psnr": 21}

    def test_scenes_and_sizes_have_fronts_of_their_own(self) -> None:
        runs = [case("a", 10, 20), case("b", 20, 19), case("b", 20, 19, width=80)]
        found = {
            (entry["width"], entry["cost"]): [point["method"] for point in entry["front"]]
            for entry in fronts(means_by_cell(runs))
        }
        assert found[160, "seconds"] == ["a"]
        assert found[80, "seconds"] == ["b"]

    def test_what_failed_on_a_hard_seed_displaces_nothing(self) -> None:
        runs = [
            case("a", 10, 30),
            case("a", 10, 20, seed=1),
            case("b", 9.9, 29.9),
            case("b", 1, None, seed=1),
        ]
        found = fronts(means_by_cell(runs))
        assert {entry["cost"] for entry in found} == {"seconds", "processor_seconds", "peak_mib"}
        for entry in found:
            assert [point["method"] for point in entry["front"]] == ["a"]
            assert [cell["method"] for cell in entry["left_off"]] == ["b"]

    def test_a_seed_that_failed_everywhere_counts_for_none(self) -> None:
        runs = [case(method, 10, 20) for method in "ab"] + [case(method, 1, None, seed=1) for method in "ab"]
        assert not any(entry["left_off"] for entry in fronts(means_by_cell(runs)))

    def test_what_failed_before_its_size_was_known_is_of_the_same_cell(self) -> None:
        unread = {**case("a", 1, None, seed=1), "width": None, "height": None}
        (cell,) = means_by_cell([case("a", 10, 30), unread])
        assert (cell["width"], cell["runs"], cell["failed"]) == (160, 1, 1)

    def test_what_has_no_figure_is_on_no_front(self) -> None:
        assert fronts(means_by_cell([case("a", 1, None)])) == []
