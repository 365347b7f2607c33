"""Kernels and backends as a process finds them: built or not, chosen by the environment, after a fork."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from types import ModuleType

import pytest
import torch

from extrags.errors import MissingDependencyError
from extrags.raster import available_backends, native, set_num_threads
from tests.extrags.forked_child import exit_code_of_child
from tests.extrags.raster.scenes import tube


def _in_a_new_process(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


def test_environment_chooses_the_instruction_set() -> None:
    # Both choices share the import of torch, which takes longest.
    code = """
import os

import torch

child = os.fork()
if child:
    assert os.waitpid(child, 0)[1] == 0
else:
    os.environ["EXTRAGS_ISA"] = "portable"
from extrags.raster import native_isa
print(native_isa(), flush=True)
"""
    found = _in_a_new_process(code, EXTRAGS_ISA="sse9")
    assert found.stdout.strip() == "portable"
    assert found.returncode != 0
    said = "ConfigError: EXTRAGS_ISA: instruction set 'sse9' is not usable here, expected one of "
    assert said + ", ".join(native.usable_isas()) in found.stderr


def test_more_pairs_than_the_kernels_can_number_are_refused() -> None:
    """In a process of its own: it would end with a segmentation fault."""
    code = """
import torch
from extrags.raster import rasterize

side = 4096
n = 2**32 // (side // 32) ** 2 + 1  # one Gaussian more than 2^32 pairs with tiles; all cover the image
K = torch.tensor([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1]])
gaussians = torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 50.0)
gaussians = (*(value.repeat(n, 1) for value in gaussians), torch.full((n,), 0.5))
rasterize(*gaussians, None, torch.eye(4)[None], K[None], side, side, colors=torch.ones(n, 3))
"""
    failed = _in_a_new_process(code)
    assert failed.returncode == 1
    assert failed.stderr.splitlines()[-1].startswith(
        "extrags.errors.ShapeError: 4294983680 pairs of a Gaussian and a tile, and the kernels take at most "
        "4294967295: "
    )


@pytest.fixture
def imported_with(monkeypatch: pytest.MonkeyPatch) -> Callable[[ImportError], ModuleType]:
    """A second copy of `extrags.raster.native`, imported where the kernels raise an error."""

    def imported(error: ImportError) -> ModuleType:
        class Refusing:
            @staticmethod
            def find_spec(name: str, path: object = None, target: object = None) -> None:
                if name == "extrags.raster._native":
                    raise error

        monkeypatch.delitem(sys.modules, "extrags.raster._native")
        monkeypatch.setattr(sys, "meta_path", [Refusing, *sys.meta_path])
        spec = importlib.util.spec_from_file_location("native_again", native.__file__)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "native_again", module)
        spec.loader.exec_module(module)
        return module

    return imported


class TestWithoutKernels:
    NOT_THERE = ModuleNotFoundError("No module named '_native'", name="extrags.raster._native")

    def test_not_built(self, imported_with: Callable[[ImportError], ModuleType]) -> None:
        module = imported_with(self.NOT_THERE)
        assert module.native_isa() is None
        with pytest.raises(
            MissingDependencyError, match=r"not built: installing the package .* C\+\+17 compiler"
        ):
            module.set_num_threads(1)

    @pytest.mark.parametrize(
        "error",
        [
            ImportError("libstdc++.so.6: version `GLIBCXX_3.4.99' not found"),
            ModuleNotFoundError("No module named 'other'", name="other"),
        ],
    )
    def test_built_but_not_loadable(
        self, error: ImportError, imported_with: Callable[[ImportError], ModuleType]
    ) -> None:
        module = imported_with(error)
        assert module.native_isa() is None
        with pytest.raises(MissingDependencyError, match="built but cannot be loaded: ") as caught:
            module.set_num_threads(1)
        assert str(error) in str(caught.value)
        assert caught.value.__cause__ is error

    @pytest.mark.usefixtures("unchecked")
    def test_the_backend_says_so(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(native, "_kernels", None)
        monkeypatch.setattr(native, "_import_error", self.NOT_THERE)
        with pytest.raises(MissingDependencyError, match="the native kernels are not built") as caught:
            tube(10, 8, 8).render("native")
        assert caught.value.__cause__ is self.NOT_THERE


def test_a_forked_child_has_threads_of_its_own(threads: None) -> None:
    """The parent's threads do not survive a fork: waiting for them would hang the child."""
    set_num_threads(2)
    scene = tube(2000, 130, 101)
    expected = scene.render("native").rgb.numpy().tobytes()
    # Compared as bytes: torch's own threads do not survive a fork either.
    assert exit_code_of_child(lambda: scene.render("native").rgb.numpy().tobytes() == expected) == 0


def test_backends_that_work_here() -> None:
    assert available_backends()[-1] == "reference"
    assert "native" in available_backends(), "build the kernels: pip install -e ."
    assert tube(10, 8, 8).to(torch.float64).render("auto").rgb.dtype == torch.float64
