from __future__ import annotations

import pytest
from pydantic import BaseModel, ValidationError

from extrags.config import PROFILES, PipelineConfig, profile_config
from extrags.errors import ConfigError


def all_models(model: type[BaseModel]) -> list[type[BaseModel]]:
    found = [model]
    for field in model.model_fields.values():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found += all_models(annotation)
    return found


class TestConfig:
    @pytest.mark.parametrize("name", sorted(PROFILES))
    def test_profiles_survive_json(self, name: str) -> None:
        config = profile_config(name)
        assert PipelineConfig.model_validate_json(config.model_dump_json()) == config

    def test_every_model_is_frozen_and_refuses_unknown_names(self) -> None:
        for model in all_models(PipelineConfig):
            assert model.model_config["frozen"], model
            with pytest.raises(ValidationError):
                model.model_validate({"no_such_setting": 1})

    def test_override_changes_one_value_only(self) -> None:
        config = PipelineConfig()
        changed = config.with_overrides({"explore.length": 5, "coarse.light.enabled": False})
        assert changed.explore.length == 5
        assert not changed.coarse.light.enabled
        assert changed.finetune == config.finetune

    @pytest.mark.parametrize(
        ("path", "message"),
        [
            ("coarse.iteration", "did you mean coarse.iterations"),
            ("coars.iterations", "did you mean coarse"),
            ("coarse", "group of settings"),
            ("coarse.iterations.more", "no setting"),
        ],
    )
    def test_unknown_setting_says_what_is_near(self, path: str, message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            PipelineConfig().with_overrides({path: 1})

    def test_value_out_of_range_names_the_setting(self) -> None:
        with pytest.raises(ConfigError, match=r"coarse\.iterations"):
            PipelineConfig().with_overrides({"coarse.iterations": -7})

    def test_seed_reaches_every_stage_that_has_one(self) -> None:
        config = PipelineConfig().with_seed(7)
        assert config.coarse.seed == config.assess.seed == config.enhance.seed == 7

    def test_unknown_profile(self) -> None:
        with pytest.raises(ConfigError, match="quick"):
            profile_config("fast")
