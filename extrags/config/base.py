"""What all settings have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from extrags.errors import ConfigError, did_you_mean

__all__ = ["KeyOf", "StageConfig"]


class KeyOf:
    """Annotation of a text setting whose values are the keys of a table, which programs may extend.

    Args:
        table: the values allowed, as they are when a setting is read.
    """

    def __init__(self, table: Mapping[str, Any]) -> None:
        self.table = table

    def check(self, value: str) -> str:
        """The value itself.

        Raises:
            ConfigError: when it is no key; gives the nearest one.
        """
        if value not in self.table:
            known = ", ".join(self.table)
            raise ConfigError(f"{value} is none of {known}{did_you_mean(value, self.table)}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))


class StageConfig(BaseModel):
    """Base of all settings: immutable, unknown names refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")
