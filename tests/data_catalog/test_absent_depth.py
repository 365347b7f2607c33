"""Frames without a depth file where others have one: their depth is unknown, which is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_catalog import glance
from data_catalog.catalog import read
from data_catalog.diagnostics import _depth
from data_catalog.readers.colmap_model import write_colmap, write_depth_map
from data_catalog.readers.transforms_json import write_transforms
from extrags.config import IngestConfig
from extrags.errors import SourceNotFoundError
from extrags.sequence import EndoscopicSequence


def colmap(sequence: EndoscopicSequence, folder: Path) -> Callable[[int], None]:
    write_colmap(sequence, folder)
    assert sequence.depth_mm is not None
    maps = folder / "stereo" / "depth_maps"
    for index, depth in enumerate(sequence.depth_mm):
        write_depth_map(maps / f"{index:04d}.png.geometric.bin", depth)
    return lambda index: (maps / f"{index:04d}.png.geometric.bin").unlink()


def absent_file(sequence: EndoscopicSequence, folder: Path) -> Callable[[int], None]:
    write_transforms(sequence, folder)
    return lambda index: (folder / "depth" / f"{index:04d}.npy").unlink()


def not_named(sequence: EndoscopicSequence, folder: Path) -> Callable[[int], None]:
    write_transforms(sequence, folder)
    file = folder / "transforms.json"

    def remove(index: int) -> None:
        content = json.loads(file.read_text())
        del content["frames"][index]["depth_file_path"]
        file.write_text(json.dumps(content))

    return remove


@pytest.mark.parametrize("write", [colmap, absent_file, not_named])
def test_it_is_unknown_there(write, clip, tmp_path, caplog) -> None:
    remove = write(clip, tmp_path / "scene")
    whole = read(tmp_path / "scene")
    assert "have no depth" not in caplog.text
    # The first frame is held out.
    for index in (0, 6):
        remove(index)
    found = read(tmp_path / "scene")
    assert "2 of 10 frames, 0000.png first, have no depth" in caplog.text.replace("images/", "")
    assert not found.depth_mm[[0, 6]].any()
    kept = [index for index in range(10) if index not in (0, 6)]
    np.testing.assert_array_equal(found.depth_mm[kept], whole.depth_mm[kept])
    np.testing.assert_array_equal(found.rgb, whole.rgb)


class TestPoses:
    def test_it_is_unknown_there(self, posed_folder, caplog) -> None:
        whole = read(posed_folder)
        (posed_folder / "depth" / "0000.npy").unlink()
        found = read(posed_folder)
        assert "poses.json: 1 of 10 frames, rgb/0000.png first, have no depth" in caplog.text
        np.testing.assert_array_equal(found.depth_mm[1:], whole.depth_mm[1:])
        assert not found.depth_mm[0].any()
        assert glance(posed_folder).has_depth

    def test_as_small_as_the_others(self, posed_folder) -> None:
        (posed_folder / "depth" / "0003.npy").unlink()
        found = read(posed_folder, IngestConfig(width=24))
        assert found.depth_mm.shape == found.mask.shape
        assert found.depth_mm.dtype == np.float32

    def test_frames_that_are_left_out_do_not_count(self, posed_folder, caplog) -> None:
        """Nor do those that are kept all have a map of zeros where none of them has a file."""
        for number in range(10):
            if number not in (1, 2):
                (posed_folder / "depth" / f"{number:04d}.npy").unlink()
        found = read(posed_folder, IngestConfig(max_frames=2))
        assert found.depth_mm is None
        assert "have no depth" not in caplog.text

    def test_none_is_named_after_a_frame(self, posed_folder) -> None:
        for file in list((posed_folder / "depth").iterdir()):
            file.rename(file.with_stem(f"depth_{file.stem}"))
        with pytest.raises(
            SourceNotFoundError, match=r"0000\.npy, frame rgb/0000\.png, field depth: no depth"
        ):
            read(posed_folder)

    def test_the_warning_is_a_finding(self, posed_folder, caplog) -> None:
        """Of the same topic as that of maps that know little, so that it is said once."""
        (posed_folder / "depth" / "0000.npy").unlink()
        found = read(posed_folder)
        (record,) = caplog.records
        assert (record.topic, record.field) == ("depth coverage", "depth")
        assert [item.topic for item in _depth(found)] == [record.topic]


def test_the_first_frame_with_depth_tells_how_fine_it_is(clip) -> None:
    depth = clip.depth_mm.copy()
    depth[0] = 0
    assert "depth resolution" not in {item.topic for item in _depth(replace(clip, depth_mm=depth))}


def test_none_of_those_that_are_named(clip, tmp_path) -> None:
    remove = absent_file(clip, tmp_path / "scene")
    for index in range(len(clip)):
        remove(index)
    with pytest.raises(SourceNotFoundError, match=r"0000\.npy.*field depth_file_path: no such file"):
        read(tmp_path / "scene")
