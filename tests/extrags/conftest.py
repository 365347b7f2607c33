"""Fixtures that several rooms of the library share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from extrags.raster import available_backends
from tests.extrags.lit_tube import Tube, build_tube
from tests.second_device import second_device

WITHOUT_GSPLAT = pytest.mark.skipif(
    "gsplat" not in available_backends(), reason="no CUDA device with gsplat on this machine"
)


@pytest.fixture(scope="session")
def tube() -> Tube:
    return build_tube()


@pytest.fixture(params=["second", pytest.param("cuda", marks=[pytest.mark.gpu, WITHOUT_GSPLAT])])
def elsewhere(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """A device that is not the processor: one of the tests' own, and a GPU where there is one."""
    if request.param == "cuda":
        yield torch.device("cuda", torch.cuda.current_device())
        return
    with second_device() as device:
        yield device


@pytest.fixture
def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The processor, too, does what is done on other devices: plain torch."""
    for module in ("dispatch", "native", "gsplat"):
        monkeypatch.setattr(f"extrags.raster.{module}.native_isa", lambda: None)
    monkeypatch.setattr("extrags.training.step.native_isa", lambda: None)
