"""Fixtures for every test; nothing here starts a server."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest

# Before torch is loaded: OpenMP threads that spin while they wait starve each other on small machines.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Of several processes of tests each has one thread, and so have the programs that it starts.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
# The library itself never looks beside a checkout.
if SHARED_DATA.is_dir():
    os.environ["EXTRAGS_DATA"] = str(SHARED_DATA)
    os.environ["EXTRAGS_LPIPS_WEIGHTS"] = str(SHARED_DATA / "lpips_weights")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--runslow", action="store_true", help="run tests marked slow")


# Before xdist's own hook, which puts the groups into the names of tests.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        # Fixtures of a module are made in one process only.
        item.add_marker(pytest.mark.xdist_group(str(item.path)))
    if not config.getoption("--runslow"):
        skip = pytest.mark.skip(reason="slow; run with --runslow")
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Third-party data beside the checkout."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no ../shared/data beside the checkout")
    return SHARED_DATA


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch the tests' shape checks off, to see the errors that users see."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
