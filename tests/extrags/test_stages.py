"""The registry of stages holds together, and everything that a stage needs in the library is there."""

from __future__ import annotations

from typing import Any, get_args

import pytest
from pydantic import PrivateAttr

from extrags.config import PipelineConfig, profile_config
from extrags.errors import ConfigError
from extrags.memory_estimate import FrameSize, estimate_memory
from extrags.pipeline import Pipeline
from extrags.run_costs import Workload, packaged_model
from extrags.scene_plan import decide
from extrags.stages import (
    PAGES_OF_SEVERAL,
    REGISTRY,
    STAGES,
    Cost,
    Part,
    Stage,
    StageName,
    all_tasks,
    cost_of,
    leading_to,
    modelled_tasks,
    stage_named,
    stage_of_task,
    stages_until,
)

NAMES = [task.name for task in all_tasks()]
MODELLED = [name for stage in STAGES for name in modelled_tasks(stage)]


class TestRegistry:
    def test_every_name_is_described_once(self) -> None:
        assert get_args(StageName) == STAGES
        assert len({*NAMES, *PAGES_OF_SEVERAL}) == len([*NAMES, *PAGES_OF_SEVERAL])

    def test_every_artefact_is_of_one_stage(self) -> None:
        parts = [part for stage in REGISTRY for part in (*stage.page_parts, *stage.other_parts)]
        assert sorted(parts) == sorted(get_args(Part))

    @pytest.mark.parametrize("stage", REGISTRY, ids=STAGES)
    def test_a_stage_has_what_goes_by_its_name(self, stage: Stage) -> None:
        """A method, settings, and the task whose artefact completes it."""
        assert stage.name in Pipeline.__abstractmethods__
        assert stage.name in PipelineConfig.model_fields
        assert stage.name in {task.name for task in stage.tasks}

    def test_a_stage_needs_earlier_ones(self) -> None:
        for stage in REGISTRY:
            if stage.needs is not None:
                assert STAGES.index(stage.needs) < STAGES.index(stage.name)

    def test_stages_that_need_planned_ones_are_planned(self) -> None:
        for stage in REGISTRY:
            if stage.needs is not None and stage_named(stage.needs).planned:
                assert stage.planned, stage.name

    @pytest.mark.parametrize("lacking", [0.0, 1.0])
    def test_the_plan_decides_about_planned_stages(self, lacking: float) -> None:
        decided = [line.stage for line in decide({"lacking_share": lacking}, PipelineConfig()).decisions]
        assert decided == [stage.name for stage in REGISTRY if stage.planned]

    def test_memory_is_estimated_of_all_stages_but_two_that_only_render(self) -> None:
        found = estimate_memory(profile_config("quick"), FrameSize(40, 20, 160, 128)).by_stage
        assert set(STAGES) - set(found) == {"assess", "freespace"}


class TestCosts:
    def test_every_stage_has_tasks_whose_cost_is_modelled(self) -> None:
        assert all(modelled_tasks(stage) for stage in STAGES)
        assert len(set(MODELLED)) == len(MODELLED)

    def test_every_task_has_a_model_or_says_why_not(self) -> None:
        for task in all_tasks():
            assert isinstance(task.cost, Cost) == (task.name in MODELLED)
            assert isinstance(task.cost, Cost) or task.cost, task.name

    @pytest.mark.parametrize("name", MODELLED)
    def test_coefficients_are_packaged_or_it_is_said_why_not(self, name: str) -> None:
        cost = cost_of(name)
        assert (name in packaged_model().time) != bool(cost.unfitted)
        assert cost.usual_s is None or cost.unfitted

    @pytest.mark.parametrize("name", MODELLED)
    def test_terms_are_products_of_known_numbers(self, name: str) -> None:
        numbers = Workload(20_480, 48, 24, 24, profile_config("quick"), width=160).numbers()
        for term in cost_of(name).terms:
            assert set(term.split("*")) <= set(numbers)

    def test_what_one_model_stands_for_is_of_the_same_stage_and_has_none_of_its_own(self) -> None:
        for name in MODELLED:
            cost, owner = cost_of(name), stage_of_task(name)
            assert owner is not None
            others = {*cost.includes, *cost.shares} - {name}
            assert others <= {task.name for task in owner.tasks} - set(MODELLED)
            assert not cost.shares or sum(cost.shares.values()) == pytest.approx(1)

    def test_settings_that_costs_depend_on(self) -> None:
        asked = Asked.model_validate(profile_config("quick").model_dump())
        Workload(20_480, 48, 24, 24, asked, width=160).numbers()
        # Of the evaluation the networks alone count, and manifests name these by their weights.
        assert asked.groups - {"evaluate"} == {stage.name for stage in REGISTRY if stage.costs_by_settings}


class Asked(PipelineConfig):
    """Settings that note which groups are read."""

    _groups: set[str] = PrivateAttr(default_factory=set)

    @property
    def groups(self) -> set[str]:
        return self._groups

    def __getattribute__(self, name: str) -> Any:
        if name in PipelineConfig.model_fields and self.__pydantic_private__ is not None:
            self._groups.add(name)
        return super().__getattribute__(name)


class TestLookingUp:
    def test_stages_until_one(self) -> None:
        assert stages_until("ingest") == ("ingest",)
        assert stages_until("coarse") == ("ingest", "poses", "depth", "coarse")
        assert stages_until("report") == STAGES

    def test_what_leads_to_a_stage(self) -> None:
        assert leading_to("surface") == ("surface",)
        assert leading_to("enhance") == ("surface", "freespace", "explore", "enhance")

    def test_the_stage_of_a_task(self) -> None:
        found = {task: stage_of_task(task) for task in ("plan", "uc-nerf-render", "training-frames")}
        assert {task: stage.name for task, stage in found.items() if stage is not None} == {
            "plan": "assess",
            "uc-nerf-render": "evaluate",
            "training-frames": "coarse",
        }
        assert stage_of_task("dataset-report") is None

    def test_a_task_is_charged_to_the_stage_that_it_belongs_to_or_says_to_which(self) -> None:
        assert list(modelled_tasks("ingest")) == ["ingest", "training-frames"]
        assert list(modelled_tasks("depth")) == ["depth", "depth-frames"]
        assert list(modelled_tasks("coarse")) == ["coarse"]
        assert list(modelled_tasks("evaluate")) == [
            "evaluate-render", "evaluate-restore", "evaluate-views", "evaluate",
        ]  # fmt: skip

    def test_a_task_that_nothing_is_said_of_costs_a_constant(self) -> None:
        assert cost_of("sleep").terms == cost_of("refined-frames").terms == ("one",)

    def test_unknown_names(self) -> None:
        for look_up in (stage_named, stages_until, modelled_tasks):
            with pytest.raises(ConfigError, match="no stage 'explor'; known: ingest, poses"):
                look_up("explor")
