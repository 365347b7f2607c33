"""Fixtures for every test; nothing here starts a server."""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jaxtyping
import numpy as np
import pytest

from tests.array_checks import check_arrays_alone

# Before torch is loaded: OpenMP threads that spin while they wait starve each other on small machines.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

check_arrays_alone()

FLOWS = "tests/flows"
PIPELINES = "tests/extrags/restoration/pretrained"
SHARING = (FLOWS, PIPELINES)
"""Packages whose tests share a server and a finished run, or pipelines that are slow to import."""
APART = frozenset(
    f"{FLOWS}/test_{name}.py"
    for name in (
        "bench_enhance",
        "bench_explore",
        "cache_keys",
        "cli_bench_kernels",
        "cli_completion",
        "continuation",
        "data_commands",
        "depth_stage",
        "imports",
        "memory_limit",
        "pipeline_grid",
        "pretrain",
        "run_costs",
    )
)
"""Files inside such a package that share none of it: without them the process of the flows, which would end
last, has a quarter less to do."""
SHARED_BY_FLOWS = frozenset({"prefect_server", "finished", "frames_read"})
"""Fixtures that no test of `APART` may have: a second server costs more than is gained."""
JOINING = {"tests/extrags/restoration/test_backends.py": PIPELINES}
"""Files beside a package that share what its tests share."""
LONG = (
    FLOWS,
    PIPELINES,
    "tests/extrags/poses/test_estimate.py",
    "tests/data_catalog/test_c3vd_scenes.py",
)
"""The groups that take longest."""

SHARED_DATA = Path(os.environ.get("EXTRAGS_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
"""A caller's choice, else the folder beside the checkout."""

# The library itself never looks beside a checkout.
if SHARED_DATA.is_dir():
    os.environ["EXTRAGS_DATA"] = str(SHARED_DATA)
    os.environ.setdefault("EXTRAGS_LPIPS_WEIGHTS", str(SHARED_DATA / "lpips_weights"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--runslow", action="store_true", help="run tests marked slow")


def pytest_configure(config: pytest.Config) -> None:
    # Of several processes of tests each has one thread, and so have the programs that it starts. It is said
    # before they begin: their plugins load numpy, which makes its threads then.
    if config.getoption("numprocesses", None):
        os.environ["OMP_NUM_THREADS"] = "1"


def group_of(nodeid: str) -> str:
    """What one process runs: a file, whose fixtures are made once, or a package that shares dearer ones."""
    file = nodeid.partition("::")[0]
    if file in APART:
        return file
    found = next((package for package in SHARING if file.startswith(f"{package}/")), file)
    return JOINING.get(found, found)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Schedule by `group_of`, in the order of the tests.

    Not by marks of groups: xdist 3.8 writes them to where pytest from 9.2 on does not look, and every test
    is then a group of its own, whose module's fixtures are made by every process.
    """
    if config.getvalue("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid)

    # By the number of tests, which says little of how long they take.
    config.option.loadscopereorder = False
    return Groups(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays to the end: looking through it for garbage is work for nothing."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    # Seen with several processes alone, between which addresses differ.
    named = [item.nodeid for item in items if " at 0x" in item.nodeid]
    if named:
        raise pytest.UsageError(
            f"the name of a test holds an address, so give its parameters ids: {named[0]}"
        )
    for item in items:
        if group_of(item.nodeid) in APART and SHARED_BY_FLOWS & {*getattr(item, "fixturenames", ())}:
            raise pytest.UsageError(f"its file is one of `APART`, and it shares what flows do: {item.nodeid}")
    # Long groups first: one that begins last keeps the other processes waiting for it.
    rank = {group: place for place, group in enumerate(LONG)}
    items.sort(key=lambda item: rank.get(group_of(item.nodeid), len(rank)))
    if not config.getoption("--runslow"):
        skip = pytest.mark.skip(reason="slow; run with --runslow")
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def one_thread_of_the_kernels() -> None:
    """As `pytest_configure` has it for torch: where several processes run tests, none divides its work.

    A thread that helps waits actively for the next kernel, which cost half as much again as the kernels
    themselves. Tests of threads set their number.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        from extrags.raster import native

        if native.native_isa():
            native.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def each_colon_is_built_and_painted_once() -> Iterator[None]:
    """Anatomy and texture of the last few scenes stay: of a small recording they are half of the work.

    They depend on nothing but what names them here, which `tests.data_catalog.test_phantom` proves. Nobody
    can write into them.
    """
    from data_catalog.phantom import recording

    @functools.lru_cache(maxsize=3)
    def built(scene: int, polyps: int, variation: float) -> tuple[Any, Any]:
        config = recording.PhantomConfig(scene=scene, polyps=polyps, variation=variation)
        wall = build_wall(config)
        texture = paint(config, wall)
        for array in (*vars(wall).values(), *vars(wall.center_line).values(), *texture.levels):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False
        return wall, texture

    build_wall, paint = recording.build_wall, recording.paint
    with (
        patch.object(recording, "build_wall", lambda of: built(of.scene, of.polyps, of.variation)[0]),
        patch.object(recording, "paint", lambda of, _: built(of.scene, of.polyps, of.variation)[1]),
    ):
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Third-party data: `$EXTRAGS_DATA`, else beside the checkout."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no $EXTRAGS_DATA, and no ../shared/data beside the checkout")
    return SHARED_DATA


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch the tests' shape checks off, to see the errors that users see."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
