from __future__ import annotations

import pytest

from extrags.config import PipelineConfig
from extrags.scene_plan import decide
from tasks.assess import planning_settings

LACKING = {"lacking_share": 0.5, "pixels": 20480.0, "width": 160.0, "training_views": 20.0}


class TestPlanningSettings:
    @pytest.mark.parametrize(
        "settings",
        [
            {"assess.full_budget_share": 0.9},
            {"explore.trajectories": 7, "explore.length": 4},
            {"enhance.max_views": 11},
            {"enhance.judge": False, "enhance.steps": 4},
            {"enhance.train_iterations": 100},
            {"enhance.backend": "classical"},
            {"finetune.iterations": 77, "finetune.judge.enabled": False},
        ],
        ids=str,
    )
    def test_hold_all_that_the_plan_says(self, settings: dict[str, object]):
        config = PipelineConfig().with_overrides(settings)
        assert decide(LACKING, config) != decide(LACKING, PipelineConfig())
        assert decide(LACKING, planning_settings(config)) == decide(LACKING, config)
