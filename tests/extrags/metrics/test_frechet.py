from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.errors import ShapeError
from extrags.metrics.frechet import cell_features, frechet_distance
from extrags.metrics.lpips import Lpips


def normal(rng: np.random.Generator, mean: list[float], deviation: list[float], count: int) -> np.ndarray:
    return rng.normal(mean, deviation, (count, len(mean)))


class TestFrechetDistance:
    def test_independent_channels_have_a_closed_form(self) -> None:
        rng = np.random.default_rng(0)
        first = normal(rng, [0, 1, 2], [1, 2, 3], 200_000)
        second = normal(rng, [1, 1, 0], [2, 2, 1], 200_000)
        # Squared differences of means, 1 and 4, and of deviations, 1 and 4.
        assert frechet_distance(first, second) == pytest.approx(10, rel=0.02)

    def test_it_is_symmetric_and_zero_for_the_same(self) -> None:
        rng = np.random.default_rng(1)
        first, second = rng.normal(size=(100, 5)), rng.normal(size=(80, 5)) @ rng.normal(size=(5, 5))
        assert frechet_distance(first, first) == pytest.approx(0, abs=1e-9)
        assert frechet_distance(first, second) == pytest.approx(frechet_distance(second, first), rel=1e-9)

    def test_scipys_square_root_agrees(self) -> None:
        from scipy.linalg import sqrtm

        rng = np.random.default_rng(2)
        first = rng.normal(size=(300, 6)) @ rng.normal(size=(6, 6))
        second = 0.3 + rng.normal(size=(300, 6)) @ rng.normal(size=(6, 6))
        one, other = np.cov(first, rowvar=False), np.cov(second, rowvar=False)
        shift = first.mean(axis=0) - second.mean(axis=0)
        expected = shift @ shift + np.trace(one + other - 2 * np.real(sqrtm(one @ other)))
        assert frechet_distance(first, second) == pytest.approx(expected, rel=1e-5)

    def test_too_few_vectors_say_nothing(self) -> None:
        assert frechet_distance(np.zeros((31, 2)), np.zeros((100, 2))) is None

    def test_other_features_are_refused(self) -> None:
        with pytest.raises(ShapeError, match="3 and of 2 channels"):
            frechet_distance(np.zeros((40, 3)), np.zeros((40, 2)))


class TestCellFeatures:
    def test_texture_is_told_from_its_blur_and_not_from_its_shift(self, shared_data: Path) -> None:
        lpips = Lpips.load(shared_data / "lpips_weights", "alex")
        images = torch.rand(6, 64, 64, 3, generator=torch.Generator().manual_seed(0))
        everywhere = torch.ones(6, 64, 64, dtype=torch.bool)
        real = cell_features(lpips, images, everywhere)
        shifted = cell_features(lpips, images.roll(5, 1), everywhere)
        smooth = torch.nn.functional.avg_pool2d(images.permute(0, 3, 1, 2), 5, 1, 2).permute(0, 2, 3, 1)
        blurred = cell_features(lpips, smooth, everywhere)
        near, far = frechet_distance(real, shifted), frechet_distance(real, blurred)
        assert near is not None
        assert far is not None
        assert near < 0.3 * far

    def test_cells_outside_the_region_are_left_out(self, shared_data: Path) -> None:
        lpips = Lpips.load(shared_data / "lpips_weights", "alex")
        images = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(0))
        half = torch.zeros(1, 64, 64, dtype=torch.bool)
        half[:, :32] = True
        every = cell_features(lpips, images, torch.ones_like(half))
        assert 0 < len(cell_features(lpips, images, half)) < len(every)
