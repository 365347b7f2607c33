"""The model of what stages cost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from extrags.config import PipelineConfig, profile_config
from extrags.errors import ConfigError
from extrags.run_costs import STAGE_TASKS, CostModel, TaskCost, Workload, fitted, packaged_model


def work(
    pixels: float = 20480,
    iterations: int = 1500,
    gaussians: int = 14000,
    frames: float = 48,
    sh_degree: int = 1,
) -> Workload:
    config: PipelineConfig = profile_config("quick").with_overrides(
        {
            "coarse.iterations": iterations,
            "coarse.densify.max_gaussians": gaussians,
            "coarse.sh_degree": sh_degree,
        }
    )
    return Workload(pixels, frames, frames / 2, frames / 2, config)


def true_seconds(item: Workload) -> float:
    numbers = item.numbers()
    return 2 + numbers["iterations"] * (1e-7 * item.pixels + 3e-7 * numbers["gaussians"])


def product(item: Workload, term: str) -> float:
    numbers = item.numbers()
    return math.prod(numbers[name] for name in term.split("*"))


LOADS = [
    work(pixels, iterations, gaussians, sh_degree=sh_degree)
    for pixels in (5000, 20000, 80000)
    for iterations in (500, 1500)
    for gaussians in (5000, 20000)
    for sh_degree in (1, 3)
]


class TestFit:
    def test_recovers_the_coefficients(self) -> None:
        model = fitted([(item, TaskCost("coarse", true_seconds(item), 100.0)) for item in LOADS], 0.01)
        # Other terms are rounding errors: none adds a thousandth to any of the records.
        found = {
            term: value
            for term, value in model.time["coarse"].items()
            if any(value * product(item, term) > 1e-3 * true_seconds(item) for item in LOADS)
        }
        assert found == pytest.approx(
            {"one": 2, "iterations*pixels": 1e-7, "iterations*gaussians": 3e-7}, rel=1e-2
        )
        # Beyond what was recorded.
        beyond = work(200_000, 5000, 40_000)
        assert model.predict("coarse", beyond).seconds == pytest.approx(true_seconds(beyond), rel=0.01)
        assert model.predict("coarse", beyond).peak_mib == pytest.approx(100, rel=0.01)

    def test_a_few_records_of_a_busy_machine_do_not_matter(self) -> None:
        rng = np.random.default_rng(0)
        records = [
            (
                item,
                TaskCost(
                    "coarse", true_seconds(item) * (3 if index in (2, 9) else rng.uniform(0.97, 1.03)), None
                ),
            )
            for index, item in enumerate(LOADS)
        ]
        model = fitted(records, 0.01)
        for item in LOADS:
            assert model.predict("coarse", item).seconds == pytest.approx(true_seconds(item), rel=0.1)

    def test_without_records(self) -> None:
        with pytest.raises(ConfigError, match="no record"):
            fitted([], 0.01)


class TestGaussians:
    """How many there will be, for who plans a run before there is a scene."""

    def test_the_limit_holds_in_short_profiles_and_not_with_the_counts_of_paper(self) -> None:
        for profile in ("quick", "balanced", "paper"):
            config = profile_config(profile)
            limit = config.coarse.densify.max_gaussians
            found = Workload(20480, 48, 20, 28, config).numbers()
            if profile == "paper":
                # 97,000 to 105,000 in four scenes.
                assert 95_000 < found["gaussians"] < 110_000
                assert found["gaussians"] < found["final_gaussians"] < config.finetune.growth * limit
            else:
                assert found["gaussians"] == limit
                assert found["final_gaussians"] == config.finetune.growth * limit

    def test_those_of_a_scene_that_is_there_count(self) -> None:
        item = replace(work(), coarse_gaussians=1234)
        assert item.numbers()["gaussians"] == 1234
        assert replace(item, final_gaussians=4321).numbers()["final_gaussians"] == 4321

    def test_long_recordings_do_not_take_memory_in_proportion(self) -> None:
        """Their frames are mapped files."""
        some, many = (replace(work(2_073_600), frames=frames) for frames in (100, 1000))
        assert some.numbers()["held_pixels"] == many.numbers()["held_pixels"] < 100 * 2_073_600
        assert work(5120).numbers()["held_pixels"] == 48 * 5120


def test_the_mean_of_a_restorer_is_one_sample() -> None:
    found = replace(work(), config=work().config.with_overrides({"enhance.samples": "mean"})).numbers()
    assert found["samples"] == 1


class TestPace:
    model = CostModel({"coarse": {"one": 10.0}, "ingest": {"one": 5.0}}, {}, 0.01)

    def test_other_tasks_say_how_fast_a_machine_is(self) -> None:
        pace = self.model.pace([(work(), TaskCost("coarse", 20.0, None))] * 4)
        assert pace["coarse"] == pytest.approx(2)
        assert pace["ingest"] == pytest.approx(2)

    def test_a_task_of_its_own_pace(self) -> None:
        records = [(work(), TaskCost("coarse", 10.0, None))] * 50 + [
            (work(), TaskCost("ingest", 15.0, None))
        ] * 50
        pace = self.model.pace(records)
        assert pace["coarse"] == pytest.approx(1, rel=0.05)
        assert pace["ingest"] == pytest.approx(3, rel=0.05)

    def test_no_records_no_pace(self) -> None:
        assert self.model.pace([]) == {}


class TestPackaged:
    def test_more_work_costs_more(self) -> None:
        model = packaged_model()
        small, large = work(20_000, frames=20), work(200_000, 3000, 40_000, frames=60)
        for task in ("ingest", "coarse", "enhance", "evaluate-views"):
            assert model.predict(task, large).seconds > model.predict(task, small).seconds
        assert model.probe_s > 0

    def test_renders_that_are_measured_together_share_the_frames(self) -> None:
        model = packaged_model()
        item = replace(work(20_000), config=profile_config("balanced"))
        alone, together = (
            model.predict("evaluate-views", replace(item, stacks=stacks)).seconds for stacks in (1, 3)
        )
        assert 2 * alone < together < 2.6 * alone

    def test_knows_the_tasks_of_the_stages(self) -> None:
        known = {task for tasks in STAGE_TASKS.values() for task in tasks}
        assert set(packaged_model().time) <= known
        assert set(packaged_model().memory) == set(packaged_model().time)

    def test_an_unknown_task(self) -> None:
        with pytest.raises(ConfigError, match="no costs are known of the task 'sleep'"):
            packaged_model().predict("sleep", work())

    def test_survives_json(self) -> None:
        model = packaged_model()
        assert CostModel.from_json(model.to_json()) == model
