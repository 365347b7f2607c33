from __future__ import annotations

import pytest

from extrags.config import PROFILES, PipelineConfig
from extrags.config.settings import settings_of
from extrags.errors import ConfigError
from extrags.run_costs import WORKLOAD_SETTINGS
from extrags.scene_plan import decide
from tasks.assess import planning_settings
from tests.other_values import other_values

LACKING = {"lacking_share": 0.5, "pixels": 20480.0, "width": 160.0, "training_views": 20.0}
KNOWN = settings_of(PipelineConfig)
OF_DECISIONS = {
    "assess.force",
    "assess.full_budget_share",
    "assess.min_hole_share",
    "explore.length",
    *(
        name
        for name in WORKLOAD_SETTINGS
        if not name.startswith(("poses.", "depth.", "evaluate.", "uc_nerf."))
    ),
}
"""Settings that a plan depends on: by what is decided, or by what that saves."""


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

    @pytest.mark.parametrize("name", sorted(OF_DECISIONS))
    def test_hold_all_that_savings_depend_on(self, name: str):
        """Little is lacking, so that budgets are cut and there is something to save."""
        tried = 0
        few = {"coarse.densify.enabled": False, "explore.trajectories": 3}
        for base in (PROFILES["quick"], PROFILES["quick"].with_overrides(few)):
            for other in other_values(KNOWN[name], base.value(name)):
                try:
                    config = base.with_overrides({name: other})
                except ConfigError:  # it does not go together with the others
                    continue
                tried += 1
                planning = planning_settings(config)
                assert planning.value(name) == other
                for lacking in (0.0005, 0.02):
                    measured = {**LACKING, "lacking_share": lacking, "width": 640.0}
                    assert decide(measured, planning) == decide(measured, config)
        assert tried > 0

    def test_hold_nothing_else(self):
        base = PROFILES["quick"]
        planning = planning_settings(base)
        carried = set()
        for name, setting in KNOWN.items():
            for other in other_values(setting, base.value(name)):
                try:
                    config = base.with_overrides({name: other})
                except ConfigError:
                    continue
                if planning_settings(config) != planning:
                    carried.add(name)
                break
            else:
                raise AssertionError(f"no other value of {name} is known")
        assert carried == OF_DECISIONS
