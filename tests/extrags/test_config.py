from __future__ import annotations

import math
import re
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import pytest
from hypothesis import assume, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from pydantic import AllowInfNan, BaseModel, Field, ValidationError

from extrags.config import PROFILES, PipelineConfig, profile_config
from extrags.config.base import LARGEST_WHOLE_NUMBER, has_largest
from extrags.config.restorer import LevelWidth
from extrags.config.settings import Setting, groups_of, settings_of
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

    def test_a_value_is_found_by_its_dotted_name(self) -> None:
        config = PipelineConfig().with_overrides({"finetune.judge.iterations_share": 0.3, "device": "cpu"})
        assert config.value("finetune.judge.iterations_share") == 0.3
        assert config.value("device") == "cpu"
        with pytest.raises(
            ConfigError, match=r"no setting finetune\.judge\.iteration_share.*iterations_share"
        ):
            config.value("finetune.judge.iteration_share")

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
            ("iterations", "did you mean coarse.iterations or uc_nerf.iterations or finetune.iterations"),
            ("qqq", "settings begin with ingest, poses, depth, coarse"),
            ("coarse.iterations.more", "no setting"),
        ],
    )
    def test_unknown_setting_says_what_is_near(self, path: str, message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            PipelineConfig().with_overrides({path: 1})

    @pytest.mark.parametrize(
        ("overrides", "message"),
        [(["coarse.iterations"], "settings are list; expected a mapping"), ({3: 1}, "no setting 3;")],
    )
    def test_what_is_no_mapping_of_settings(self, overrides: Any, message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            PipelineConfig().with_overrides(overrides)

    @pytest.mark.parametrize(
        ("name", "value", "expected"),
        [
            ("coarse.iterations", -7, "is -7; expected a whole number of at least 1"),
            ("coarse.thickness", 0, "is 0; expected a number above 0 and at most 1"),
            ("ingest.width", 5, "is 5; expected a whole number from 16 to 4096 or none"),
            ("coarse.refine_poses", "often", "is 'often'; expected true, false or auto"),
            ("enhance.channels", [8, "x", 8], "expected 3 multiples of 8 with commas between"),
            ("enhance.channels", [8, True, 8], "expected 3 multiples of 8 with commas between"),
            ("enhance.channels", [8, 10**30, 8], "expected 3 multiples of 8 with commas between"),
            ("enhance.channels", [32, 60, 96], "expected 3 multiples of 8 with commas between"),
            ("enhance.crop", 100, "is 100; expected a whole number of at least 32, a multiple of 8"),
            ("coarse.iterations", 2**31, "is 2147483648; expected a whole number from 1 to 2147483647"),
            ("coarse.iterations", 3e9, "is 3000000000.0; expected a whole number from 1 to 2147483647"),
            ("coarse.iterations", True, "is True; expected a whole number of at least 1"),
            ("coarse.light.exponent", math.inf, "is inf; expected a finite number above 0"),
            ("coarse.light.exponent", "-inf", "is '-inf'; expected a finite number above 0"),
            ("ingest.end_s", math.nan, "is nan; expected a finite number above 0 or none"),
            ("evaluate.lpips_nets", ["alex", "alex"], "is ['alex', 'alex']; a backbone is given twice"),
            ("enhance.samples", 0, "is 0; expected mean, or a number from 1 to"),
            ("enhance.backend", "clasical", "expected embedded"),
        ],
    )
    def test_a_wrong_value_is_one_sentence_with_the_range(
        self, name: str, value: object, expected: str
    ) -> None:
        with pytest.raises(ConfigError, match=re.escape(expected)) as caught:
            PipelineConfig().with_overrides({name: value})
        assert str(caught.value).startswith(f"setting {name} is ")
        assert "\n" not in str(caught.value)

    def test_a_wrong_value_may_have_been_there_before(self) -> None:
        with pytest.raises(
            ConfigError, match=r"poses\.seed is -1; expected a whole number from 0 to 9223372036854775807"
        ):
            PipelineConfig().with_seed(-1).with_overrides({"coarse.iterations": 7})

    def test_seed_reaches_every_stage_that_has_one(self) -> None:
        config = PipelineConfig().with_seed(7)
        assert config.coarse.seed == config.assess.seed == config.enhance.seed == 7

    def test_unknown_profile(self) -> None:
        with pytest.raises(ConfigError, match="quick"):
            profile_config("fast")


SETTINGS = settings_of(PipelineConfig)


def values(setting: Setting) -> st.SearchStrategy[Any]:
    """Anything a setting takes."""
    if setting.choices and setting.annotation is str:
        return st.sampled_from(setting.choices)
    step = next((limit.multiple_of for limit in setting.limits if hasattr(limit, "multiple_of")), None)
    if step is not None:
        # Of which hypothesis knows nothing.
        (least,) = (limit.ge for limit in setting.limits if hasattr(limit, "ge"))
        return st.integers(-(-least // step), LARGEST_WHOLE_NUMBER // step).map(lambda part: step * part)
    union = get_origin(setting.annotation) in (Union, UnionType)
    kinds: tuple[Any, ...] = get_args(setting.annotation) if union else (setting.annotation,)
    largest = () if has_largest(setting.limits) else Field(le=LARGEST_WHOLE_NUMBER).metadata
    by_kind = {
        int: (*setting.limits, *largest),
        float: (*setting.limits, AllowInfNan(False)),
        str: setting.limits,
    }
    limited = (Annotated[kind, setting.name, *by_kind[kind]] for kind in kinds if kind in by_kind)
    free = (kind for kind in kinds if kind not in (int, float, str))
    return st.one_of(*(of_kind(kind) for kind in (*limited, *free)))


def of_kind(kind: Any) -> st.SearchStrategy[Any]:
    """Values of a type, limits within it included."""
    if get_origin(kind) is tuple and get_args(kind) == (LevelWidth,) * 3:
        # What pydantic keeps within a tuple is passed over by hypothesis.
        width = st.integers(1, LARGEST_WHOLE_NUMBER // 8).map(lambda eighth: 8 * eighth)
        return st.tuples(width, width, width)
    return st.from_type(kind)


class TestSettings:
    """The list of all settings, which flags, help and errors are made from."""

    def test_it_holds_every_field_of_every_model(self) -> None:
        fields = [field for model in all_models(PipelineConfig) for field in model.model_fields.values()]
        assert len(SETTINGS) == len(fields) - (len(all_models(PipelineConfig)) - 1)
        for name in SETTINGS:
            value: Any = PipelineConfig()
            for part in name.split("."):
                value = getattr(value, part)
            assert not isinstance(value, BaseModel)

    def test_every_setting_says_what_it_does_and_what_it_takes(self) -> None:
        groups = groups_of(PipelineConfig)
        for name, setting in SETTINGS.items():
            assert setting.description, name
            assert setting.expected, name
            assert groups[setting.group], name

    @pytest.mark.parametrize(
        ("kind", "value"),
        [(float, math.inf), (float, math.nan), (float, True), (int, 10**30), (int, True)],
    )
    def test_no_number_is_without_end_or_a_truth_value(self, kind: type, value: float) -> None:
        kinds = {name: (item.annotation, *get_args(item.annotation)) for name, item in SETTINGS.items()}
        numbers = [name for name in SETTINGS if kind in kinds[name] and bool not in kinds[name]]
        assert len(numbers) > 60
        for name in numbers:
            with pytest.raises(ConfigError, match=re.escape(f"setting {name} is ")):
                SETTINGS[name].checked(value)
            with pytest.raises(ConfigError, match=re.escape(f"setting {name} is ")):
                PipelineConfig().with_overrides({name: value})

    @given(st.data())
    @hypothesis_settings(deadline=None)
    def test_text_stands_for_the_value_it_was_made_from(self, data: st.DataObject) -> None:
        setting = SETTINGS[data.draw(st.sampled_from(sorted(SETTINGS)))]
        value = data.draw(values(setting))
        if isinstance(value, float):
            assume(math.isfinite(value))
        if isinstance(value, str):
            assume(value.strip().lower() not in ("none", "null"))
        if isinstance(value, tuple):
            # No setting takes an empty list, the same name twice, or numbers without end.
            assume(all(part <= LARGEST_WHOLE_NUMBER for part in value if isinstance(part, int)))
            assume(value and (isinstance(value[0], int) or len(set(value)) == len(value)))
        found = setting.parse(setting.text(value))
        assert found == value
        assert type(found) is type(value)

    @pytest.mark.parametrize(
        ("name", "text", "value"),
        [
            ("coarse.light.enabled", "False", False),
            ("coarse.refine_poses", "true", True),
            ("coarse.thickness", "1e-1", 0.1),
            ("enhance.steps", "4", 4),
            ("enhance.steps", "auto", "auto"),
            ("enhance.channels", "[8, 8, 16]", (8, 8, 16)),
            ("enhance.pretrained.revision", "1234567", "1234567"),
            ("ingest.width", "None", None),
        ],
    )
    def test_what_is_written_by_hand(self, name: str, text: str, value: object) -> None:
        found = SETTINGS[name].parse(text)
        assert found == value
        assert type(found) is type(value)
