"""Base class and annotations of all settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, get_args

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationInfo, field_validator
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from extrags.errors import ConfigError, did_you_mean
from extrags.redaction import has_credentials

__all__ = [
    "LARGEST_SEED",
    "LARGEST_WHOLE_NUMBER",
    "KeyOf",
    "Seed",
    "StageConfig",
    "check_size",
    "check_truth_value",
    "has_largest",
]

LARGEST_SEED = 2**63 - 1
"""What the random number generators of numpy and torch both take, and fits a signed 64-bit integer."""

LARGEST_WHOLE_NUMBER = 2**31 - 1
"""Of settings that state no largest value of their own: what kernels, and files of others, count with."""

Seed = Annotated[int, Field(ge=0, le=LARGEST_SEED)]
"""Seed of random sampling."""


class KeyOf:
    """Annotation of a text setting whose values are the keys of a mapping that programs may extend.

    Args:
        table: the mapping; its keys are looked up when a setting is validated.
    """

    def __init__(self, table: Mapping[str, Any]) -> None:
        self.table = table

    def check(self, value: str) -> str:
        """Validate a value and return it.

        Raises:
            ConfigError: when it is not a key; suggests the most similar one.
        """
        if value not in self.table:
            known = ", ".join(self.table)
            raise ConfigError(f"{value} is none of {known}{did_you_mean(value, self.table)}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))


def has_largest(limits: Iterable[Any]) -> bool:
    """Whether the limits of a setting, as pydantic keeps them, state a largest value."""
    return any(hasattr(limit, name) for limit in limits for name in ("le", "lt"))


def check_truth_value(value: Any, annotation: Any) -> None:
    """Refuse true and false where the type of a setting is a number: pydantic takes them for 1 and 0.

    Args:
        value: as it was given; also a list or tuple.
        annotation: type of the setting.

    Raises:
        PydanticKnownError: a value, or a part of one, is true or false.
    """
    if bool in (annotation, *get_args(annotation)):
        return
    if any(isinstance(part, bool) for part in (value if isinstance(value, list | tuple) else [value])):
        raise PydanticKnownError("int_type")


def check_size(value: Any, limits: Iterable[Any]) -> None:
    """Refuse whole numbers beyond `LARGEST_WHOLE_NUMBER` where a setting states no largest value itself.

    Args:
        value: of the setting; also a tuple.
        limits: of the setting, as pydantic keeps them.

    Raises:
        PydanticKnownError: a value, or a part of one, is larger.
    """
    if has_largest(limits):
        return
    for part in value if isinstance(value, tuple) else (value,):
        if isinstance(part, int) and part > LARGEST_WHOLE_NUMBER:
            raise PydanticKnownError("less_than_equal", {"le": LARGEST_WHOLE_NUMBER})


class StageConfig(BaseModel):
    """Base class of all settings.

    They are immutable. Errors are: unknown names, credentials, NaN and infinity, whole numbers beyond
    `LARGEST_WHOLE_NUMBER` where a setting states no largest value, and true or false for a number.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _without_truth_value(cls, value: Any, info: ValidationInfo) -> Any:
        # A plan validates thousands of values, hardly any of which can be a truth value.
        if isinstance(value, bool | list | tuple):
            check_truth_value(value, cls.model_fields[str(info.field_name)].annotation)
        return value

    @field_validator("*")
    @classmethod
    def _not_too_large(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, int | tuple):
            check_size(value, cls.model_fields[str(info.field_name)].metadata)
        return value

    @field_validator("*")
    @classmethod
    def _without_credentials(cls, value: Any) -> Any:
        # Settings are stored: in manifests, on pages, in Prefect's database.
        if isinstance(value, str) and has_credentials(value):
            raise ValueError("it holds a password, key or token; credentials belong in the environment")
        return value
