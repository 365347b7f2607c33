"""What callers pass in place of a sequence, a scene or settings: refused, and told what to pass."""

from __future__ import annotations

import ast
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

import numpy as np

from extrags.config import PipelineConfig, StageConfig
from extrags.errors import ConfigError
from extrags.sequence import EndoscopicSequence
from extrags.sequence_checks import check_arrays

__all__ = ["check_argument", "check_sequence_argument", "check_settings_argument", "with_checked_arguments"]

P = ParamSpec("P")
R = TypeVar("R")

HOW_MADE = {
    "Cameras": "sequence.cameras",
    "DepthEstimate": "extrags.estimate_depth(sequence)",
    "FolderReader": "data_catalog.folder_reader.FolderReader(...)",
    "FreeSpace": "extrags.carve(scene, mesh, sequence.cameras)",
    "Mesh": "extrags.fuse_surface(scene, sequence.cameras)",
    "Metric": "extrags.Metric(...)",
    "PoseEstimate": "extrags.estimate_poses(sequence)",
    "PseudoViews": "extrags.restore(scene, sequence, trajectories)",
    "Scene": "extrags.reconstruct(sequence).scene",
}
"""Expressions by the class of what they give, for messages; sequences and settings have their own."""

PARTS = {
    "Cameras": "cameras",
    "FreeSpace": "freespace",
    "Mesh": "mesh",
    "PseudoViews": "pseudo_views",
    "Scene": "scene",
}
"""Attributes of results that are arguments of functions, by class."""


def check_sequence_argument(sequence: object, function: str) -> None:
    """Refuse what is no sequence, or one whose arrays no stage could use.

    Args:
        sequence: what was given.
        function: that it was given to, for the message.

    Raises:
        TypeError: it is no `EndoscopicSequence`; says how one is made.
        SourceError: as `check_arrays`.
    """
    if not isinstance(sequence, EndoscopicSequence):
        raise TypeError(
            f"{function} was given {_given(sequence)} as its sequence; pass {_how_made_sequence(sequence)}"
        )
    check_arrays(sequence)


def check_settings_argument(config: object, expected: type[object], function: str, example: str) -> None:
    """Refuse settings of another kind, such as the name of a profile.

    Args:
        config: what was given.
        expected: class of the settings.
        function: that they were given to, for the message.
        example: an expression that gives such settings.

    Raises:
        ConfigError: says what to pass.
    """
    if not isinstance(config, expected):
        raise ConfigError(
            f"{function} was given {_given(config)} as its config; pass {_one(expected)}, such as {example}"
        )


def check_argument(value: object, expected: type[object], function: str, name: str) -> None:
    """Refuse an argument of another class, for methods that users call.

    Args:
        value: what was given.
        expected: class of the argument.
        function: that it was given to, for the message.
        name: of the argument.

    Raises:
        TypeError: says what to pass.
    """
    if not isinstance(value, expected):
        raise _refusal(function, name, [_of_class(expected)], {name: value}, {}, [])


def with_checked_arguments(function: Callable[P, R], classes: Mapping[str, Any]) -> Callable[P, R]:
    """A function of the public interface that refuses arguments of other kinds than it takes.

    Checked is what its annotations name: classes of this project and sequences of them, functions, mappings,
    literals, and indices (`Int` arrays). Everything else is left to the function. Calls inside the library go
    to the function itself, so that stages and loops check nothing.

    Args:
        function: as its module defines it.
        classes: public classes by name, for annotations that only type checkers see.

    Returns:
        The function itself where there is nothing to check. The checked one raises `ConfigError` for settings
        and literals, and `TypeError` for everything else; both say what to pass.
    """
    signature = inspect.signature(function)
    names = {**classes, **getattr(inspect.unwrap(function), "__globals__", {})}
    positional = [name for name, one in signature.parameters.items() if one.kind is one.POSITIONAL_OR_KEYWORD]
    checks: dict[str, list[_Kind]] = {}
    for name, parameter in signature.parameters.items():
        with suppress(_NotCheckedError):
            checks[name] = list(_kinds(ast.parse(parameter.annotation, mode="eval").body, names))
    if not checks:
        return function

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:  # Too few or too many: Python's own message names the function.
            return function(*args, **kwargs)
        for name, kinds in checks.items():
            if name in given and not any(kind.holds(given[name]) for kind in kinds):
                raise _refusal(function.__name__, name, kinds, given, checks, positional)
        return function(*args, **kwargs)

    # Where pickle finds it: the module of the function has the one without checks.
    checked.__module__ = "extrags.api"
    return checked


class _NotCheckedError(Exception):
    """An annotation of which this module knows no check."""


