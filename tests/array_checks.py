"""Which functions have their arguments checked while tests run: those that take or give arrays.

The import hook wraps every function and dataclass of the packages, whether it has a shape to check or not,
and a wrapped call binds its arguments anew. What has no arrays is left to mypy, which checks all of it. Of
what has, the first calls in each process are checked, the first of each kind of arguments, and one of so
many later ones: some functions are called a hundred thousand times with the same shapes, and checking all of
them took a sixth of the suite's processor time.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import itertools
import re
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping

__all__ = ["check_arrays_alone"]

NAME = re.compile(r"[A-Za-z_]\w*")
FIRST_CALLS = 64
ONE_OF_CALLS = 64


def check_arrays_alone() -> None:
    """Have the import hook leave functions without arrays as they are; before the packages are imported."""
    wrapped: Any = jaxtyping.jaxtyped

    def jaxtyped(function: Any = None, **given: Any) -> Any:
        if function is not None:
            return wrapped(function, **given)
        decorator: Callable[[Any], Any] = wrapped(**given)

        def decorated(one: Any) -> Any:
            if dataclasses.is_dataclass(one) and isinstance(one, type):
                return of_fields(one, decorator)
            if not inspect.isfunction(one):
                return decorator(one)
            return sampled(one, decorator) if has_arrays(one) else one

        return decorated

    jaxtyping.jaxtyped = jaxtyped  # type: ignore[assignment]


def of_fields(one: type, decorator: Callable[[Any], Any]) -> type:
    """A dataclass whose `__init__` is checked as functions are; the import hook has every call checked."""
    init: Any = one.__init__  # type: ignore[misc]
    # Written by hand or inherited it was decorated before.
    if "checked" not in vars(init) and has_arrays(init):
        one.__init__ = sampled(init, decorator)  # type: ignore[misc]
    return one


def sampled(plain: Callable[..., Any], decorator: Callable[[Any], Any]) -> Callable[..., Any]:
    """A function that is checked in its first calls and in one of so many later ones.

    A call whose arguments are of other types than all before is always checked: whether a whole number given
    for a float is refused must not depend on which tests ran before.

    Args:
        plain: as it is written.
        decorator: makes the checked one, when it is first called: most functions are not called by a test.

    Returns:
        It has an entry `checked` among its attributes: what gives the function that checks each call.
    """
    calls = itertools.count()
    checked = functools.cache(lambda: decorator(plain))
    seen: set[tuple[object, ...]] = set()

    @functools.wraps(plain)
    def called(*given: Any, **named: Any) -> Any:
        number = next(calls)
        kinds = (*map(type, given), *named, *map(type, named.values()))
        if number < FIRST_CALLS or number % ONE_OF_CALLS == 0 or kinds not in seen:
            result = checked()(*given, **named)
            seen.add(kinds)
            return result
        return plain(*given, **named)

    vars(called)["checked"] = checked
    return called


def has_arrays(function: Callable[..., Any]) -> bool:
    """Whether an annotation names an array, by itself or by an alias of the module."""
    known = getattr(function, "__globals__", {})
    return any(
        any(_is_array(known.get(name)) for name in NAME.findall(annotation))
        if isinstance(annotation, str)
        else _is_array(annotation)
        for annotation in function.__annotations__.values()
    )


def _is_array(value: Any) -> bool:
    if inspect.isclass(value) and issubclass(value, jaxtyping.AbstractArray | jaxtyping.AbstractDtype):
        return True
    return any(_is_array(part) for part in typing.get_args(value))
