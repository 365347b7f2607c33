"""The test of held-out frames against the depth of training frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.cameras import Cameras, look_at
from extrags.events import Event, Progress, subscribed
from extrags.observed_surface import never_observed, observed_by_depth, observed_from_depth
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


def test_depth_beyond_the_edge_of_a_mask_shows_nothing_behind_the_tissue_beside_it() -> None:
    K = np.tile([[20.0, 0, 8], [0, 20.0, 6], [0, 0, 1]], (2, 1, 1))
    poses = np.tile(np.eye(4), (2, 1, 1))
    # A quarter of a pixel at the depth of the held-out frame, which looks through the training frame's wall.
    poses[1, 0, 3] = 50 / 20 / 4
    depth = np.full((2, 12, 16), 10, np.float32)
    depth[0, :, 8:] = depth[0, :, 0] = 100
    depth[1] = 50
    mask = np.ones(depth.shape, dtype=bool)
    mask[0, :, 8:] = False
    frames = Cameras(K, poses, 16, 12), mask, depth, np.array([0]), np.array([1])
    assert not observed_from_depth(*frames)[1, :, 2:].any()
    mask[0] = True
    assert observed_from_depth(*frames)[1, :, 7:15].all()


def test_never_observed_is_told_of_held_out_pixels_with_depth_alone() -> None:
    shape = (3, 12, 16)
    # In metres: what is known is not told by how large it is.
    depth, observed, mask = np.full(shape, 0.01, np.float32), np.zeros(shape, bool), np.ones(shape, bool)
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


class TestAgainstEveryPixelAlone:
    """The same rule, written as loops over pixels and pairs of frames."""

    WIDTH, HEIGHT, TRAIN, TEST = 19, 13, (0, 2, 3, 5), (1, 4)

    def frames(self) -> tuple[Cameras, np.ndarray, np.ndarray]:
        """A bumpy wall from six sides, far from the world's origin; one of the views looks away from it."""
        generator = np.random.default_rng(4)
        wall = np.array([40.0, -30.0, 70.0])
        poses = []
        for index in range(6):
            center = wall + generator.normal(size=3) * [9, 9, 2] - [0, 0, 25]
            aim = wall + generator.normal(size=3) * 4
            poses.append(look_at(center, 2 * center - aim if index == 3 else aim, np.array([0.1, -1.0, 0.2])))
        K = np.tile(np.array([[17.0, 0, 8.2], [0, 15.0, 6.9], [0, 0, 1]]), (6, 1, 1))
        depth = generator.uniform(17, 33, (6, self.HEIGHT, self.WIDTH)).astype(np.float32)
        depth[generator.random(depth.shape) < 0.15] = 0
        # Where nothing is known, no tolerance makes it known.
        depth[list(self.TRAIN), 4:9, 5:11] = 0
        mask = generator.random(depth.shape) < 0.85
        return Cameras(K, np.stack(poses), self.WIDTH, self.HEIGHT), mask, depth

    def expected(
        self, cameras: Cameras, mask: np.ndarray, depth: np.ndarray, share: float, length: float
    ) -> np.ndarray:
        seen = np.zeros(depth.shape, bool)
        K, poses = cameras.K[0], cameras.world_from_camera
        for test in self.TEST:
            for row, column in np.argwhere(depth[test] > 0):
                ray = [(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0]
                point = poses[test] @ [*(np.array(ray) * float(depth[test, row, column])), 1.0]
                for train in self.TRAIN:
                    x, y, z, _ = np.linalg.inv(poses[train]) @ point
                    if z <= 0:
                        continue
                    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
                    if not (0 <= u < self.WIDTH and 0 <= v < self.HEIGHT and mask[train, int(v), int(u)]):
                        continue
                    # The four pixels whose centres are the corners of a square round the point.
                    rows = {min(max(int(np.floor(v - 0.5)) + d, 0), self.HEIGHT - 1) for d in (0, 1)}
                    columns = {min(max(int(np.floor(u - 0.5)) + d, 0), self.WIDTH - 1) for d in (0, 1)}
                    corners = [(train, r, c) for r in rows for c in columns]
                    farthest = max(float(depth[at]) * bool(mask[at]) for at in corners)
                    if farthest > 0 and z <= farthest * (1 + share) + length:
                        seen[test, row, column] = True
        return seen

    @pytest.mark.parametrize(
        ("share", "length"), [(0.03, 0.0), (0.0, 0.0), (0.25, 0.0), (0.0, 4.0), (0.0, 30.0)]
    )
    def test_the_same_pixels_are_observed(self, share: float, length: float) -> None:
        cameras, mask, depth = self.frames()
        found = observed_from_depth(
            cameras,
            mask,
            depth,
            np.array(self.TRAIN),
            np.array(self.TEST),
            tolerance_share=share,
            tolerance_mm=length,
        )
        expected = self.expected(cameras, mask, depth, share, length)
        known = depth[list(self.TEST)] > 0
        assert 0.1 < expected[list(self.TEST)][known].mean() < 0.9
        np.testing.assert_array_equal(found, expected)

    def test_the_unit_of_length_does_not_matter(self) -> None:
        """Metres, or whatever structure from motion found: a power of two changes no digit."""
        cameras, mask, depth = self.frames()
        poses = cameras.world_from_camera.copy()
        poses[:, :3, 3] /= 1024
        small = Cameras(cameras.K, poses, cameras.width, cameras.height)
        split = np.array(self.TRAIN), np.array(self.TEST)
        np.testing.assert_array_equal(
            observed_from_depth(small, mask, depth / np.float32(1024), *split),
            observed_from_depth(cameras, mask, depth, *split),
        )

    def test_tolerances_tell_pixels_apart(self) -> None:
        """What makes the comparison above one of tolerances, too."""
        cameras, mask, depth = self.frames()
        counts = [
            self.expected(cameras, mask, depth, *tolerance).sum()
            for tolerance in ((0.0, 0.0), (0.03, 0.0), (0.25, 0.0))
        ]
        assert counts[0] < counts[1] < counts[2]

    def test_the_split_says_which_frames_saw_and_which_are_asked(self) -> None:
        cameras, mask, depth = self.frames()
        split = Split("here", np.array(self.TRAIN), np.array(self.TEST))
        found = observed_by_depth(cameras, mask, depth, split, tolerance_mm=4.0)
        assert found is not None
        np.testing.assert_array_equal(found, self.expected(cameras, mask, depth, 0.03, 4.0))
        assert observed_by_depth(cameras, mask, None, split) is None