@dataclass(frozen=True)
class _Kind:
    """What an argument may be."""

    holds: Callable[[object], bool]
    words: str
    """What to pass instead; empty for None, and for a sequence, where it depends on what was given."""
    part: str = ""
    """The attribute of results, or of the settings of all stages, that is such an argument."""
    setting: bool = False


def _kinds(annotation: ast.expr, names: Mapping[str, Any]) -> Iterator[_Kind]:
    """The alternatives of an annotation.

    Raises:
        _NotCheckedError: for an alternative without a check.
    """
    match annotation:
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            yield from _kinds(left, names)
            yield from _kinds(right, names)
        case ast.Constant(value=None):
            yield _Kind(lambda value: value is None, "")
        case ast.Name(id=name):
            yield _of_class(_own_class(name, names))
        case ast.Subscript(value=ast.Name(id="Callable")):
            yield _Kind(callable, "a function")
        case ast.Subscript(value=ast.Name(id="Mapping")):
            yield _Kind(lambda value: isinstance(value, Mapping), "a mapping, such as a dict")
        case ast.Subscript(value=ast.Name(id="Int")):
            yield _Kind(_are_indices, "an array of indices, such as sequence.train")
        case ast.Subscript(value=ast.Name(id="Literal")):
            allowed = ast.literal_eval(annotation.slice)
            yield _Kind(lambda value: value in allowed, " or ".join(map(repr, allowed)), setting=True)
        case ast.Subscript(value=ast.Name(id="Sequence"), slice=ast.Name(id=name)):
            yield _of_sequence(_own_class(name, names))
        case _:
            raise _NotCheckedError


def _own_class(name: str, names: Mapping[str, Any]) -> type:
    found = names.get(name)
    if not isinstance(found, type) or found.__module__.split(".")[0] not in ("extrags", "data_catalog"):
        raise _NotCheckedError
    if getattr(found, "_is_protocol", False):
        raise _NotCheckedError
    return found


def _of_class(expected: type) -> _Kind:
    def holds(value: object) -> bool:
        return isinstance(value, expected)

    if issubclass(expected, EndoscopicSequence):
        return _Kind(holds, "", part="sequence")
    if issubclass(expected, StageConfig):
        fields = PipelineConfig.model_fields
        part = next((name for name, field in fields.items() if field.annotation is expected), "")
        example = f'extrags.PROFILES["quick"]{"." if part else ""}{part}'
        return _Kind(holds, f"{_one(expected)}, such as {example}", part=part, setting=True)
    name = expected.__name__
    example = f", such as {HOW_MADE[name]}" if name in HOW_MADE else ""
    return _Kind(holds, f"{_one(expected)}{example}", part=PARTS.get(name, ""))


def _of_sequence(expected: type) -> _Kind:
    def holds(value: object) -> bool:
        return isinstance(value, Sequence) and all(isinstance(item, expected) for item in value)

    return _Kind(
        holds, f"a list of {expected.__name__}, such as exploration.trajectories", part="trajectories"
    )


def _are_indices(value: object) -> bool:
    array = np.asarray(value)
    return array.ndim == 1 and (array.dtype.kind in "iub" or array.size == 0)


def _refusal(
    function: str,
    name: str,
    kinds: list[_Kind],
    given: Mapping[str, object],
    checks: Mapping[str, list[_Kind]],
    order: list[str],
) -> Exception:
    """What is wrong with an argument, and what to pass: a part of it, another, or all in another order."""
    value = given[name]
    said = f"{function} was given {_given(value)} as its {name}"
    for other, its_kinds in checks.items():
        if other not in given or value is None or any(kind.holds(given[other]) for kind in its_kinds):
            continue
        if any(kind.holds(value) for kind in its_kinds):
            return TypeError(f"{said}; that is for {other}: the order is {function}({', '.join(order)})")
    for kind in kinds:
        with suppress(Exception):
            if kind.part and kind.holds(getattr(value, kind.part)):
                return (ConfigError if kind.setting else TypeError)(f"{said}; pass its .{kind.part}")
    made = [_how_made_sequence(value) if kind.part == "sequence" else kind.words for kind in kinds]
    words = ", or ".join(filter(None, made))
    return (ConfigError if kinds[0].setting else TypeError)(f"{said}; pass {words}")


def _how_made_sequence(given: object) -> str:
    read = f"extrags.read({given!r})" if isinstance(given, str) else "extrags.read(name or path)"
    return f"{read}, or extrags.sequence_from_arrays(...)"


def _one(expected: type[object]) -> str:
    return f"{'an' if expected.__name__[0] in 'AEIOU' else 'a'} {expected.__name__}"


def _given(value: object) -> str:
    return repr(value) if isinstance(value, str) else f"an object of type {type(value).__name__}"
