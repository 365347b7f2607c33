from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from zarr.storage import ZipStore

from extrags.cameras import Cameras, pixel_rays
from extrags.errors import ShapeError
from extrags.sequence import EndoscopicSequence, Split, saturated_mask
from extrags.store import content_digest


def small_sequence(frames: int = 4) -> EndoscopicSequence:
    generator = np.random.default_rng(0)
    return EndoscopicSequence(
        name="test/0@half",
        rgb=generator.integers(0, 255, (frames, 6, 8, 3), dtype=np.uint8),
        K=np.tile(np.array([[8.0, 0, 4], [0, 8.0, 3], [0, 0, 1]]), (frames, 1, 1)),
        mask=generator.random((frames, 6, 8)) > 0.2,
        split=Split("half", np.array([0, 2]), np.array([1, 3]), version=2),
        world_from_camera=np.tile(np.eye(4), (frames, 1, 1)),
        depth_mm=generator.random((frames, 6, 8)).astype(np.float32),
        recording=np.array([0, 1] * (frames // 2)),
        frame_names=tuple(f"frame{i}" for i in range(frames)),
        observed=generator.random((frames, 6, 8)) > 0.5,
        points=generator.random((5, 3)),
        points_rgb=generator.integers(0, 255, (5, 3), dtype=np.uint8),
        truth={"exposure": [1.0, 1.25]},
    )


class TestAtMostWidth:
    def test_halved_frames(self) -> None:
        sequence = replace(small_sequence(), specular=np.random.default_rng(1).random((4, 6, 8)) > 0.8)
        small = sequence.at_most_width(4)
        assert (small.width, small.height, len(small)) == (4, 3, 4)
        blocks = sequence.rgb.reshape(4, 3, 2, 4, 2, 3).astype(np.float64)
        np.testing.assert_allclose(small.rgb, blocks.mean(axis=(2, 4)), atol=0.5 + 1e-6)

        def pairs(stack: np.ndarray) -> np.ndarray:
            return stack.reshape(4, 3, 2, 4, 2)

        assert sequence.observed is not None
        assert sequence.specular is not None
        np.testing.assert_array_equal(small.mask, pairs(sequence.mask).all(axis=(2, 4)))
        np.testing.assert_array_equal(small.observed, pairs(sequence.observed).all(axis=(2, 4)))
        # One highlight in the area is enough.
        np.testing.assert_array_equal(small.specular, pairs(sequence.specular).any(axis=(2, 4)))
        assert small.depth_mm is not None
        assert sequence.depth_mm is not None
        np.testing.assert_allclose(small.K[:, :2], sequence.K[:, :2] / 2)
        assert (small.split, small.world_from_camera is sequence.world_from_camera) == (sequence.split, True)

    @pytest.mark.parametrize("width", [80, 40, 53])
    def test_depth_is_that_at_the_centre_of_a_pixel(self, width: int) -> None:
        """Exactly, on a plane that leans away."""

        def plane(cameras: Cameras) -> np.ndarray:
            x, y, _ = np.moveaxis(pixel_rays(cameras)[0], -1, 0)
            return (10 / (1 + 0.5 * x + 0.3 * y)).astype(np.float32)[None]

        K = np.array([[[160.0, 0, 80], [0, 160.0, 60], [0, 0, 1]]])
        poses = np.eye(4)[None]
        depth_mm = plane(Cameras(K, poses, 160, 120))
        sequence = EndoscopicSequence(
            "plane",
            np.zeros((1, 120, 160, 3), np.uint8),
            K,
            np.ones((1, 120, 160), bool),
            Split("all", np.arange(1), np.arange(0)),
            poses,
            depth_mm,
            withheld_depth_mm=depth_mm,
        )
        small = sequence.at_most_width(width)
        np.testing.assert_allclose(small.depth_mm, plane(small.cameras), rtol=1e-5)
        np.testing.assert_array_equal(small.depth_mm, small.withheld_depth_mm)

    def test_depth_is_of_one_side_of_an_edge(self) -> None:
        sequence = small_sequence()
        depth_mm = np.where(np.arange(8) < 3, 10.0, 30.0).astype(np.float32) * np.ones((4, 6, 1), np.float32)
        depth_mm[0, :2] = 0
        small = replace(sequence, depth_mm=depth_mm, withheld_depth_mm=None).at_most_width(4)
        assert small.depth_mm is not None
        assert set(np.unique(small.depth_mm)) == {0.0, 10.0, 30.0}
        np.testing.assert_array_equal(small.depth_mm[1], [[10, 10, 30, 30]] * 3)

    def test_narrow_ones_stay(self) -> None:
        sequence = small_sequence()
        assert sequence.at_most_width(8) is sequence


class TestSequence:
    def test_round_trip_through_zarr(self, tmp_path: Path) -> None:
        sequence = small_sequence()
        sequence.save(tmp_path / "sequence")
        loaded = EndoscopicSequence.load(tmp_path / "sequence")
        for name in ("rgb", "K", "mask", "world_from_camera", "depth_mm", "recording", "observed",
                     "points", "points_rgb"):  # fmt: skip
            np.testing.assert_array_equal(getattr(loaded, name), getattr(sequence, name))
            assert getattr(loaded, name).dtype == getattr(sequence, name).dtype
        np.testing.assert_array_equal(loaded.train, [0, 2])
        assert (loaded.split.name, loaded.split.version) == ("half", 2)
        assert loaded.truth == sequence.truth
        assert loaded.frame_names == sequence.frame_names

    def test_absent_parts_stay_absent(self, tmp_path: Path) -> None:
        bare = replace(small_sequence(), depth_mm=None, points=None, world_from_camera=None)
        bare.save(tmp_path / "sequence")
        loaded = EndoscopicSequence.load(tmp_path / "sequence")
        assert loaded.depth_mm is None
        assert loaded.points is None
        with pytest.raises(ShapeError, match="no poses"):
            _ = loaded.cameras

    def test_one_frame_per_chunk(self, tmp_path: Path) -> None:
        small_sequence().save(tmp_path / "sequence")
        group = zarr.open_group(ZipStore(tmp_path / "sequence.zarr.zip", mode="r"), mode="r")
        assert group["rgb"].chunks == (1, 6, 8, 3)

    def test_same_content_gives_same_bytes(self, tmp_path: Path) -> None:
        for name in "ab":
            small_sequence().save(tmp_path / name)
        assert (tmp_path / "a.zarr.zip").read_bytes() == (tmp_path / "b.zarr.zip").read_bytes()

    @pytest.mark.usefixtures("unchecked")
    @pytest.mark.parametrize("field", ["mask", "K", "depth_mm", "observed", "recording"])
    def test_wrong_length_is_refused_by_name(self, field: str) -> None:
        sequence = small_sequence()
        with pytest.raises(ShapeError, match=field):
            replace(sequence, **{field: getattr(sequence, field)[:-1]})

    @pytest.mark.usefixtures("unchecked")
    @pytest.mark.parametrize(
        ("field", "dtype", "message"),
        [
            ("rgb", np.float32, "rgb is float32 .* expected uint8"),
            ("mask", np.uint8, "mask is uint8 .* expected bool"),
            ("depth_mm", np.uint16, "depth_mm is uint16 .* expected floating"),
            ("recording", np.float64, "recording is float64 .* expected integer"),
        ],
    )
    def test_wrong_type_is_refused_by_name(self, field: str, dtype: type, message: str) -> None:
        """Colours in [0, 1] would be trained on, and then be compared with what is divided by 255."""
        sequence = small_sequence()
        with pytest.raises(ShapeError, match=message):
            replace(sequence, **{field: getattr(sequence, field).astype(dtype)})

    @pytest.mark.parametrize("name", ["train", "test"])
    @pytest.mark.parametrize("index", [-1, 50])
    def test_a_split_of_frames_that_are_not_there_is_refused(self, name: str, index: int) -> None:
        sequence = small_sequence()
        with pytest.raises(ShapeError, match=rf"split.{name} has indices"):
            replace(sequence, split=replace(sequence.split, **{name: np.array([0, index])}))

    @pytest.mark.usefixtures("unchecked")
    @pytest.mark.parametrize(
        ("field", "value", "message"),
        [
            ("mask", None, r"test/0@half: mask is NoneType, expected a NumPy array, bool"),
            ("K", None, "K is NoneType"),
            ("rgb", None, "rgb is NoneType"),
            ("rgb", [[0]], "rgb is list, expected a NumPy array, uint8"),
            ("split", None, "split is NoneType, expected Split"),
            ("split", ([0], [1]), "split is tuple, expected Split"),
        ],
    )
    def test_what_is_no_array_is_refused_by_name(self, field: str, value: Any, message: str) -> None:
        with pytest.raises(ShapeError, match=message):
            replace(small_sequence(), **{field: value})

    @pytest.mark.usefixtures("unchecked")
    @pytest.mark.parametrize("indices", [[0, 2], np.array([True, False]), np.array([0.0]), np.array(1)])
    def test_a_split_of_anything_but_indices_is_refused(self, indices: np.ndarray) -> None:
        with pytest.raises(ShapeError, match=r"split half: train is .*, expected .*integer \(any\)"):
            Split("half", indices, np.array([1]))

    @pytest.mark.usefixtures("unchecked")
    def test_an_empty_part_of_a_split_may_be_of_any_type(self) -> None:
        """`np.array([])` is of floats."""
        split = Split("all", np.arange(4), np.array([]))
        assert split.test.dtype == np.int64
        sequence = replace(small_sequence(), split=split)
        assert sequence.rgb[sequence.test].shape == (0, *sequence.rgb.shape[1:])

    def test_its_representation_is_a_line(self) -> None:
        sequence = replace(small_sequence(), truth={"exposure": list(range(5000))})
        assert repr(sequence) == (
            "EndoscopicSequence('test/0@half', 4 frames of 8 x 6 px, 2 train and 2 held out (half), "
            "poses given, depth of training frames, millimetres as the source has them, pinhole)"
        )
        hidden = replace(sequence, world_from_camera=None).without_training_depth()
        assert "no poses, depth for the evaluation alone" in repr(hidden)
        bare = replace(sequence, depth_mm=None, metric=False)
        assert "no depth, arbitrary scale" in repr(bare)
        estimated = replace(sequence, depth_error=np.zeros((4, 6, 8), np.float32))
        assert "depth with an expected error" in repr(estimated)

    @pytest.mark.usefixtures("unchecked")
    def test_wrong_number_of_names(self) -> None:
        with pytest.raises(ShapeError, match="frame names"):
            replace(small_sequence(), frame_names=("a",))


def test_the_training_part_holds_nothing_of_the_held_out_frames(tmp_path: Path) -> None:
    whole = small_sequence()
    part = whole.training_part()
    np.testing.assert_array_equal(part.rgb, whole.rgb[whole.train])
    np.testing.assert_array_equal(part.train, np.arange(len(whole.train)))
    assert len(part.test) == 0
    assert part.observed is None
    assert part.truth == {}
    # What is held out does not change it, not even its name.
    rgb = whole.rgb.copy()
    rgb[whole.test] = 7
    other = replace(whole, rgb=rgb, name=whole.name.split("@")[0] + "@other", truth={"light": 1})
    for index, sequence in enumerate((whole, other)):
        sequence.training_part().save(tmp_path / str(index) / "sequence")
    assert content_digest(tmp_path / "0") == content_digest(tmp_path / "1")


def test_highlights_do_not_supervise_and_saturation_is_told_apart() -> None:
    sequence = small_sequence()
    np.testing.assert_array_equal(sequence.supervised_mask(1), sequence.mask[1])
    specular = np.zeros(sequence.mask.shape, bool)
    specular[1, 2, 3] = True
    marked = replace(sequence, specular=specular)
    expected = sequence.mask.copy()
    expected[1, 2, 3] = False
    np.testing.assert_array_equal(marked.supervised_mask(1), expected[1])
    np.testing.assert_array_equal(marked.supervised_mask(np.array([0, 1])), expected[:2])
    # A copy: narrowing it further must not touch the sequence.
    marked.supervised_mask(0)[:] = False
    assert marked.mask[0].any()
    pixels = np.array([[[249, 249, 249], [0, 250, 0]]], np.uint8)
    np.testing.assert_array_equal(saturated_mask(pixels), [[False, True]])


class TestWithoutTrainingDepth:
    def test_only_the_evaluation_knows_depth(self, tmp_path: Path) -> None:
        whole = small_sequence()
        assert whole.depth_mm is not None
        assert whole.training_depth_known
        hidden = whole.without_training_depth()
        assert hidden.depth_mm is not None
        assert not hidden.training_depth_known
        assert hidden.metric
        assert not hidden.depth_mm[hidden.train].any()
        np.testing.assert_array_equal(hidden.depth_mm[hidden.test], whole.depth_mm[whole.test])
        np.testing.assert_array_equal(hidden.true_depth_mm, whole.depth_mm)
        assert (hidden.points, hidden.points_rgb) == (None, None)
        part = hidden.training_part()
        assert (part.depth_mm, part.withheld_depth_mm, part.true_depth_mm) == (None, None, None)
        hidden.save(tmp_path / "sequence")
        loaded = EndoscopicSequence.load(tmp_path / "sequence")
        np.testing.assert_array_equal(loaded.true_depth_mm, whole.depth_mm)
        small = hidden.at_most_width(4)
        assert small.withheld_depth_mm is not None
        assert small.withheld_depth_mm.shape == (4, 3, 4)
        assert whole.depth_mm[whole.train].any(), "the sequence it was made of stays as it is"

    def test_twice_is_once(self) -> None:
        hidden = small_sequence().without_training_depth()
        np.testing.assert_array_equal(hidden.without_training_depth().true_depth_mm, hidden.true_depth_mm)

    def test_without_depth_there_is_nothing_to_hide(self) -> None:
        bare = replace(small_sequence(), depth_mm=None)
        assert bare.without_training_depth() is bare
        assert bare.points is not None

    def test_estimated_depth_is_no_truth(self) -> None:
        """A stage that fills in depth where none was known leaves zeros as the truth."""
        whole = small_sequence()
        assert whole.depth_mm is not None
        filled = replace(whole, withheld_depth_mm=np.zeros_like(whole.depth_mm))
        assert filled.training_depth_known
        assert filled.true_depth_mm is None

    def test_held_out_frames_do_not_change_the_training_part(self) -> None:
        """Held-out depth may be there or not: the training part is the same, byte by byte."""
        hidden = small_sequence().without_training_depth()
        bare = replace(hidden, depth_mm=None, withheld_depth_mm=None)
        assert not bare.training_depth_known
        assert bare.training_part().depth_mm is hidden.training_part().depth_mm is None


class TestScale:
    def test_all_lengths_are_multiplied(self, tmp_path: Path) -> None:
        generator = np.random.default_rng(3)
        poses = np.tile(np.eye(4), (4, 1, 1))
        poses[:, :3, 3] = generator.random((4, 3))
        arbitrary = replace(small_sequence(), world_from_camera=poses, metric=False)
        assert arbitrary.scale_words == "arbitrary scale"
        found = arbitrary.in_millimetres(25.0, "setting")
        assert found.metric
        assert found.scale_words == "millimetres from the scale given"
        assert found.world_from_camera is not None
        np.testing.assert_allclose(found.world_from_camera[:, :3, 3], 25 * poses[:, :3, 3])
        np.testing.assert_array_equal(found.world_from_camera[:, :3, :3], poses[:, :3, :3])
        assert arbitrary.points is not None
        np.testing.assert_allclose(found.points, 25 * arbitrary.points)
        assert arbitrary.depth_mm is not None
        assert found.depth_mm is not None
        assert found.depth_mm.dtype == np.float32
        np.testing.assert_allclose(found.depth_mm, 25 * arbitrary.depth_mm, rtol=1e-6)
        found.save(tmp_path / "sequence")
        assert EndoscopicSequence.load(tmp_path / "sequence").scale_source == "setting"
        assert found.training_part().scale_source == "setting"

    def test_a_lens_in_pixels_is_not(self) -> None:
        sequence = replace(small_sequence(), intrinsics="estimated", focal_std_px=1.5, metric=False)
        scaled = sequence.in_millimetres(2.5, "setting")
        assert (scaled.intrinsics, scaled.focal_std_px) == ("estimated", 1.5)
        assert scaled.training_part().focal_std_px == 1.5

    def test_poses_are_needed(self) -> None:
        with pytest.raises(ShapeError, match="no poses"):
            replace(small_sequence(), world_from_camera=None).in_millimetres(2.0, "setting")
