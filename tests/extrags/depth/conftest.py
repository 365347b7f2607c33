"""Devices that depth is estimated on, each with torch's implementation of the kernels."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from extrags.depth import matching, sweeps

NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NO_CUDA])])
def device(request: pytest.FixtureRequest) -> str:
    """The processor, or a GPU where there is one."""
    return str(request.param)


@pytest.fixture
def specification(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Call it: from then on the processor, too, does what a GPU does."""
    return lambda: monkeypatch.setattr(sweeps, "native", matching)
