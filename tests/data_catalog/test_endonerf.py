"""EndoNeRF's layout: LLFF axes, and masks of either polarity."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.inspection import inspect
from data_catalog.readers.endonerf import mask_polarity, polarity_of_images
from extrags.errors import SourceError
from tests.data_catalog.layouts import AS_STORED, carried_error_mm, with_tool, write_endonerf


def test_poses_come_back(clip, tmp_path) -> None:
    write_endonerf(clip, tmp_path)
    assert resolve(tmp_path).format == "endonerf"
    back = read(tmp_path)
    assert back.metric
    np.testing.assert_allclose(back.cameras.world_from_camera, clip.cameras.world_from_camera, atol=1e-12)
    np.testing.assert_allclose(back.K, clip.K, atol=1e-12)
    np.testing.assert_array_equal(back.rgb, clip.rgb)


def test_depth_carried_from_frame_to_frame(clip, tmp_path) -> None:
    """Depth is stored in whole millimetres here, which bounds how well it can agree."""
    write_endonerf(clip, tmp_path)
    rounded = replace(clip, depth_mm=np.round(clip.depth_mm))
    found = carried_error_mm(read(tmp_path))
    assert found == pytest.approx(carried_error_mm(rounded), abs=1e-4)
    assert found < 0.5


@pytest.mark.parametrize("part", ["depth", "masks"])
def test_arrays_in_place_of_images_are_told_of(clip, tmp_path, caplog, part) -> None:
    write_endonerf(clip, tmp_path)
    shutil.rmtree(tmp_path / "depth")
    (tmp_path / part).mkdir()
    for index in range(len(clip)):
        np.save(tmp_path / part / f"{index:04d}.npy", np.ones(clip.mask.shape[1:]))
    assert read(tmp_path).depth_mm is None
    told = f"{part}/ holds no images, and what it holds is not read (10 files, the first is 0000.npy)"
    assert caplog.text.count(told) == 1
    assert any(told in note for note in inspect(tmp_path).notes)


class TestNumbersOfNames:
    """Depth and masks were paired by their order alone."""

    def written(self, clip, folder, part) -> None:
        sequence, tool = with_tool(clip)
        write_endonerf(sequence, folder, tool)
        for other in {"depth", "masks"} - {part}:
            shutil.rmtree(folder / other)

    @pytest.mark.parametrize("part", ["depth", "masks"])
    def test_a_hole_on_either_side_is_refused(self, clip, tmp_path, part) -> None:
        self.written(clip, tmp_path, part)
        (tmp_path / "images" / "frame-000003.png").unlink()
        (tmp_path / part / "frame-000007.png").unlink()
        rows = np.load(tmp_path / "poses_bounds.npy")
        np.save(tmp_path / "poses_bounds.npy", np.delete(rows, 3, axis=0))
        field = "mask" if part == "masks" else part
        with pytest.raises(
            SourceError,
            match=rf"{part}/frame-000003\.png, frame frame-000004\.png, field {field}: .* would belong to "
            r"images/frame-000004\.png, and the one before it, frame-000002\.png, to",
        ):
            read(tmp_path)
        # Nor is what was made of it before.
        with pytest.raises(SourceError, match="their numbers go apart"):
            source_fingerprint(tmp_path)

    def test_a_file_too_many_and_one_missing_are_refused(self, clip, tmp_path) -> None:
        self.written(clip, tmp_path, "depth")
        (tmp_path / "depth" / "frame-000005.png").rename(tmp_path / "depth" / "frame-000000a.png")
        with pytest.raises(SourceError, match=r"depth/frame-000000a\.png, frame frame-000001\.png"):
            read(tmp_path)

    def test_decimals_stay_with_their_frames(self, clip, tmp_path) -> None:
        self.written(clip, tmp_path, "depth")
        expected = read(tmp_path, AS_STORED)
        for part in ("images", "depth"):
            for k, file in enumerate(sorted((tmp_path / part).iterdir())):
                file.rename(file.with_stem(f"{k * 0.05:g}"))
        found = read(tmp_path, AS_STORED)
        assert found.frame_names == tuple(f"{k * 0.05:g}" for k in range(len(found)))
        np.testing.assert_array_equal(found.rgb, expected.rgb)
        np.testing.assert_array_equal(found.depth_mm, expected.depth_mm)
        assert source_fingerprint(tmp_path)["order"] == "decimals"

    @pytest.mark.parametrize("renamed", ["{}.depth", "depth-{}", "0007_{}_96", "{}_77", "d"])
    def test_names_may_differ_otherwise(self, clip, tmp_path, renamed) -> None:
        self.written(clip, tmp_path, "depth")
        expected = read(tmp_path, AS_STORED).depth_mm
        for k, file in enumerate(sorted((tmp_path / "depth").iterdir())):
            # Of "d", letters tell the order, and there is no number.
            stem = f"d{chr(ord('a') + k)}" if renamed == "d" else renamed.format(f"{k + 1:06d}")
            file.rename(file.with_stem(stem))
        np.testing.assert_array_equal(read(tmp_path, AS_STORED).depth_mm, expected)


@pytest.mark.parametrize(
    ("white_is_tissue", "folder"), [(False, "masks"), (True, "masks"), (True, "gt_masks")]
)
def test_polarity_is_found_and_stated(clip, tmp_path, caplog, white_is_tissue, folder) -> None:
    sequence, tool = with_tool(clip)
    write_endonerf(sequence, tmp_path, tool != white_is_tissue, mask_folder=folder)
    with caplog.at_level(logging.INFO):
        back = read(tmp_path, AS_STORED)
    np.testing.assert_array_equal(back.mask, ~tool)
    stated = "white is tissue, by colour" if white_is_tissue else "white is tool, by colour"
    assert stated in caplog.text
    assert stated in mask_polarity(tmp_path).because
    assert any(stated in note for note in inspect(tmp_path).notes)


def test_grey_tissue_is_told_by_area() -> None:
    rgb = np.full((2, 20, 20, 3), 110, np.uint8)
    white = np.zeros((2, 20, 20), bool)
    white[:, :4] = True
    assert polarity_of_images(rgb, white).white_is_tissue is False
    assert polarity_of_images(rgb, ~white).white_is_tissue is True
    assert "by area" in polarity_of_images(rgb, white).because


def test_one_value_throughout_is_tissue() -> None:
    rgb = np.full((2, 20, 20, 3), 110, np.uint8)
    assert polarity_of_images(rgb, np.zeros((2, 20, 20), bool)).white_is_tissue is False
    assert polarity_of_images(rgb, np.ones((2, 20, 20), bool)).white_is_tissue is True


def test_masks_that_tell_nothing_are_refused() -> None:
    rgb = np.full((2, 20, 20, 3), 110, np.uint8)
    white = np.zeros((2, 20, 20), bool)
    white[:, :10] = True
    with pytest.raises(SourceError, match="cannot be told"):
        polarity_of_images(rgb, white)
