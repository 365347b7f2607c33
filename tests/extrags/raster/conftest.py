"""Fixtures of the rasteriser's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from extrags.raster import native


@pytest.fixture(params=native.usable_isas() or ["none"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set this processor can run, in turn."""
    if request.param == "none":
        pytest.skip("the native kernels are not built")
    before = native.native_isa()
    native.set_native_isa(request.param)
    yield request.param
    native.set_native_isa(str(before))


@pytest.fixture
def threads() -> Iterator[None]:
    """Puts the number of threads back."""
    before = native.num_threads()
    yield
    native.set_num_threads(before)
