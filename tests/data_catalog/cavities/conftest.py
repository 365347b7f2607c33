"""Small cavities: coarse walls, small tiles, few pictures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from data_catalog.cavities import skin
from data_catalog.cavities.pretraining import CavityConfig, cavity_config
from data_catalog.cavities.scene import Cavity, build_cavity

NODES = 40_000


@pytest.fixture(scope="session", autouse=True)
def _small_tiles() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(skin, "_GROUND_SIDE", 128)
        patch.setattr(skin, "_PATCH_SIDE", 64)
        yield


@pytest.fixture(scope="session")
def colon() -> Cavity:
    return build_cavity(0, "colon", nodes=NODES)


@pytest.fixture
def small() -> CavityConfig:
    return cavity_config(4).model_copy(
        update={
            "width": 48,
            "height": 32,
            "train_frames": 4,
            "clips": 2,
            "supersample": 1,
            "nodes": NODES,
        }
    )
