"""Fixtures that several rooms of the library share."""

from __future__ import annotations

import pytest

from tests.extrags.lit_tube import Tube, build_tube


@pytest.fixture(scope="session")
def tube() -> Tube:
    return build_tube()
