from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from extrags.config import CoarseConfig, DensifyConfig, LightConfig, PipelineConfig
from extrags.continuation import compared_frames, other_settings
from extrags.errors import ConfigError
from extrags.in_memory_pipeline import run_pipeline
from extrags.sequence import EndoscopicSequence, Split
from tests.extrags.training.textured_plane import changed, textured_plane

PLANE = textured_plane()


def first(frames: int, sequence: EndoscopicSequence = PLANE) -> EndoscopicSequence:
    """The first frames alone."""
    return part(sequence, np.arange(frames))


def part(sequence: EndoscopicSequence, frames: np.ndarray) -> EndoscopicSequence:
    rest = np.setdiff1d(np.arange(len(sequence)), frames)
    return replace(sequence, split=Split("part", frames, rest)).training_part()


def moved(sequence: EndoscopicSequence, frame: int, by: float) -> EndoscopicSequence:
    poses = sequence.cameras.world_from_camera.copy()
    poses[frame, 0, 3] += by
    return sequence.with_poses(poses)


def with_depth(sequence: EndoscopicSequence, factor: float) -> EndoscopicSequence:
    assert sequence.depth_mm is not None
    return replace(sequence, depth_mm=sequence.depth_mm * np.float32(factor))


class TestComparedFrames:
    def test_the_places_of_its_frames(self) -> None:
        found = compared_frames(part(PLANE, np.array([1, 4, 6])), PLANE)
        assert found.refusal == ""
        assert found.frames.tolist() == [1, 4, 6]

    def test_names_and_settings_of_the_split_do_not_count(self) -> None:
        earlier = replace(first(6), name="another", frame_names=tuple("abcdef"))
        assert compared_frames(earlier, PLANE).frames.tolist() == list(range(6))

    def test_equal_pictures_are_told_apart_by_their_poses(self) -> None:
        paused = changed(PLANE, 5, PLANE.rgb[2])
        assert paused.depth_mm is not None
        found = compared_frames(part(paused, np.array([5])), paused)
        assert found.frames.tolist() == [5]

    def test_a_scene_is_never_its_own_start(self) -> None:
        assert "not fewer than the 8" in compared_frames(PLANE, PLANE).refusal

    def test_a_frame_that_is_held_out_now(self) -> None:
        """It has been trained on: figures of it would say nothing."""
        now = part(PLANE, np.array([0, 1, 2, 3, 5, 6, 7]))
        assert "004.png is not among the training frames" in compared_frames(first(6), now).refusal

    @pytest.mark.parametrize(
        ("change", "refusal"),
        [
            (lambda one: changed(one, 3, one.rgb[3] ^ 1), "003.png is not among"),
            (lambda one: moved(one, 2, 0.1), "002.png had another pose"),
            (lambda one: replace(one, K=one.K * np.array([1.01, 1, 1])[:, None]), "or other intrinsics"),
            (lambda one: one.at_most_width(48), "48 x 40 pixels"),
            (lambda one: replace(one, metric=False), "another unit of length"),
            (lambda one: with_depth(one, 1.01), "000.png had another depth"),
            (lambda one: replace(one, depth_mm=None), "had no depth"),
            (
                lambda one: replace(one, depth_error=np.full(one.mask.shape, 0.1, np.float32)),
                "had estimated depth, those of this run have measured",
            ),
        ],
    )
    def test_refusals(self, change: Callable[[EndoscopicSequence], EndoscopicSequence], refusal: str) -> None:
        found = compared_frames(change(first(6)), PLANE)
        assert refusal in found.refusal
        assert len(found.frames) == 0

    @pytest.mark.parametrize(("share", "refused"), [(0.005, False), (0.02, True)])
    def test_pixels_that_are_masked_now(self, share: float, refused: bool) -> None:
        """Nothing would remove what they have made; masks that are found from all frames shift a little."""
        mask = PLANE.mask.copy()
        mask[2].reshape(-1)[: round(share * mask[2].size)] = False
        found = compared_frames(first(6), replace(PLANE, mask=mask))
        assert ("002.png that it was trained on are masked now" in found.refusal) == refused
        assert not compared_frames(replace(first(6), mask=mask[:6]), PLANE).refusal

    def test_depth_that_was_trained_with_and_is_withheld_now(self) -> None:
        found = compared_frames(first(6), PLANE.without_training_depth())
        assert "had measured depth, those of this run have no depth" in found.refusal

    def test_estimated_depth_may_differ(self) -> None:
        """It comes from all training frames: with more of them it is another."""
        unsure = np.full(PLANE.mask.shape, 0.1, np.float32)
        now = replace(PLANE, depth_error=unsure)
        earlier = with_depth(replace(first(6), depth_error=unsure[:6]), 1.05)
        assert compared_frames(earlier, now).frames.tolist() == list(range(6))

    def test_rounding_of_poses_is_no_other_pose(self) -> None:
        assert compared_frames(moved(first(6), 2, 1e-9), PLANE).refusal == ""


class TestOtherSettings:
    WANTED = CoarseConfig(iterations=100)

    @pytest.mark.parametrize("iterations", [100, 300])
    def test_more_iterations_do_no_harm(self, iterations: int) -> None:
        assert other_settings(self.WANTED.model_copy(update={"iterations": iterations}), self.WANTED) == ""

    def test_fewer_iterations(self) -> None:
        fewer = self.WANTED.model_copy(update={"iterations": 99})
        assert other_settings(fewer, self.WANTED) == "it was made with 99 iterations, fewer than 100"

    @pytest.mark.parametrize(
        ("changes", "named"),
        [
            ({"seed": 1}, "coarse.seed"),
            ({"train_on": "all"}, "coarse.train_on"),
            ({"densify": DensifyConfig(max_gaussians=500)}, "coarse.densify"),
            ({"light": LightConfig(enabled=False), "sh_degree": 2}, "coarse.light, coarse.sh_degree"),
        ],
    )
    def test_others_are_named(self, changes: dict[str, object], named: str) -> None:
        assert other_settings(self.WANTED.model_copy(update=changes), self.WANTED).endswith(": " + named)


def test_a_run_in_memory_has_no_store_to_look_in() -> None:
    config = PipelineConfig().with_overrides({"continuation.scene": "nearest", "device": "cpu"})
    with pytest.raises(ConfigError, match="a run in memory has none"):
        run_pipeline(PLANE, config, until="coarse")
