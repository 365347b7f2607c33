"""The test of held-out frames against the depth of training frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from extrags.cameras import Cameras
from extrags.events import Event, Progress, subscribed
from extrags.observed_surface import never_observed, observed_from_depth
from extrags.sequence import EndoscopicSequence, Split


def test_it_tells_how_far_it_is() -> None:
    K = np.tile([[20.0, 0, 8], [0, 20.0, 6], [0, 0, 1]], (6, 1, 1))
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    told: list[Event] = []
    with subscribed(told.append):
        depth = np.full((6, 12, 16), 10, np.float32)
        mask = np.ones(depth.shape, dtype=bool)
        seen = observed_from_depth(Cameras(K, poses, 16, 12), mask, depth, np.arange(3), np.arange(3, 6))
    assert told == [Progress("ingest", done, 3) for done in (1, 2, 3)]
    assert seen[3].any()
    assert not seen[:3].any()


def test_what_a_training_frame_shows_outside_its_mask_is_not_observed() -> None:
    """Depth may be known there, as in the dark corners of a made-up endoscope; nothing is learned from it."""
    K = np.tile([[20.0, 0, 8], [0, 20.0, 6], [0, 0, 1]], (3, 1, 1))
    cameras = Cameras(K, np.tile(np.eye(4), (3, 1, 1)), 16, 12)
    depth, mask = np.full((3, 12, 16), 10, np.float32), np.ones((3, 12, 16), dtype=bool)
    mask[0, :, :10] = False
    mask[1, :, :6] = False
    seen = observed_from_depth(cameras, mask, depth, np.array([0, 1]), np.array([2]))
    assert not seen[2, :, :6].any()
    assert seen[2, :, 6:].all()
    # The held-out frame's own mask says nothing of what others saw.
    mask[2] = False
    np.testing.assert_array_equal(
        observed_from_depth(cameras, mask, depth, np.array([0, 1]), np.array([2])), seen
    )


def test_never_observed_is_told_of_held_out_pixels_with_depth_alone() -> None:
    shape = (3, 12, 16)
    depth, observed, mask = np.full(shape, 10, np.float32), np.zeros(shape, bool), np.ones(shape, bool)
    depth[:, :3] = 0
    observed[:, 3:6] = True
    mask[:, :, :4] = False
    sequence = EndoscopicSequence(
        name="made/up",
        rgb=np.zeros((*shape, 3), np.uint8),
        K=np.tile(np.eye(3), (3, 1, 1)),
        mask=mask,
        split=Split("here", np.array([0]), np.array([1, 2])),
        depth_mm=depth,
        observed=observed,
    )
    expected = np.zeros(shape, bool)
    expected[1:, 6:, 4:] = True
    np.testing.assert_array_equal(never_observed(sequence, np.arange(3)), expected)
    np.testing.assert_array_equal(never_observed(sequence, 2), expected[2])
    # Without any depth, what the source says is all there is.
    bare = replace(sequence, depth_mm=None)
    expected[1:, :3, 4:] = True
    np.testing.assert_array_equal(never_observed(bare, np.arange(3)), expected)
    assert not never_observed(replace(bare, observed=None), np.arange(3)).any()
