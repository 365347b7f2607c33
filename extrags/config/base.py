"""Base class and annotations of all settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, field_validator
from pydantic_core import CoreSchema, core_schema

from extrags.errors import ConfigError, did_you_mean
from extrags.redaction import has_credentials

__all__ = ["LARGEST_SEED", "KeyOf", "Seed", "StageConfig"]

LARGEST_SEED = 2**63 - 1
"""What the random number generators of numpy and torch both take, and fits a signed 64-bit integer."""

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


class StageConfig(BaseModel):
    """Base class of all settings: immutable; unknown names are errors, and so are credentials."""

    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    @field_validator("*")
    @classmethod
    def _without_credentials(cls, value: Any) -> Any:
        # Settings are stored: in manifests, on pages, in Prefect's database.
        if isinstance(value, str) and has_credentials(value):
            raise ValueError("it holds a password, key or token; credentials belong in the environment")
        return value
