"""The matrix form of a separable filter is the convolution it stands for."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from extrags.metrics.filters import BorderRule, filter_separable, gaussian_weights


@pytest.mark.parametrize("border", ["reflect", "replicate"])
def test_equals_padding_and_convolution(border: BorderRule) -> None:
    generator = torch.Generator().manual_seed(3)
    maps = torch.rand(2, 14, 19, generator=generator, dtype=torch.float64)
    along_x = tuple(torch.randn(7, generator=generator, dtype=torch.float64).tolist())
    along_y = tuple(torch.randn(5, generator=generator, dtype=torch.float64).tolist())
    padded = F.pad(maps[:, None], (3, 3, 2, 2), mode=border)
    kernel = torch.outer(*(torch.tensor(weights, dtype=torch.float64) for weights in (along_y, along_x)))
    expected = F.conv2d(padded, kernel[None, None])[:, 0]
    torch.testing.assert_close(filter_separable(maps, along_x, along_y, border), expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_images_smaller_than_the_window_keep_their_mean_level(size: int) -> None:
    window = gaussian_weights(2.0, 6)
    flat = torch.full((size, size), 0.7, dtype=torch.float64)
    torch.testing.assert_close(filter_separable(flat, window, window), flat, atol=1e-12, rtol=0)
