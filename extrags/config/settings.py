"""All settings by dotted name, with description, valid values and parsing from text.

The flags and the help of the command line and the errors of `PipelineConfig.with_overrides` are derived from
this: a new setting only takes a field of a model, with its limits and its description.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticKnownError

from extrags.config.base import LARGEST_WHOLE_NUMBER, KeyOf, check_size, check_truth_value, has_largest
from extrags.errors import ConfigError, did_you_mean

__all__ = [
    "Setting",
    "groups_of",
    "listed_values",
    "parsed_words",
    "refused_settings",
    "settings_of",
    "unknown_setting",
]


@dataclass(frozen=True)
class Setting:
    """One setting of a run.

    Args:
        name: dotted, e.g. `coarse.light.exponent`.
        description: what it does.
        annotation: type of its values.
        limits: range and length, as pydantic keeps them (`annotated_types`).
    """

    name: str
    description: str
    annotation: Any
    limits: tuple[Any, ...]

    @property
    def group(self) -> str:
        """All but the last part of the name."""
        return self.name.rpartition(".")[0]

    @property
    def expected(self) -> str:
        """The values it takes, in words: `a number above 0 and at most 1, or none`."""
        words = [word for kind in self._kinds for word in self._words(kind)]
        return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"

    def parse(self, text: str) -> Any:
        """Parse a value from text: `none`, `true`, `1e-3`, or comma-separated numbers.

        Raises:
            ConfigError: names the setting, what was found and what was expected.
        """
        if NoneType in self._kinds and text.strip().lower() in ("none", "null"):
            return None
        several = get_origin(self.annotation) is tuple
        return self._validated(text.strip("[]() ").split(",") if several else text, text)

    def checked(self, value: Any) -> Any:
        """The value of the setting that a value of JSON or YAML stands for; a text is parsed.

        Raises:
            ConfigError: names the setting, what was found and what was expected.
        """
        # A word, such as `none` or `1e-3`, means what it means after the setting's own flag.
        return self.parse(value) if isinstance(value, str) else self._validated(value, self.text(value))

    def _validated(self, value: Any, found: str) -> Any:
        # The name, because `Annotated` wants at least one thing to hold; pydantic passes over it.
        kind: Any = Annotated[self.annotation, self.name, *self.limits]
        try:
            check_truth_value(value, self.annotation)
            made = TypeAdapter(kind, config=ConfigDict(allow_inf_nan=False)).validate_python(value)
            check_size(made, self.limits)
        except (ValidationError, PydanticKnownError):
            raise self.refused(found) from None
        return made

    def text(self, value: Any) -> str:
        """Format a value as text; the inverse of `parse`."""
        if isinstance(value, tuple):
            return ",".join(str(part) for part in value)
        return str(value).lower() if value is None or isinstance(value, bool) else str(value)

    def refused(self, found: str) -> ConfigError:
        """The error for an invalid value."""
        bare = found.strip("'")
        meant = did_you_mean(bare, self.choices)
        expected = self.expected
        # What holds for all numbers is said where a value breaks it, not in each line of the help.
        if _is_not_finite(bare):
            expected = expected.replace("a number", "a finite number")
        elif int in self._kinds and not has_largest(self.limits) and _is_too_large(bare):
            expected = replace(self, limits=(*self.limits, *Field(le=LARGEST_WHOLE_NUMBER).metadata)).expected
        return ConfigError(f"setting {self.name} is {found or 'empty'}; expected {expected}{meant}")

    @property
    def choices(self) -> list[str]:
        """Valid values, if they are enumerated (a `Literal`, or the keys of a mapping)."""
        tables = [item.table for item in self.limits if isinstance(item, KeyOf)]
        literals = [get_args(kind) for kind in self._kinds if get_origin(kind) is Literal]
        return [str(name) for names in (*literals, *tables) for name in names]

    @property
    def _kinds(self) -> tuple[Any, ...]:
        union = get_origin(self.annotation) in (Union, UnionType)
        return get_args(self.annotation) if union else (self.annotation,)

    def _words(self, kind: Any) -> list[str]:
        if get_origin(kind) is Literal or (kind is str and self.choices):
            return self.choices
        if get_origin(kind) is tuple and get_origin(get_args(kind)[0]) is Literal:
            names = ", ".join(map(str, get_args(get_args(kind)[0])))
            return [f"one or more of {names}, with commas between"]
        if get_origin(kind) is tuple:
            parts = get_args(kind)
            step = _multiple_of(item for field in get_args(parts[0])[1:] for item in field.metadata)
            return [f"{len(parts)} {f'multiples of {step}' if step else 'whole numbers'} with commas between"]
        if kind in (int, float):
            return [("a whole number" if kind is int else "a number") + self._range()]
        return {bool: ["true", "false"], str: ["text"], NoneType: ["none"]}[kind]

    def _range(self) -> str:
        words = {"gt": "above", "ge": "of at least", "lt": "below", "le": "at most"}
        limit = {name: getattr(item, name) for name in words for item in self.limits if hasattr(item, name)}
        step = _multiple_of(self.limits)
        multiple = f", a multiple of {step}" if step else ""
        if {"ge", "le"} <= set(limit):
            return f" from {limit['ge']} to {limit['le']}{multiple}"
        parts = [f"{words[name]} {value}" for name, value in limit.items()]
        return f" {' and '.join(parts)}{multiple}" if parts else multiple


def _multiple_of(limits: Iterable[Any]) -> int | None:
    return next((item.multiple_of for item in limits if hasattr(item, "multiple_of")), None)


@cache
def settings_of(model: type[BaseModel]) -> dict[str, Setting]:
    """All settings of a model and of those inside it, by dotted name, in the order they are written."""
    return {
        f"{prefix}{name}": Setting(
            f"{prefix}{name}", field.description or "", field.annotation, tuple(field.metadata)
        )
        for prefix, inner in _models(model)
        for name, field in inner.model_fields.items()
        if not _is_model(field.annotation)
    }


def parsed_words(settings: Mapping[str, Any], known: Mapping[str, Setting]) -> dict[str, Any]:
    """The same settings with what their texts stand for: `none`, `alex` and `1e-3` as after a setting's flag.

    Args:
        settings: values of JSON or YAML by dotted name; unknown names stay as they are.
        known: from `settings_of`.

    Raises:
        ConfigError: names the setting, what was found and what was expected.
    """
    return {
        name: known[name].parse(value) if isinstance(value, str) and name in known else value
        for name, value in settings.items()
    }


def listed_values(text: str) -> list[str]:
    """`8,16` to `["8", "16"]`; a comma between brackets belongs to a value: `[8,8,16],[16,16,32]`."""
    return re.split(r",(?![^\[]*\])", text)


def groups_of(model: type[BaseModel]) -> dict[str, str]:
    """What each group of settings is for, by dotted name: the first line of its model's docstring.

    What is set for all of the model, and belongs to no group, has the empty name.
    """
    return {
        prefix.removesuffix("."): (inner.__doc__ or "").strip().partition("\n")[0]
        for prefix, inner in _models(model)
    }


def unknown_setting(name: str, known: Iterable[str]) -> ConfigError:
    """The error for an unknown setting, with similar names."""
    known = list(known)
    inside = [other.removeprefix(f"{name}.") for other in known if other.startswith(f"{name}.")]
    if inside:
        return ConfigError(f"{name} is a group of settings; name one of {', '.join(inside)}")
    within = {other[:dot] for other in known for dot, letter in enumerate(other) if letter == "."}
    meant = did_you_mean(name, [*known, *sorted(within)])
    # Groups first, then what is set for the whole.
    grouped = sorted(known, key=lambda other: "." not in other)
    groups = ", ".join(dict.fromkeys(other.partition(".")[0] for other in grouped))
    return ConfigError(f"no setting {name}{meant or f'; settings begin with {groups}'}")


def refused_settings(
    error: ValidationError, known: Mapping[str, Setting], given: Mapping[str, Any]
) -> ConfigError:
    """The error for settings that a model refuses, in the words of a single setting's.

    Args:
        error: of the model; the first thing that it says counts.
        known: settings of the model, from `settings_of`.
        given: values by dotted name, shown as they were given.
    """
    first = error.errors()[0]
    # A place ends with the member of a union or of a tuple that was tried.
    place = ".".join(str(part) for part in first["loc"])
    wrong = next((name for name in known if f"{place}.".startswith(f"{name}.")), None)
    if wrong is None:
        # Several settings that do not go together; those of no group have no place.
        reason = first["ctx"]["error"]
        return ConfigError(f"{place}: {reason}" if place else str(reason))
    # Not all values were given: what is wrong may have been there before (`with_seed` does not validate).
    found = repr(given.get(wrong, first["input"]))
    reason = first.get("ctx", {}).get("error")
    # What `KeyOf` says of a name that is none, `refused` says as well, with its suggestion.
    if isinstance(reason, ValueError) and not isinstance(reason, ConfigError):
        return ConfigError(f"setting {wrong} is {found}; {reason}")
    return known[wrong].refused(found)


def _models(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    yield prefix, model
    for name, field in model.model_fields.items():
        if _is_model(field.annotation):
            yield from _models(field.annotation, f"{prefix}{name}.")


def _is_not_finite(found: str) -> bool:
    try:
        return not math.isfinite(float(found))
    except ValueError:
        return False


def _is_too_large(found: str) -> bool:
    try:
        return float(found) > LARGEST_WHOLE_NUMBER
    except ValueError:
        return False


def _is_model(kind: Any) -> TypeGuard[type[BaseModel]]:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
