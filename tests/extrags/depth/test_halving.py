"""Halving images in bfloat16, in which processors' kernels are wrong where one column is left."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from extrags.depth.halving import HalvingConv2d
from extrags.depth.hidden import read_depth
from extrags.depth.weights import load_hidden

BFLOAT16_SHARE = 0.03
"""Of the largest value; what was wrong was off by more than it, or no number."""


@pytest.fixture(scope="module")
def plain() -> nn.Conv2d:
    """The convolution that it stands for, as torch has it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return nn.Conv2d(96, 160, 3, stride=2, padding=1).to(memory_format=torch.channels_last)


@pytest.mark.parametrize("height", [1, 2, 9, 16, 40])
@pytest.mark.parametrize("width", [1, 2, 3, 8])
def test_images_of_any_width_are_halved(plain: nn.Conv2d, height: int, width: int) -> None:
    halving = HalvingConv2d(96, 160).to(memory_format=torch.channels_last)
    halving.load_state_dict(plain.state_dict())
    generator = torch.Generator().manual_seed(height)
    images = torch.randn(2, 96, height, width, generator=generator).contiguous(
        memory_format=torch.channels_last
    )
    with torch.no_grad():
        expected = plain(images)
        torch.testing.assert_close(halving(images), expected)
        with torch.autocast("cpu", torch.bfloat16):
            found = halving(images)
    assert found.shape == expected.shape
    off = float((found.float() - expected).abs().max() / expected.abs().max())
    assert off < BFLOAT16_SHARE


@pytest.mark.parametrize(("height", "width"), [(640, 64), (320, 64), (160, 16)])
def test_depth_of_narrow_views_is_read_in_half_precision(height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(0)
    rgb = 0.3 + 0.2 * torch.rand(1, 3, height, width, generator=generator)
    depth_mm = 20 + torch.rand(1, height, width, generator=generator)
    opacity = torch.ones(1, height, width)
    opacity[:, height // 3 : 2 * height // 3] = 0
    K = torch.tensor([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])[None]
    network = load_hidden().to(memory_format=torch.channels_last)
    exact, half = (
        read_depth(network, rgb, depth_mm, opacity, K, half_precision=half_precision)
        for half_precision in (False, True)
    )
    assert float((half / exact).log().abs().max()) < 5e-3
