"""Small phantoms, and folders written from them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.recording import record
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.layouts import first_frames

SMALL = {"width": 64, "height": 51, "supersample": 1}


@pytest.fixture(scope="session")
def sparse() -> EndoscopicSequence:
    return record(PhantomConfig(scene=0, setting="sparse", **SMALL), "phantom/0@sparse")


@pytest.fixture(scope="session")
def distanced() -> EndoscopicSequence:
    return record(PhantomConfig(scene=0, setting="distanced", **SMALL), "phantom/0@distanced")


@pytest.fixture(scope="session")
def clip() -> EndoscopicSequence:
    """Ten neighbouring frames with depth, poses and texture enough to match: what importers are given."""
    config = PhantomConfig(
        scene=1, width=96, height=77, train_every=20, test_frames=1, shadows=False, supersample=1
    )
    return first_frames(record(config, "phantom/1"), 10)


@pytest.fixture(scope="session")
def pristine_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good folder in extrags' own format: ten frames with depth."""
    config = PhantomConfig(
        scene=1, width=48, height=40, train_every=20, test_frames=1, shadows=False, supersample=1
    )
    sequence = record(config, "phantom/1")
    folder = tmp_path_factory.mktemp("pristine") / "colon"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    assert sequence.world_from_camera is not None
    assert sequence.depth_mm is not None
    frames = []
    for k in sequence.train:
        Image.fromarray(sequence.rgb[k]).save(folder / "rgb" / f"{k:04d}.png")
        np.save(folder / "depth" / f"{k:04d}.npy", sequence.depth_mm[k])
        pose = sequence.world_from_camera[k].tolist()
        frames.append({"file": f"rgb/{k:04d}.png", "world_from_camera": pose})
    content = {"length_unit": "mm", "K": sequence.K[0].tolist(), "frames": frames}
    (folder / "poses.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def posed_folder(pristine_folder: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(pristine_folder, tmp_path / "colon"))


@pytest.fixture
def edit_poses(posed_folder: Path) -> Callable[[Callable[[dict[str, Any]], None]], None]:
    """Change `poses.json` in place."""

    def edit(change: Callable[[dict[str, Any]], None]) -> None:
        file = posed_folder / "poses.json"
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))

    return edit
