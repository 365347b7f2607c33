"""Budgets from presets and from settings that are varied."""

from __future__ import annotations

from typing import Any

import pytest

from extrags.config import profile_config
from extrags.errors import ConfigError
from flows.budgets import PRESETS, SET_PRESETS, Budget, budgets_of, parsed_vary, preset_budgets, reaching

QUICK = profile_config("quick")


class TestPresets:
    @pytest.mark.parametrize("name", [*PRESETS, *SET_PRESETS])
    def test_every_budget_is_valid(self, name: str) -> None:
        found = preset_budgets(name, QUICK)
        assert len(found) > 1
        for budget in found:
            QUICK.with_overrides(dict(budget.settings))

    def test_multiples_of_the_profile(self) -> None:
        found = preset_budgets("iterations", QUICK)
        assert [budget.settings.get("coarse.iterations") for budget in found] == [375, 750, None, 3000]
        assert found[2] == Budget()

    def test_unknown(self) -> None:
        with pytest.raises(ConfigError, match="no preset of budgets 'money'; known: iterations"):
            preset_budgets("money", QUICK)


class TestVary:
    @pytest.mark.parametrize(
        ("text", "points"),
        [
            ("coarse.iterations=500,1500", [{"coarse.iterations": 500}, {"coarse.iterations": 1500}]),
            (
                "ingest.width+ingest.height=48+40,64+48",
                [{"ingest.width": 48, "ingest.height": 40}, {"ingest.width": 64, "ingest.height": 48}],
            ),
            (
                "coarse.iterations+finetune.iterations=9",
                [{"coarse.iterations": 9, "finetune.iterations": 9}],
            ),
            ("enhance.max_width=none,320", [{"enhance.max_width": None}, {"enhance.max_width": 320}]),
            (
                "enhance.channels=[8,8,16],[16,16,32]",
                [{"enhance.channels": (8, 8, 16)}, {"enhance.channels": (16, 16, 32)}],
            ),
            (
                "evaluate.lpips_nets=alex,vgg",
                [{"evaluate.lpips_nets": ("alex",)}, {"evaluate.lpips_nets": ("vgg",)}],
            ),
            ("enhance.steps=auto,1", [{"enhance.steps": "auto"}, {"enhance.steps": 1}]),
        ],
    )
    def test_syntax(self, text: str, points: list[dict[str, Any]]) -> None:
        assert parsed_vary(text) == points

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("coarse.iterations", "expected NAME=VALUE"),
            ("coarse.iterations=", "expected NAME=VALUE"),
            ("coarse.iteration=5", "coarse.iteration"),
            ("coarse.iterations=[5", r"setting coarse\.iterations is \[5; expected a whole number"),
            ("ingest.width+ingest.height=1+2+3", "3 values for 2 settings"),
        ],
    )
    def test_wrong(self, text: str, message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            parsed_vary(text)

    def test_every_combination(self) -> None:
        vary = [parsed_vary("coarse.iterations=1,2"), parsed_vary("enhance.max_views=3,4")]
        assert len(budgets_of(QUICK, [], vary)) == 4
        with pytest.raises(ConfigError, match="varied twice"):
            budgets_of(QUICK, [], [vary[0], vary[0]])

    def test_without_anything_the_profile(self) -> None:
        assert budgets_of(QUICK, [], []) == [Budget()]


def test_what_reaches_a_method() -> None:
    budget = Budget("both", {"coarse.iterations": 5, "finetune.iterations": 5})
    assert reaching(budget, {"finetune": "left out"}) == {"coarse.iterations": 5}
