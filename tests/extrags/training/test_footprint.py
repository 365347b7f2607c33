"""The lower bound on the size of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.config import CoarseConfig, DensifyConfig
from extrags.sequence import EndoscopicSequence
from extrags.training import reconstruct
from extrags.training.footprint import MAX_CAMERAS, SmallestFootprint
from tests.extrags.training.conftest import tube_cameras


def cameras_at(*z_mm: float) -> Cameras:
    """Cameras that look along z from the given heights, with a focal length of 100 and 200 px."""
    poses = np.tile(np.eye(4), (len(z_mm), 1, 1))
    poses[:, 2, 3] = z_mm
    K = np.tile(np.array([[100.0, 0, 32], [0, 200.0, 24], [0, 0, 1]]), (len(z_mm), 1, 1))
    return Cameras(K, poses, 64, 48)


@pytest.mark.parametrize("heights_mm", [(0.0, 30.0), (30.0, 0.0)])
def test_the_bound_is_a_share_of_a_pixel_of_the_nearest_view_that_sees_the_position(
    heights_mm: tuple[float, float],
) -> None:
    footprint = SmallestFootprint(cameras_at(*heights_mm), 0.5)
    means = np.array(
        [
            [0.0, 0.0, 40.0],  # 40 mm before one camera, 10 mm before the other
            [0.0, 0.0, 20.0],  # before one alone
            [0.0, 0.0, -5.0],  # behind both
            [50.0, 0.0, 40.0],  # beside both images
        ]
    )
    # The smaller focal length: the coarser sampling of both axes.
    np.testing.assert_allclose(footprint.smallest(means), [0.5 * 10 / 100, 0.5 * 20 / 100, 0, 0])


def test_the_two_larger_axes_are_raised_and_the_thinnest_is_free() -> None:
    footprint = SmallestFootprint(cameras_at(0.0), 1.0)
    scales = torch.tensor([[0.01, 0.02, 0.001], [3.0, 0.02, 0.5], [0.01, 0.02, 0.001]]).log()
    means = torch.tensor([[0.0, 0.0, 20.0], [0.0, 0.0, 20.0], [0.0, 0.0, -20.0]])
    parameters = {"means": means, "scales": scales}
    footprint.apply(parameters)
    expected = torch.tensor([[0.2, 0.2, 0.001], [3.0, 0.02, 0.5], [0.01, 0.02, 0.001]])
    torch.testing.assert_close(scales.exp(), expected)
    footprint.apply(parameters)
    torch.testing.assert_close(scales.exp(), expected)


def test_many_views_are_sampled_evenly_with_both_ends() -> None:
    every = cameras_at(*np.linspace(0, 90, 10 * MAX_CAMERAS))
    footprint = SmallestFootprint(every, 1.0)
    assert len(footprint._cameras) == MAX_CAMERAS
    np.testing.assert_allclose(footprint._cameras.centers[[0, -1], 2], [0, 90])


def test_no_gaussian_of_a_reconstruction_is_smaller(tube_sequence: EndoscopicSequence) -> None:
    config = CoarseConfig(iterations=120, max_points=400, densify=DensifyConfig(max_gaussians=500, every=20))
    cameras = tube_cameras()[tube_sequence.train]

    def undercut(pixels: float) -> float:
        """Share of Gaussians whose second axis is below a pixel and a half."""
        scene = reconstruct(tube_sequence, config.model_copy(update={"min_footprint_px": pixels})).scene
        bound = SmallestFootprint(cameras, 1.5).smallest(scene.gaussians.means.double().numpy())
        second = scene.gaussians.scales.exp().sort(dim=1).values[:, 1].numpy()
        return float((second < bound * (1 - 1e-5)).mean())

    assert undercut(1.5) == 0
    assert undercut(0.0) > 0.05
