"""Depth of so few training frames that it is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import extrags
from extrags.scarce_depth import without_scarce_depth
from extrags.sequence import EndoscopicSequence, Split

FRAMES = 10
TRAIN, TEST = np.arange(8), np.array([8, 9])


def with_depth(frames: list[int]) -> EndoscopicSequence:
    depth = np.zeros((FRAMES, 12, 16), np.float32)
    depth[frames] = 20
    return EndoscopicSequence(
        name="made/up",
        rgb=np.zeros((FRAMES, 12, 16, 3), np.uint8),
        K=np.tile(np.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), (FRAMES, 1, 1)),
        mask=np.ones((FRAMES, 12, 16), bool),
        split=Split("here", TRAIN, TEST),
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        depth_mm=depth,
        points=np.ones((30, 3), np.float32),
    )


@pytest.mark.parametrize("frames", [[2], [0, 3, 7], [1, 8, 9]])
def test_depth_of_few_training_frames_is_left_to_the_evaluation(
    frames: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    given = with_depth(frames)
    found = without_scarce_depth(given)
    assert not found.training_depth_known
    np.testing.assert_array_equal(found.true_depth_mm, given.depth_mm)
    assert found.points is given.points
    count = len(set(frames) & set(TRAIN.tolist()))
    assert f"{count} of 8 training frames have depth, too few to start from" in caplog.text


@pytest.mark.parametrize("frames", [[0, 2, 4, 6], list(range(FRAMES)), [8, 9]])
def test_what_is_enough_or_none_stays(frames: list[int]) -> None:
    given = with_depth(frames)
    assert without_scarce_depth(given) is given
    bare = replace(given, depth_mm=None)
    assert without_scarce_depth(bare) is bare


def test_a_single_training_frame_keeps_its_depth() -> None:
    given = replace(with_depth([0]), split=Split("here", np.array([0]), TEST))
    assert without_scarce_depth(given) is given


def test_arrays_are_treated_alike() -> None:
    given = with_depth([1, 9])
    found = extrags.sequence_from_arrays(
        given.rgb,
        given.K,
        world_from_camera=given.world_from_camera,
        depth_mm=given.depth_mm,
        split=given.split,
    )
    assert not found.training_depth_known
    # Before poses are known, the depth of a frame tells their scale.
    unposed = extrags.sequence_from_arrays(given.rgb, given.K, depth_mm=given.depth_mm, split=given.split)
    assert unposed.training_depth_known
