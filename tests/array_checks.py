"""Which functions have their arguments checked while tests run: those that take or give arrays.

The import hook wraps every function of the packages, whether it has a shape to check or not, and a wrapped
call binds its arguments anew. What has no arrays is left to mypy, which checks all of it.
"""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping

__all__ = ["check_arrays_alone"]

NAME = re.compile(r"[A-Za-z_]\w*")


def check_arrays_alone() -> None:
    """Have the import hook leave functions without arrays as they are; before the packages are imported."""
    wrapped: Any = jaxtyping.jaxtyped

    def jaxtyped(function: Any = None, **given: Any) -> Any:
        if function is not None:
            return wrapped(function, **given)
        decorator: Callable[[Any], Any] = wrapped(**given)
        return lambda one: one if inspect.isfunction(one) and not has_arrays(one) else decorator(one)

    jaxtyping.jaxtyped = jaxtyped  # type: ignore[assignment]


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
