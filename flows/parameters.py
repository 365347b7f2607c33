"""Types of the flows' parameters: what Python calls may hand over, and what the server is told to refuse.

Prefect checks the parameters of a deployment against a JSON schema when a run is submitted, before there is a
run. The schemas here list every setting with its type and range, so that a misspelt one never reaches a
worker. Calls from Python and the command line are checked by `PipelineConfig.with_overrides`, whose messages
are better than a schema's.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, get_args

from pydantic import Field, GetJsonSchemaHandler, TypeAdapter
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from extrags.config import PipelineConfig
from extrags.config.settings import Setting, settings_of
from flows.methods import MethodName

__all__ = [
    "DIFFERENT",
    "Matrix",
    "RunnerName",
    "Sequences",
    "Settings",
    "StoreRoot",
    "Variants",
    "settings_schema",
]

ROOT_PATTERN = r"^(/|~|[A-Za-z][A-Za-z0-9+.-]*://)"
"""A store that is the same wherever a worker was started: an absolute path or a URL."""

RUNNER_PATTERN = r"^(threads|dask(:.+)?)$"
"""A task runner; whether the address is one is checked when the run begins."""

DIFFERENT: dict[str, Any] = {"uniqueItems": True}
"""In the schema of a list: what is given twice is refused, as a run with it would be."""


@cache
def _values() -> dict[str, JsonSchemaValue]:
    """The schema of each setting's value, by dotted name."""
    return {name: _value(setting) for name, setting in settings_of(PipelineConfig).items()}


def _value(setting: Setting) -> JsonSchemaValue:
    # The name, because `Annotated` wants at least one thing to hold.
    kind: Any = Annotated[setting.annotation, setting.name, *setting.limits]
    schema = TypeAdapter(kind).json_schema()
    if schema.get("type") == "string" and setting.choices:
        schema["enum"] = setting.choices
    # Inside `allOf`, because Prefect takes whatever has a type of its own for something that may be null.
    return {"allOf": [schema], "description": f"{setting.description} ({setting.expected})"}


@cache
def _names(further: tuple[str, ...] = ()) -> JsonSchemaValue:
    """A schema of setting names whose refusals list the names that are near.

    A schema can only say which names it knows. Said of all, that would be a page; so a wrong name is held
    against those of its stage with the same first letter, else against those of its stage, else against the
    stages.
    """
    by_stage: dict[str, list[str]] = {}
    alone_names = list(further)
    for name in _values():
        stage, dot, _ = name.partition(".")
        # What is set for the whole run has no stage.
        by_stage.setdefault(stage, []).append(name) if dot else alone_names.append(name)
    stages = "|".join(map(re.escape, by_stage))
    rules: list[JsonSchemaValue] = []
    for stage, names in by_stage.items():
        letters: dict[str, list[str]] = {}
        for name in names:
            letters.setdefault(name.partition(".")[2][0], []).append(name)
        begins = re.escape(f"{stage}.")
        for letter, near in letters.items():
            rules.append({"if": {"pattern": f"^{begins}{letter}"}, "then": {"enum": near}})
        others = {"pattern": f"^{begins}([^{''.join(letters)}]|$)"}
        rules.append({"if": others, "then": {"enum": names}})
    known = rf"^({stages})\."
    alone = f"|^({'|'.join(map(re.escape, alone_names))})$" if alone_names else ""
    return {"allOf": [{"pattern": f"{known}{alone}"}, *rules]}


def settings_schema(
    values: Mapping[str, JsonSchemaValue] | None = None,
    *,
    further: Mapping[str, JsonSchemaValue] | None = None,
) -> JsonSchemaValue:
    """The JSON schema of overrides by dotted name; any other name is refused, as is a value out of range.

    Args:
        values: schema of the value of each setting; that of the setting itself by default.
        further: other names that are allowed, with the schemas of their values.
    """
    further = dict(further or {})
    return {
        "type": "object",
        "properties": {**(values or _values()), **further},
        "propertyNames": _names(tuple(further)),
        "additionalProperties": False,
    }


class _Shown(ABC):
    """Annotation: the schema that Prefect is shown in place of pydantic's own; validation stays as it is."""

    def __get_pydantic_json_schema__(
        self, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return self.schema()

    @abstractmethod
    def schema(self) -> JsonSchemaValue:
        """What it is."""


class _SettingsSchema(_Shown):
    def schema(self) -> JsonSchemaValue:
        return {**settings_schema(), "type": ["object", "null"]}


class _VariantsSchema(_Shown):
    def schema(self) -> JsonSchemaValue:
        methods = list(get_args(MethodName))
        return {
            "type": ["object", "null"],
            # Beside each other in tables, the two could not be told apart.
            "propertyNames": {"not": {"enum": methods}},
            "additionalProperties": settings_schema(further={"method": {"enum": methods}}),
        }


class _MatrixSchema(_Shown):
    def schema(self) -> JsonSchemaValue:
        several = {"type": "array", "minItems": 1, **DIFFERENT}
        lists = {name: {**several, "items": value} for name, value in _values().items()}
        return {**settings_schema(lists), "type": ["object", "null"]}


class _RootSchema(_Shown):
    def schema(self) -> JsonSchemaValue:
        return {"type": ["string", "null"], "minLength": 1, "pattern": ROOT_PATTERN}


class _RunnerSchema(_Shown):
    def schema(self) -> JsonSchemaValue:
        return {"type": "string", "pattern": RUNNER_PATTERN}


Settings = Annotated[dict[str, Any] | None, _SettingsSchema()]
"""Overrides by dotted name, e.g. `{"coarse.iterations": 500}`."""

Variants = Annotated[dict[str, dict[str, Any]] | None, _VariantsSchema()]
"""Overrides by dotted name, and `method`, for each name of a variant."""

Matrix = Annotated[dict[str, list[Any]] | None, _MatrixSchema()]
"""Values to try by dotted name, e.g. `{"coarse.iterations": [500, 1000]}`."""

StoreRoot = Annotated[str | None, _RootSchema()]
"""Directory or URL of a store; a deployment's must be absolute. None: see `flows.settings.run_store`."""

RunnerName = Annotated[str, _RunnerSchema()]
"""A task runner (`flows.settings.task_runner`)."""

Sequences = list[Annotated[str, Field(min_length=1)]]
"""Names, paths, patterns over the catalogue's names, or `@FILE` for a manifest (`flows.selection`)."""
