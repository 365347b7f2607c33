"""Deliberately damaged inputs: each is reported in words that name file, frame and field, and what to do."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog.inspection import inspect
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from tests.data_catalog.damaged_inputs import DAMAGES
from tests.data_catalog.layouts import write_endonerf


@pytest.fixture(scope="module")
def good(clip, tmp_path_factory) -> dict[str, Path]:
    """One good folder of each layout."""
    root = tmp_path_factory.mktemp("good")
    bare = replace(clip, depth_mm=None)
    folders = {name: root / name for name in ("extrags", "bare", "colmap", "text", "transforms", "ngp")}
    for name, sequence in (("extrags", clip), ("bare", bare)):
        _write_posed(sequence, folders[name])
    write_colmap(bare, folders["colmap"])
    write_colmap(bare, folders["text"], binary=False)
    write_transforms(clip, folders["transforms"])
    write_transforms(bare, folders["ngp"])
    folders["endonerf"] = root / "endonerf"
    tool = np.zeros(clip.mask.shape, bool)
    tool[:, 40:60, :20] = True
    write_endonerf(clip, folders["endonerf"], tool)
    folders["frames"] = root / "frames"
    folders["frames"].mkdir()
    for k in range(4):
        Image.fromarray(clip.rgb[k]).save(folders["frames"] / f"{k}.png")
    (folders["frames"] / "intrinsics.json").write_text(json.dumps({"K": clip.K[0].tolist()}))
    return folders


def _write_posed(sequence, folder: Path) -> None:
    (folder / "rgb").mkdir(parents=True)
    frames = []
    for k in range(len(sequence)):
        Image.fromarray(sequence.rgb[k]).save(folder / "rgb" / f"{k:04d}.png")
        if sequence.depth_mm is not None:
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / "depth" / f"{k:04d}.npy", sequence.depth_mm[k])
        pose = sequence.cameras.world_from_camera[k].tolist()
        frames.append({"file": f"rgb/{k:04d}.png", "world_from_camera": pose})
    content = {"length_unit": "mm", "K": sequence.K[0].tolist(), "frames": frames}
    (folder / "poses.json").write_text(json.dumps(content))


@pytest.mark.parametrize("name", DAMAGES)
def test_each_is_reported(good, tmp_path, name) -> None:
    damage = DAMAGES[name]
    folder = tmp_path / damage.layout
    shutil.copytree(good[damage.layout], folder)
    damage.do(folder)
    inspection = inspect(folder)
    assert not inspection.ok
    told = [finding for finding in inspection.findings if re.search(damage.sentence, finding.sentence)]
    assert told, "\n".join(str(finding) for finding in inspection.findings)
    finding = told[0]
    assert finding.file is not None
    assert finding.file.startswith(str(tmp_path))
    assert finding.frame == damage.frame
    if damage.field is not None:
        assert finding.field == damage.field
    if damage.file is not None:
        assert finding.file.endswith(damage.file)


def test_there_are_enough_of_them() -> None:
    assert len(DAMAGES) >= 40


@pytest.mark.parametrize(
    "layout", ["extrags", "bare", "colmap", "text", "transforms", "ngp", "endonerf", "frames"]
)
def test_the_good_ones_are_good(good, layout) -> None:
    inspection = inspect(good[layout])
    expected = {"depth resolution", "depth and poses"} if layout == "endonerf" else set()
    assert {finding.topic for finding in inspection.findings} <= expected, inspection.findings
