"""Whether an array has the shape and type that it should have."""

from __future__ import annotations

from typing import Any

import numpy as np

from extrags.errors import ShapeError

__all__ = ["check_array", "check_instance", "check_whole"]


def check_array(value: object, what: str, shape: tuple[int | None, ...], kind: type[Any]) -> None:
    """Refuse what is no array of this shape and type.

    Args:
        value: what was given.
        what: it should be, for the message.
        shape: expected sizes; None for any.
        kind: expected type of the elements, or a class of types, as `np.floating`.

    Raises:
        ShapeError: says what was found and what was expected.
    """
    found, wanted = type(value).__name__, "a NumPy array, "
    if isinstance(value, np.ndarray):
        sizes = len(shape) == value.ndim and all(
            size in (None, given) for size, given in zip(shape, value.shape, strict=True)
        )
        if sizes and np.issubdtype(value.dtype, kind):
            return
        found, wanted = f"{value.dtype} {value.shape}", ""
    sizes_words = ", ".join("any" if size is None else str(size) for size in shape)
    raise ShapeError(f"{what} is {found}, expected {wanted}{kind.__name__} ({sizes_words})")


def check_instance(value: object, what: str, expected: type[object]) -> None:
    """Refuse what is no object of a class.

    Raises:
        ShapeError: says what was found and what was expected.
    """
    if not isinstance(value, expected):
        raise ShapeError(f"{what} is {type(value).__name__}, expected {expected.__name__}")


def check_whole(what: str, value: object) -> None:
    """Refuse what is no whole number of pixels.

    Raises:
        ShapeError: says what was found and what was expected.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise ShapeError(f"{what} is {value!r}, expected a whole number of pixels")
