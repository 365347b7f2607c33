"""The model of what stages cost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from extrags.config import PipelineConfig, profile_config
from extrags.config.settings import settings_of
from extrags.errors import ConfigError
from extrags.run_costs import (
    WORKLOAD_SETTINGS,
    CostModel,
    TaskCost,
    Workload,
    beyond_the_fit,
    fitted,
    packaged_model,
    probe_seconds,
    probed_rasteriser,
    stage_seconds,
    stage_tasks,
)
from extrags.stages import STAGES, modelled_tasks
from tests.other_values import other_values


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

    def test_other_backends_are_not_what_is_fitted(self) -> None:
        records = [
            (changed(backend="embedded"), TaskCost("enhance", 100.0, None)),
            (changed(backend="classical"), TaskCost("enhance", 1.0, None)),
        ]
        model = fitted(records, 0.01)
        assert model.predict("enhance", records[0][0]).seconds == pytest.approx(100, rel=1e-3)

    def test_without_records(self) -> None:
        with pytest.raises(ConfigError, match="no record"):
            fitted([], 0.01)


class TestWorkloadSettings:
    def test_they_are_those_that_costs_depend_on(self) -> None:
        def costs(config: PipelineConfig) -> tuple[object, ...]:
            # Wide enough to be restored smaller. What a plan saves is that of the reference machine, which
            # has no GPU.
            numbers = Workload(640 * 480, 48, 24, 24, config, width=640).numbers()
            tasks = [stage_tasks(stage, config) for stage in STAGES]
            return (
                numbers,
                tasks,
                [beyond_the_fit(task, config, devices=False) for tasks in tasks for task in tasks],
            )

        quick = profile_config("quick")
        known = settings_of(PipelineConfig)
        read = set()
        # Some are read only without densification, where starts outnumber trajectories, or in recordings of
        # more frames than are all matched with one another.
        other = quick.with_overrides(
            {"coarse.densify.enabled": False, "explore.trajectories": 3, "poses.exhaustive_below": 10}
        )
        for base in (quick, other):
            before = costs(base)
            for name, setting in known.items():
                values = other_values(setting, base.value(name))
                assert values, name
                read |= {name for value in values if costs(with_value(base, name, value)) != before}
        assert read == set(WORKLOAD_SETTINGS)

    def test_they_are_named_once(self) -> None:
        assert len(set(WORKLOAD_SETTINGS)) == len(WORKLOAD_SETTINGS)


def with_value(base: PipelineConfig, name: str, value: object) -> PipelineConfig:
    """With another value of a setting; as it was where that does not go together with the rest of its stage.

    Only that stage is validated: of all of them together, thousands of values take several seconds.
    """
    if "." not in name:
        return base.with_overrides({name: value})
    stage, *parents, leaf = name.split(".")
    before = getattr(base, stage)
    tree = node = before.model_dump()
    for parent in parents:
        node = node[parent]
    node[leaf] = value
    try:
        return base.model_copy(update={stage: type(before).model_validate(tree)})
    except ValidationError:
        return base


class TestGaussians:
    """How many there will be, for who plans a run before there is a scene."""

    def test_the_limit_holds_in_short_profiles_and_not_with_the_counts_of_paper(self) -> None:
        for profile, pixels in (("quick", 160 * 128), ("balanced", 675 * 540), ("paper", 160 * 128)):
            config = profile_config(profile)
            limit = config.coarse.densify.max_gaussians
            found = Workload(pixels, 48, 20, 28, config).numbers()
            if profile == "paper":
                # 97,000 to 105,000 in four scenes.
                assert 95_000 < found["gaussians"] < 110_000
                assert found["gaussians"] < found["final_gaussians"] < config.finetune.growth * limit
            else:
                assert found["gaussians"] == limit
                assert found["final_gaussians"] == config.finetune.growth * limit

    def test_small_images_start_from_fewer_points(self) -> None:
        config = profile_config("balanced")
        small, large = (Workload(pixels, 48, 20, 28, config).numbers() for pixels in (160 * 128, 675 * 540))
        assert small["gaussians"] == pytest.approx(51_000)
        assert large["gaussians"] == 75_000

    def test_without_densification_there_are_those_of_the_start(self) -> None:
        config = profile_config("quick").with_overrides(
            {"coarse.densify.enabled": False, "coarse.max_points": 5000, "coarse.densify.max_gaussians": 100}
        )
        found = Workload(20480, 48, 24, 24, config).numbers()
        assert (found["gaussians"], found["final_gaussians"]) == (5000, 5000)

    def test_fewer_trajectories_leave_the_starts_of_the_search(self) -> None:
        def branches(**settings: object) -> float:
            config = profile_config("quick").with_overrides(
                {f"explore.{name}": value for name, value in settings.items()}
            )
            return replace(work(), config=config).numbers()["branches"]

        assert branches(trajectories=3) == branches(trajectories=12) == 12
        assert branches(trajectories=20) == 20
        assert branches(trajectories=3, starts=1) == 3
        assert branches(trajectories=3, wave=1) == branches(trajectories=3, score="pairs") == 3

    def test_looking_for_haze_takes_iterations_unless_some_is_kept(self) -> None:
        """The coarse scene begins anew where frames have neither haze nor white balance of their own."""
        item = replace(work(), config=profile_config("quick"))
        given = item.config.coarse.iterations
        assert item.numbers()["iterations"] == given + max(int(0.15 * given), 10 * 24) + 1
        assert replace(item, colors_kept=True).numbers()["iterations"] == given
        # Too many for it to be decided before glare is.
        assert replace(item, train=1000).numbers()["iterations"] == given
        oracle = item.config.with_overrides({"coarse.train_on": "all"})
        assert replace(item, config=oracle).numbers()["iterations"] == given

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


def changed(**enhance: object) -> Workload:
    settings = {f"enhance.{name}": value for name, value in enhance.items()}
    return replace(work(), config=work().config.with_overrides(settings))


class TestRestorer:
    """Its settings, of which records know hardly any."""

    def test_a_step_costs_a_run_of_the_network(self) -> None:
        model = packaged_model()
        for task, views in (("enhance", 96), ("evaluate-restore", 24), ("enhance-train", 48)):
            one, four, sixteen = (
                model.predict(task, changed(steps=steps)).seconds for steps in ("auto", 4, 16)
            )
            assert one == model.predict(task, changed(steps=1)).seconds
            assert four - one == pytest.approx(views * 20480 * 3 * 1.9e-6)
            assert sixteen - one == pytest.approx(5 * (four - one))

    def test_so_does_a_sample(self) -> None:
        model = packaged_model()
        assert model.predict("enhance", changed(samples=4)) == model.predict("enhance", changed(steps=4))

    def test_folds_are_for_who_trains_or_judges(self) -> None:
        assert changed().numbers()["fold_iterations"] > 0
        assert changed(judge=False).numbers()["fold_iterations"] == 0
        assert changed(judge=False, train_iterations=10).numbers()["fold_iterations"] > 0

    @pytest.mark.parametrize(
        ("settings", "tasks"),
        [
            ({}, set()),
            ({"enhance.steps": 4}, set()),
            (
                {"enhance.backend": "classical"},
                {"enhance-train", "enhance", "finetune-judge", "evaluate-restore"},
            ),
            (
                {"enhance.train_iterations": 9},
                {"enhance-train", "enhance", "finetune-judge", "evaluate-restore"},
            ),
            ({"enhance.train_iterations": 9, "enhance.steps": 1}, {"enhance-train"}),
            ({"finetune.keep_scene": True}, {"finetune", "finetune-judge"}),
            ({"finetune.holes_only": True}, {"finetune", "finetune-judge"}),
            ({"uc_nerf.enabled": True}, {"coarse", "evaluate-render"}),
        ],
    )
    def test_what_no_record_tells_of(self, settings: dict[str, object], tasks: set[str]) -> None:
        config = profile_config("quick").with_overrides(settings)
        every = {task for stage in STAGES for task in modelled_tasks(stage)}
        assert {task for task in every if beyond_the_fit(task, config)} == tasks

    def test_tasks_that_do_not_run_cost_nothing(self) -> None:
        config = profile_config("quick")
        assert "enhance-train" in stage_tasks("enhance", config)
        assert stage_tasks("enhance", config.with_overrides({"enhance.backend": "classical"})) == ("enhance",)
        without = config.with_overrides({"evaluate.restored": "none"})
        assert "evaluate-restore" not in stage_tasks("evaluate", without)
        # Nor is anything said of what nobody knows.
        assert stage_seconds(packaged_model(), "enhance", changed(backend="classical")) == 0


class TestPace:
    model = CostModel({"coarse": {"one": 10.0}, "ingest": {"one": 5.0}}, {}, 0.01)

    def test_other_tasks_say_how_fast_a_machine_is(self) -> None:
        pace = self.model.pace([(work(), TaskCost("coarse", 20.0, None))] * 4)
        assert pace["coarse"] == pytest.approx(2)
        assert pace["ingest"] == pytest.approx(2)

    def test_reading_says_nothing_of_other_tasks(self) -> None:
        """Of a long video all frames are decoded: `plan --before` told four times as much afterwards."""
        read = [(work(), TaskCost("ingest", 50.0, None))]
        assert self.model.pace(read) == {}
        pace = self.model.pace([*read, (work(), TaskCost("coarse", 20.0, None))])
        assert pace["coarse"] == pytest.approx(2)
        assert pace["ingest"] > 2
        # A procedural scene is drawn by the same processor.
        drawn = [(replace(work(), drawn=True), TaskCost("ingest", 50.0, None))]
        assert self.model.pace(drawn)["coarse"] == pytest.approx(10)

    def test_a_task_of_its_own_pace(self) -> None:
        records = [(work(), TaskCost("coarse", 10.0, None))] * 50 + [
            (work(), TaskCost("ingest", 15.0, None))
        ] * 50
        pace = self.model.pace(records)
        assert pace["coarse"] == pytest.approx(1, rel=0.05)
        assert pace["ingest"] == pytest.approx(3, rel=0.05)

    def test_records_of_another_backend_say_nothing(self) -> None:
        model = CostModel({"coarse": {"one": 10.0}, "enhance": {"one": 10.0}}, {}, 0.01)
        own, other = changed(backend="embedded"), changed(backend="classical")
        records = [(own, TaskCost("coarse", 20.0, None)), (other, TaskCost("enhance", 1.0, None))]
        # A large weight of the others would draw the pace of all tasks.
        records += [(other, TaskCost("enhance", 1.0, None))] * 50
        assert model.pace(records, own.config) == pytest.approx({"coarse": 2, "enhance": 2})
        # But for that backend they are all that is known.
        assert model.pace(records, other.config) == pytest.approx({"coarse": 2, "enhance": 0.1})
        assert model.pace(records[:1], other.config) == pytest.approx({"coarse": 2})

    def test_no_records_no_pace(self) -> None:
        assert self.model.pace([]) == {}


@pytest.mark.usefixtures("without_kernels")
def test_without_kernels_the_probe_is_of_what_renders_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was refused, though a run was not."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert probed_rasteriser() == "reference"
    # A hundred times the native kernels' where it was measured.
    assert probe_seconds() > 5 * packaged_model().probe_s


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
        known = {task for stage in STAGES for task in modelled_tasks(stage)}
        assert set(packaged_model().time) <= known
        assert set(packaged_model().memory) == set(packaged_model().time)

    def test_an_unknown_task(self) -> None:
        with pytest.raises(ConfigError, match="no costs are known of the task 'sleep'"):
            packaged_model().predict("sleep", work())

    def test_survives_json(self) -> None:
        model = packaged_model()
        assert CostModel.from_json(model.to_json()) == model


class TestOwnVideo:
    """Poses and depth of a recording that brings neither."""

    def test_what_poses_and_depth_took(self) -> None:
        """Processor time of recorded stages, divided by how much slower that machine was: 1.19, of the last
        three 1.5 and 1.8, by poses and depth of other recordings there."""
        quick = profile_config("quick")
        model = packaged_model()
        for task, width, height, frames, train, seconds in (
            ("depth", 160, 128, 48, 20, 10.0),
            ("depth", 256, 205, 48, 20, 31.8),
            ("depth", 675, 540, 40, 20, 28.2),
            ("poses", 675, 540, 40, 20, 165.0),
            ("poses", 160, 128, 200, 175, 57.0),
            ("poses", 160, 128, 400, 350, 150.0),
            ("poses", 160, 128, 800, 700, 440.0),
        ):
            item = Workload(width * height, frames, train, frames - train, quick, width=width)
            assert model.predict(task, item).seconds == pytest.approx(seconds, rel=0.25), (task, width)

    def test_pairs_of_frames_grow_with_the_frames_of_long_recordings(self) -> None:
        quick = profile_config("quick")
        pairs = [
            Workload(20_480, train, train, 0, quick, width=160).numbers()["pairs"]
            for train in (60, 600, 6000)
        ]
        assert pairs[0] == 60 * 59 / 2
        assert pairs[1] < 7 * pairs[0]
        assert pairs[2] < 11 * pairs[1]

    def test_fewer_hypotheses_and_partners_take_less_time(self) -> None:
        quick = profile_config("quick")

        def seconds(**changes: int) -> float:
            config = quick.with_overrides({f"depth.{name}": value for name, value in changes.items()})
            return packaged_model().predict("depth", replace(work(), config=config)).seconds

        assert seconds(hypotheses=48) < seconds() < seconds(hypotheses=192)
        assert seconds(sources=3) < seconds()
        assert beyond_the_fit("depth", quick) == ()
        assert beyond_the_fit("depth", quick.with_overrides({"depth.monocular": "network"}))
        assert beyond_the_fit("poses", quick.with_overrides({"poses.fallback": "rgbd"}))

    def test_depth_takes_the_memory_of_frames_as_they_are_matched(self) -> None:
        """At `depth.max_width`: wider frames are not in memory at their size, and take no more time."""
        quick = profile_config("quick")
        small, large = (
            packaged_model().predict("depth", Workload(w * h, 100, 87, 13, quick, width=w))
            for w, h in ((256, 205), (1024, 820))
        )
        assert small.peak_mib is not None
        assert large.peak_mib == pytest.approx(small.peak_mib, rel=0.1)
        assert large.seconds == pytest.approx(small.seconds)
        # 87 of 100 frames of 320 x 256 px took 1,598 MiB.
        seen = packaged_model().predict("depth", Workload(320 * 256, 100, 87, 13, quick, width=320))
        assert seen.peak_mib == pytest.approx(1598, rel=0.25)

    @pytest.mark.parametrize("task", ["poses", "depth"])
    def test_neither_takes_memory_for_virtual_views(self, task: str) -> None:
        quick = profile_config("quick")
        few, many = (Workload(20_480, 48, 24, 24, quick, views=views, width=160) for views in (20, 2000))
        model = packaged_model()
        assert model.predict(task, few).peak_mib == model.predict(task, many).peak_mib
