from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, TypeCheckError, jaxtyped

from extrags.cameras import Cameras, rotation_about
from extrags.gaussians import Gaussians
from extrags.sequence import EndoscopicSequence
from tests.array_checks import FIRST_CALLS, ONE_OF_CALLS, has_arrays, of_fields, sampled

Pixels = dict[str, Float[np.ndarray, "h w"]]


def of_an_alias(pixels: Pixels) -> None: ...


def of_a_stack(stack: list[Float[np.ndarray, "*n"] | None]) -> None: ...


def of_a_result(name: str) -> Float[np.ndarray, "*n"] | None: ...


@dataclass(frozen=True)
class Lines:
    ends: Float[np.ndarray, "n 3"]
    width: int


of_fields(Lines, jaxtyped(typechecker=beartype))


@dataclass(frozen=True)
class Named:
    name: str


def of_no_array(cameras: Cameras, name: str = "Float") -> dict[str, float]: ...


def test_arrays_are_found_by_their_types_and_by_other_names_of_these() -> None:
    assert has_arrays(of_an_alias)
    assert has_arrays(of_a_stack)
    assert has_arrays(of_a_result)
    assert not has_arrays(of_no_array)


def test_a_wrong_shape_is_refused() -> None:
    # As in its first calls, of which other tests may have made all.
    checked = vars(rotation_about)["checked"]()
    with pytest.raises(TypeCheckError, match="axis"):
        checked(np.zeros(4), 0.1)


def test_fields_of_a_wrong_shape_are_refused() -> None:
    checked = vars(Lines.__init__)["checked"]()
    checked(object.__new__(Lines), np.zeros((2, 3)), 1)
    with pytest.raises(TypeCheckError, match="ends"):
        checked(object.__new__(Lines), np.zeros((2, 4)), 1)
    # And so are those of the packages.
    for kind in (Cameras, Gaussians, EndoscopicSequence):
        assert "checked" in vars(kind.__init__)


def test_a_dataclass_without_arrays_and_one_that_was_seen_stay() -> None:
    before = Lines.__init__
    assert of_fields(Lines, pytest.fail) is Lines
    assert Lines.__init__ is before
    plain = Named.__init__
    of_fields(Named, pytest.fail)
    assert Named.__init__ is plain


def test_the_first_calls_are_checked_and_one_of_so_many_later_ones() -> None:
    checked: list[int] = []
    plain: list[int] = []

    def decorator(_: object) -> object:
        return checked.append

    function = sampled(plain.append, decorator)
    last = FIRST_CALLS + 3 * ONE_OF_CALLS
    for number in range(last):
        function(number)
    assert checked[:FIRST_CALLS] == list(range(FIRST_CALLS))
    assert checked[FIRST_CALLS:] == [n for n in range(FIRST_CALLS, last) if n % ONE_OF_CALLS == 0]
    assert sorted(checked + plain) == list(range(last))


def test_the_first_call_with_arguments_of_other_types_is_checked() -> None:
    checked: list[object] = []

    def decorator(_: object) -> object:
        return lambda *given, **named: checked.append((*given, *named.values()))

    function = sampled(lambda *_, **__: None, decorator)
    for number in range(FIRST_CALLS + 1):
        function(number)
    del checked[:]
    for _ in range(2):
        function(1.0)
        function(1, 2)
        function(1, more=2)
        function(1, more=None)
    assert checked == [(1.0,), (1, 2), (1, 2), (1, None)]


def test_what_is_never_called_is_never_decorated() -> None:
    def decorator(_: object) -> object:
        raise AssertionError("decorated")

    assert sampled(of_a_result, decorator).__name__ == "of_a_result"
