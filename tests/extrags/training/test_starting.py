from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, DensifyConfig
from extrags.errors import CaptureError
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import starting
from extrags.training.optimise import optimise
from extrags.training.random_start import depth_range
from extrags.training.reconstruction import coarse_schedule
from extrags.training.starting import (
    LEAST_COLOR,
    depth_from_points,
    median_depth,
    starting_gaussians,
    starts_at_random,
    thin_out,
)
from extrags.training.views import real_views


class TestStartingGaussians:
    def test_points_lie_on_the_tube(self, tube_sequence: EndoscopicSequence) -> None:
        gaussians = starting_gaussians(tube_sequence, tube_sequence.train, 500)
        assert 250 < len(gaussians) <= 500
        radius = gaussians.means[:, :2].norm(dim=1).numpy()
        # Averaging in voxels of about 3 mm pulls points off a curved wall by a fraction of that.
        assert np.median(np.abs(radius - 10)) < 1.5

    def test_same_input_same_bits(self, tube_sequence: EndoscopicSequence) -> None:
        first, second = (starting_gaussians(tube_sequence, tube_sequence.train, 300) for _ in range(2))
        for name, value in first.parameters().items():
            np.testing.assert_array_equal(value.numpy(), second.parameters()[name].numpy())

    def test_drawn_pixels_are_those_of_all_positions(self) -> None:
        generator = np.random.default_rng(0)
        valid = generator.random((5, 7, 9)) < 0.4
        valid[2] = False
        every = np.flatnonzero(valid)
        drawn = np.sort(np.random.default_rng(1).choice(every, 30, replace=False))
        ranks = np.sort(np.random.default_rng(1).choice(len(every), 30, replace=False))
        assert np.array_equal(starting._positions(valid, ranks), drawn)
        assert np.array_equal(starting._positions(valid, None), every)

    def test_uses_the_given_frames_only(self, tube_sequence: EndoscopicSequence) -> None:
        depth = tube_sequence.depth_mm
        assert depth is not None
        poisoned = depth.copy()
        poisoned[tube_sequence.test] = 1e4
        changed = replace(tube_sequence, depth_mm=poisoned)
        first = starting_gaussians(tube_sequence, tube_sequence.train, 300)
        second = starting_gaussians(changed, tube_sequence.train, 300)
        np.testing.assert_array_equal(first.means.numpy(), second.means.numpy())

    def test_the_edge_of_an_estimate_starts_nothing(self, tube_sequence: EndoscopicSequence) -> None:
        depth = tube_sequence.depth_mm
        assert depth is not None
        # In front of the tube's wall: what an estimate makes of a jump. Also a wide area of little certainty.
        wrong, error = depth.copy(), np.full_like(depth, 0.01)
        column = tube_sequence.width // 2
        wrong[:, :, column : column + 2] *= 0.5
        error[:, :, column : column + 2] = 0.3
        error[:, :, : column // 2] = 0.3
        estimated = replace(tube_sequence, depth_mm=wrong, depth_error=error)
        radius = starting_gaussians(estimated, estimated.train, 3000).means[:, :2].norm(dim=1).numpy()
        believed = replace(estimated, depth_error=None)
        before = starting_gaussians(believed, believed.train, 3000).means[:, :2].norm(dim=1).numpy()
        assert (before < 6).sum() > 20
        assert (radius < 6).sum() == 0
        # What is unsure far from anything sure is all there is.
        assert len(radius) > 0.8 * len(before)

    def test_unsure_depth_starts_where_nothing_beside_it_is_sure(
        self, tube_sequence: EndoscopicSequence
    ) -> None:
        depth, train = tube_sequence.depth_mm, tube_sequence.train
        assert depth is not None
        error = np.full_like(depth, 0.01)
        middle = tube_sequence.width // 2
        error[:, :, :middle] = 0.9
        found = starting._starting_depth(replace(tube_sequence, depth_error=error), train)
        near = starting.BESIDE_RELIABLE_PX
        assert (found[:, :, middle - near : middle] == 0).mean() > 0.9
        np.testing.assert_array_equal(found[:, :, : middle - near], depth[train][:, :, : middle - near])
        np.testing.assert_array_equal(found[:, :, middle:], depth[train][:, :, middle:])

    def test_cameras_alone_give_random_points(
        self, tube_sequence: EndoscopicSequence, caplog: pytest.LogCaptureFixture
    ) -> None:
        bare = replace(tube_sequence, depth_mm=None)
        within = depth_range(bare.training_cameras, bare.name)
        assert starts_at_random(bare, bare.train)
        assert median_depth(bare, bare.train) == within.typical
        with caplog.at_level("WARNING", logger="extrags.training.starting"):
            first, second = (starting_gaussians(bare, bare.train, 300, thickness=0.1) for _ in range(2))
        assert "starts from random points" in caplog.text
        assert "along their path" in caplog.text
        np.testing.assert_array_equal(first.means.numpy(), second.means.numpy())
        # Round and faint: nothing is known of the surface.
        assert float(first.opacities.sigmoid().max()) < 0.2
        np.testing.assert_allclose(first.scales[:, 0].numpy(), first.scales[:, 2].numpy(), rtol=1e-5)
        few = replace(bare, points=np.random.default_rng(0).normal(size=(5, 3)))
        assert starts_at_random(few, few.train)

    def test_depth_that_the_training_frames_lack_is_not_used(self, tube_sequence: EndoscopicSequence) -> None:
        hidden = tube_sequence.without_training_depth()
        bare = replace(hidden, depth_mm=None, withheld_depth_mm=None)
        assert median_depth(hidden, hidden.train) == median_depth(bare, bare.train)
        first, second = (starting_gaussians(part, part.train, 300) for part in (hidden, bare))
        np.testing.assert_array_equal(first.means.numpy(), second.means.numpy())

    def test_nothing_to_start_from(self, tube_sequence: EndoscopicSequence) -> None:
        assert tube_sequence.world_from_camera is not None
        still = np.repeat(tube_sequence.world_from_camera[:1], len(tube_sequence), axis=0)
        bare = replace(tube_sequence, depth_mm=None, world_from_camera=still)
        for refused in (median_depth, lambda *given: starting_gaussians(*given, 100)):
            with pytest.raises(CaptureError, match="neither depth nor sparse points are known, and all"):
                refused(bare, bare.train)

    @pytest.mark.parametrize("background", [1e7, 1e10, float(np.finfo(np.float32).max)])
    def test_a_background_starts_nothing(
        self, tube_sequence: EndoscopicSequence, background: float, caplog: pytest.LogCaptureFixture
    ) -> None:
        """One pixel of it used to stretch the voxels until a few points were left."""
        assert tube_sequence.depth_mm is not None
        depth = tube_sequence.depth_mm.copy()
        row, column = np.argwhere(depth[tube_sequence.train[0]] > 0)[0]
        depth[tube_sequence.train[0], row, column] = background
        spoilt = replace(tube_sequence, depth_mm=depth)
        # As many as there are pixels: each is drawn.
        many = int(np.count_nonzero(tube_sequence.mask[tube_sequence.train]) // 10)
        usual = starting_gaussians(tube_sequence, tube_sequence.train, many)
        found = starting_gaussians(spoilt, spoilt.train, many)
        assert len(found) == pytest.approx(len(usual), rel=0.02)
        assert float(found.means.abs().max()) < 1e3
        assert "start no Gaussian" in caplog.text

    def test_sparse_points_give_rough_depth(self, tube_sequence: EndoscopicSequence) -> None:
        generator = np.random.default_rng(0)
        angle, along = generator.uniform(0, 2 * np.pi, 400), generator.uniform(8, 45, 400)
        points = np.stack([10 * np.cos(angle), 10 * np.sin(angle), along], axis=1)
        sparse = replace(tube_sequence, depth_mm=None, points=points)
        depth = depth_from_points(sparse, sparse.train)
        assert not starts_at_random(sparse, sparse.train)
        # Of the surface in view, not of the points, of which most are far down the tube.
        assert median_depth(sparse, sparse.train) == pytest.approx(
            float(np.median(depth[sparse.train][sparse.mask[sparse.train]])), rel=0.05
        )
        truth = tube_sequence.depth_mm
        assert truth is not None
        both = (truth[sparse.train] > 0) & (truth[sparse.train] < 30)
        error = np.abs(depth[sparse.train] - truth[sparse.train])[both] / truth[sparse.train][both]
        assert np.median(error) < 0.15
        assert not depth[sparse.test].any()

    def test_points_elsewhere_are_refused(self, tube_sequence: EndoscopicSequence) -> None:
        behind = np.random.default_rng(0).normal(size=(100, 3)) - np.array([0.0, 0.0, 500.0])
        sparse = replace(tube_sequence, depth_mm=None, points=behind)
        with pytest.raises(CaptureError, match="same frame and scale"):
            depth_from_points(sparse, sparse.train)


class TestThinOut:
    def test_fewer_than_asked_are_untouched(self) -> None:
        points = np.random.default_rng(0).random((10, 3))
        thinned, _ = thin_out(points, points, 10)
        np.testing.assert_array_equal(thinned, points)

    def test_keeps_the_bound_and_the_mean(self) -> None:
        points = np.random.default_rng(0).random((5000, 3))
        thinned, values = thin_out(points, 2 * points, 400)
        assert 200 < len(thinned) <= 400
        np.testing.assert_allclose(values, 2 * thinned, atol=1e-12)


def test_a_black_channel_can_be_learned(tube_sequence: EndoscopicSequence) -> None:
    """A colour of zero has no gradient: what starts black in the frames would stay so."""
    black = tube_sequence.rgb.copy()
    black[..., 2] = 0
    start = starting_gaussians(replace(tube_sequence, rgb=black), tube_sequence.train, 300)
    blue = start.sh0[:, 0, 2] * 0.28209479177387814 + 0.5
    torch.testing.assert_close(blue, torch.full_like(blue, LEAST_COLOR), rtol=1e-4, atol=0)
    views = real_views(tube_sequence, tube_sequence.train)
    schedule = coarse_schedule(CoarseConfig(densify=DensifyConfig(enabled=False)), 20.0, 15.0, "coarse")
    schedule = replace(schedule, iterations=40)
    learned = optimise(Scene(start), lambda i: views[i % len(views)], schedule).scene.gaussians
    brighter = learned.sh0[:, 0, 2] > start.sh0[:, 0, 2] + 1e-3
    assert float(brighter.float().mean()) > 0.5
