"""Learning rates and weights over an optimisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.config import CoarseConfig, OptimiserConfig, profile_config
from extrags.training.reconstruction import coarse_schedule
from extrags.training.schedule import LIGHT_COOLDOWN_FINAL, Schedule

SETTLING = ("quats", "scales", "opacities", "sh0", "shN")
EXTENT = 7.0


def schedule_with(decay_after: int | None, iterations: int = 1000) -> Schedule:
    config = CoarseConfig(iterations=iterations, optimiser=OptimiserConfig(decay_after=decay_after))
    return coarse_schedule(config, EXTENT, 20.0, "coarse")


class TestLearningRates:
    def test_start_at_the_settings(self) -> None:
        schedule = schedule_with(100)
        expected = {name: getattr(schedule.optimiser, name) for name in SETTLING}
        rates = schedule.learning_rates(0)
        assert {name: rates[name] for name in SETTLING} == expected
        assert rates["means"] == pytest.approx(EXTENT * schedule.optimiser.means)

    @pytest.mark.parametrize("name", SETTLING)
    def test_fall_from_a_certain_iteration_on(self, name: str) -> None:
        schedule = schedule_with(100)
        start = getattr(schedule.optimiser, name)
        for iteration, share in ((0, 1), (99, 1), (100, 1), (400, 1 / 8), (900, 1 / 27)):
            assert schedule.learning_rates(iteration)[name] == pytest.approx(share * start)

    def test_longer_runs_drift_no_farther(self) -> None:
        # The integral of (100 / i) ** 1.5 from 100 to infinity is 200.
        schedule = schedule_with(100, 200_000)
        path = np.cumsum([schedule.rate_share(iteration) for iteration in range(200_000)])
        assert path[-1] < 300
        assert path[-1] == pytest.approx(300, rel=0.02)
        assert path[1600] > 0.75 * path[-1]

    def test_none_leaves_them(self) -> None:
        schedule = schedule_with(None)
        assert all(
            schedule.learning_rates(999)[name] == schedule.learning_rates(0)[name] for name in SETTLING
        )

    def test_those_of_the_light_cool_down_on_top(self) -> None:
        schedule = schedule_with(100)
        assert schedule.light_rate_share(1000) == schedule.rate_share(1000)
        cooled = replace(schedule, light_cooldown_share=0.2)
        for iteration, part in ((0, 0), (800, 0), (850, 0.25), (900, 0.5), (1000, 1)):
            expected = LIGHT_COOLDOWN_FINAL**part * schedule.rate_share(iteration)
            assert cooled.light_rate_share(iteration) == pytest.approx(expected)

    def test_positions_fall_log_linearly_whatever_the_others_do(self) -> None:
        for schedule in (schedule_with(100), schedule_with(None)):
            rates = [schedule.learning_rates(iteration)["means"] for iteration in (0, 500, 1000)]
            assert rates[1] == pytest.approx(np.sqrt(rates[0] * rates[2]))
            assert rates[2] == pytest.approx(EXTENT * schedule.optimiser.means_final)

    def test_the_shortest_profile_ends_before_they_fall(self) -> None:
        coarse = profile_config("quick").coarse
        assert coarse.optimiser.decay_after is not None
        assert coarse.iterations <= coarse.optimiser.decay_after


class TestDepthWeight:
    def test_falls_log_linearly_to_its_share(self) -> None:
        config = CoarseConfig(iterations=1000, depth_weight=0.2, depth_weight_final_share=0.25)
        schedule = coarse_schedule(config, EXTENT, 20.0, "coarse")
        weights = [schedule.depth_weight_at(iteration) for iteration in (0, 500, 1000)]
        assert weights == pytest.approx([0.2, 0.1, 0.05])


class TestHarmonics:
    def test_their_degree_grows_with_the_iterations(self) -> None:
        schedule = replace(schedule_with(None), sh_every=400)
        assert [schedule.sh_degree_at(i, 3) for i in (0, 399, 400, 800, 1200, 5000)] == [0, 0, 1, 2, 3, 3]
        assert schedule.sh_degree_at(1200, 1) == 1

    def test_all_are_active_from_the_first_step_where_a_scene_exists(self) -> None:
        resumed = schedule_with(None).resumed(seed=7)
        assert resumed.sh_degree_at(0, 3) == 3
        # Drawn anew: not the views of the first steps once more.
        assert resumed.seed == 7 != schedule_with(None).seed


class TestProgress:
    def test_it_ends_with_the_last_iteration_of_the_last_round(self) -> None:
        alone = schedule_with(None)
        last = alone.progress(alone.iterations - 1, {"loss": 0.5})
        assert (last.stage, last.done, last.total, last.values) == ("coarse", 1000, 1000, {"loss": 0.5})
        second = replace(alone, iterations_before=300, iterations_after=200)
        first = second.progress(0, {})
        assert (first.done, first.total) == (301, 1500)
