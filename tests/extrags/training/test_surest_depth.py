from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from extrags.cameras import rays_of_pixels
from extrags.sequence import EndoscopicSequence, Split
from extrags.training.starting import starting_gaussians
from extrags.training.surest_depth import SURER_FACTOR, agreed_depth, surest_points


def estimated(sequence: EndoscopicSequence, error_mm: float = 0.2) -> EndoscopicSequence:
    """The sequence with its true depth as an estimate, whose expected error is the same everywhere."""
    depth = sequence.depth_mm
    assert depth is not None
    error = np.divide(error_mm, depth, out=np.zeros_like(depth), where=depth > 0)
    return replace(sequence, depth_mm=depth.copy(), depth_error=error)


def points_of(sequence: EndoscopicSequence, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Back-projected depth of a frame, and its expected error."""
    assert sequence.depth_mm is not None
    assert sequence.depth_error is not None
    camera = sequence.cameras[np.array([frame])]
    chosen = np.flatnonzero(sequence.depth_mm[frame] > 0)
    z = sequence.depth_mm[frame].reshape(-1)[chosen].astype(np.float64)
    points = camera.centers + z[:, None] * rays_of_pixels(camera, chosen)
    return points, sequence.depth_error[frame].reshape(-1)[chosen] * z


def agreed(sequence: EndoscopicSequence, frame: int, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a frame as those frames have it, and its own."""
    assert sequence.depth_mm is not None
    points, error = points_of(sequence, frame)
    camera = sequence.cameras[np.array([frame])]
    chosen = np.flatnonzero(sequence.depth_mm[frame] > 0)
    z = sequence.depth_mm[frame].reshape(-1)[chosen].astype(np.float64)
    centers = np.broadcast_to(camera.centers, points.shape)
    rays = rays_of_pixels(camera, chosen)
    depth = sequence.depth_mm[frames]
    return agreed_depth(centers, rays, z, error, sequence, np.array(frames), depth), z


def before_a_slanted_wall() -> EndoscopicSequence:
    """Five cameras that look at the plane z = 10 + x / 2 from different places, and its exact depth."""
    K = np.array([[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]])
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = [(0, 0, 0), (1, 0, 0), (-1, 0.5, 1), (0, -1, 2), (0.5, 1, -1)]
    x = np.broadcast_to((np.arange(64) + 0.5 - 32) / 40, (48, 64))
    start = poses[:, :3, 3]
    depth = (10 + start[:, 0] / 2 - start[:, 2])[:, None, None] / (1 - x / 2)
    return EndoscopicSequence(
        "test/wall",
        np.zeros((5, 48, 64, 3), np.uint8),
        np.tile(K, (5, 1, 1)),
        np.ones((5, 48, 64), bool),
        Split("test", np.arange(4), np.array([4])),
        world_from_camera=poses,
        depth_mm=depth.astype(np.float32),
        depth_error=np.full((5, 48, 64), 0.02, np.float32),
    )


def kept(sequence: EndoscopicSequence, frame: int, others: list[int]) -> np.ndarray:
    points, error = points_of(sequence, frame)
    return surest_points(points, error, sequence, np.array([frame, *others]))


class TestSurestPoints:
    def test_equally_sure_frames_keep_their_points(self, tube_sequence: EndoscopicSequence) -> None:
        sequence = estimated(tube_sequence)
        first, second = sequence.train[:2].tolist()
        assert kept(sequence, first, [second]).all()

    @pytest.mark.parametrize(("factor", "stays"), [(0.95, True), (1.05, False)])
    def test_a_much_surer_frame_drops_what_it_sees_itself(
        self, tube_sequence: EndoscopicSequence, factor: float, stays: bool
    ) -> None:
        sequence = estimated(tube_sequence)
        assert sequence.depth_error is not None
        first, second = sequence.train[:2].tolist()
        sequence.depth_error[first] *= factor * SURER_FACTOR
        found = kept(sequence, first, [second])
        points, _ = points_of(sequence, first)
        (pixels,), _ = sequence.cameras[np.array([second])].project(points)
        shared = sequence.cameras.contains(pixels)
        assert 100 < shared.sum() < len(points)
        assert found[~shared].all()
        assert found[shared].mean() == pytest.approx(float(stays), abs=0.1)

    @pytest.mark.parametrize(("factor", "stays"), [(0.5, True), (2.0, False)])
    def test_a_much_surer_frame_has_it_hidden_or_looks_through_it(
        self, tube_sequence: EndoscopicSequence, factor: float, stays: bool
    ) -> None:
        sequence = estimated(tube_sequence)
        assert sequence.depth_mm is not None
        assert sequence.depth_error is not None
        first, second = sequence.train[:2].tolist()
        sequence.depth_mm[second] *= factor
        sequence.depth_error[second] *= 0.1
        points, _ = points_of(sequence, first)
        (pixels,), _ = sequence.cameras[np.array([second])].project(points)
        shared = sequence.cameras.contains(pixels)
        assert kept(sequence, first, [second])[shared].mean() == pytest.approx(float(stays), abs=0.05)

    def test_a_frame_that_is_as_unsure_has_no_say(self, tube_sequence: EndoscopicSequence) -> None:
        sequence = estimated(tube_sequence)
        assert sequence.depth_mm is not None
        assert sequence.depth_error is not None
        first, second = sequence.train[:2].tolist()
        sequence.depth_mm[second] *= 2
        # The error of a depth twice as large, in millimetres, is twice as large as well.
        assert kept(sequence, first, [second]).all()

    def test_what_a_frame_does_not_show_is_not_its_to_judge(self, tube_sequence: EndoscopicSequence) -> None:
        sequence = estimated(tube_sequence)
        assert sequence.depth_error is not None
        first, second = sequence.train[:2].tolist()
        sequence.depth_error[second] *= 0.1
        assert kept(sequence, first, [second]).mean() < 0.5
        hidden = replace(sequence, mask=sequence.mask.copy())
        hidden.mask[second] = False
        assert kept(hidden, first, [second]).all()

    def test_frames_that_may_not_be_used_are_not(self, tube_sequence: EndoscopicSequence) -> None:
        sequence = estimated(tube_sequence)
        assert sequence.depth_error is not None
        first, second, third = sequence.train[:3].tolist()
        before = kept(sequence, first, [second])
        sequence.depth_error[third] *= 0.1
        np.testing.assert_array_equal(kept(sequence, first, [second]), before)


class TestAgreedDepth:
    def test_frames_before_a_slanted_wall_agree_on_it(self) -> None:
        """Each is off by its own constant share of depth; along a ray, the planes say where the wall is."""
        sequence, off = before_a_slanted_wall(), np.array([0.02, -0.01, 0.01, -0.02, 0.015])
        assert sequence.depth_mm is not None
        truth = sequence.depth_mm[0].reshape(-1).astype(np.float64)
        exact, z = agreed(sequence, 0, list(range(5)))
        np.testing.assert_allclose(exact, z, rtol=1e-5)
        sequence.depth_mm[:] *= (1 + off)[:, None, None].astype(np.float32)
        found, z = agreed(sequence, 0, list(range(5)))
        np.testing.assert_allclose(z / truth - 1, 0.02, atol=1e-6)
        # What all five see is off by their mean, 0.3 %, up to how differently near they stand.
        assert np.median(np.abs(found / truth - 1)) < 0.008

    def test_frames_weigh_by_their_expected_errors(self, tube_sequence: EndoscopicSequence) -> None:
        """Two frames of one pose: the mean by inverse squares of 0 and 0.3 mm, 1 to 9."""
        sequence = estimated(tube_sequence, 0.3)
        assert sequence.depth_mm is not None
        assert sequence.depth_error is not None
        assert sequence.world_from_camera is not None
        first, second = sequence.train[:2].tolist()
        poses = sequence.world_from_camera.copy()
        poses[second] = poses[first]
        sequence = replace(sequence, world_from_camera=poses)
        before, _ = agreed(sequence, first, [first])
        sequence.depth_mm[second] = sequence.depth_mm[first] + 0.3
        sequence.depth_error[second] = sequence.depth_error[first] / 3
        found, _ = agreed(sequence, first, [first, second])
        assert np.median(found - before) == pytest.approx(0.27, abs=0.02)

    def test_another_surface_has_no_say(self, tube_sequence: EndoscopicSequence) -> None:
        sequence = estimated(tube_sequence, 0.1)
        assert sequence.depth_mm is not None
        first, second = sequence.train[:2].tolist()
        before, _ = agreed(sequence, first, [first])
        sequence.depth_mm[second] *= 2
        found, _ = agreed(sequence, first, [first, second])
        assert np.mean(found == before) > 0.98

    def test_no_plane_across_a_jump_has_a_say(self) -> None:
        sequence = before_a_slanted_wall()
        assert sequence.depth_mm is not None
        sequence.depth_mm[:, :, 32:] *= 0.93
        found, z = agreed(sequence, 0, [0])
        # Planes are taken where they are within the expected error, 2 %, of the estimate itself.
        assert np.abs(z / found - 1).max() <= 0.0201


class TestStarts:
    def test_unsure_frames_make_no_shell_around_what_others_know(
        self, tube_sequence: EndoscopicSequence
    ) -> None:
        """Thinned out in voxels, what is far off takes most of them."""
        sequence = estimated(tube_sequence, 0.05)
        assert sequence.depth_mm is not None
        assert sequence.depth_error is not None
        generator = np.random.default_rng(0)
        unsure = sequence.train[::2]
        sequence.depth_error[unsure] *= 20
        sequence.depth_mm[unsure] += generator.normal(size=sequence.depth_mm[unsure].shape).astype(np.float32)
        surface = cKDTree(np.concatenate([points_of(estimated(tube_sequence), k)[0] for k in sequence.train]))

        def away(given: EndoscopicSequence) -> float:
            found = starting_gaussians(given, given.train, 3000).means.numpy()
            return float(np.median(surface.query(found)[0]))

        assert away(sequence) < 0.5 * away(estimated(sequence))

    def test_they_lie_where_frames_agree(self) -> None:
        sequence, off = before_a_slanted_wall(), np.array([0.02, -0.01, 0.01, -0.02, 0.015])
        assert sequence.depth_mm is not None
        sequence.depth_mm[:] *= (1 + off)[:, None, None].astype(np.float32)

        def away(given: EndoscopicSequence) -> float:
            x, _, z = starting_gaussians(given, given.train, 3000).means.numpy().T
            return float(np.median(np.abs(z - 10 - x / 2)))

        assert away(sequence) < 0.6 * away(replace(sequence, depth_error=None))

    def test_measured_depth_starts_everywhere(self, tube_sequence: EndoscopicSequence) -> None:
        sequence = estimated(tube_sequence)
        assert sequence.depth_mm is not None
        sequence.depth_mm[sequence.train[0]] *= 0.5
        measured = replace(sequence, depth_error=None)
        radius = starting_gaussians(measured, measured.train, 3000).means[:, :2].norm(dim=1).numpy()
        assert (radius < 6).sum() > 20
