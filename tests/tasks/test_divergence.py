from __future__ import annotations

from pathlib import Path

import pytest
import torch

from extrags.errors import DivergedError
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.store import Store
from tasks.divergence import keep_last_finite_scene


def test_the_last_good_scene_is_kept_and_nothing_is_cached(tmp_path: Path) -> None:
    n = 3
    scene = Scene(
        Gaussians(
            torch.zeros(n, 3), torch.ones(n, 4), torch.zeros(n, 3), torch.zeros(n),
            torch.zeros(n, 1, 3), torch.zeros(n, 0, 3),
        )
    )  # fmt: skip
    store = Store(str(tmp_path))
    with (
        pytest.raises(DivergedError, match="iteration 7") as caught,
        store.slot(stage="coarse", version=1, key="coarse-v1-test", label="", config={}, inputs={}) as slot,
        keep_last_finite_scene(slot),
    ):
        raise DivergedError("coarse: not finite any more at iteration 7", scene)
    assert store.find("coarse-v1-test") is None
    kept = list(tmp_path.glob("failed/**/last_good_scene"))
    assert len(kept) == 1
    assert len(Scene.load(kept[0]).gaussians) == n
    assert caught.value.last_good is None, "an outcome keeps the error for as long as its run"
