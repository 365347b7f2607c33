from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError

from extrags.cameras import Cameras, rotation_about
from tests.array_checks import has_arrays

Pixels = dict[str, Float[np.ndarray, "h w"]]


def of_an_alias(pixels: Pixels) -> None: ...


def of_a_stack(stack: list[Float[np.ndarray, "*n"] | None]) -> None: ...


def of_a_result(name: str) -> Float[np.ndarray, "*n"] | None: ...


def of_no_array(cameras: Cameras, name: str = "Float") -> dict[str, float]: ...


def test_arrays_are_found_by_their_types_and_by_other_names_of_these() -> None:
    assert has_arrays(of_an_alias)
    assert has_arrays(of_a_stack)
    assert has_arrays(of_a_result)
    assert not has_arrays(of_no_array)


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(TypeCheckError, match="axis"):
        rotation_about(np.zeros(4), 0.1)
