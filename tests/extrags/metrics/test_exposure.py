"""Exposure alignment finds the gain it is meant to find."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from extrags.metrics.exposure import MAX_EXPOSURE_GAIN, align_exposure, exposure_gain
from extrags.metrics.image import psnr


@settings(max_examples=25, deadline=None)
@given(gain=st.floats(0.2, 5.0), seed=st.integers(0, 1000))
def test_recovers_a_gain(gain: float, seed: int) -> None:
    target = torch.rand(2, 8, 9, 3, generator=torch.Generator().manual_seed(seed))
    found = exposure_gain(target / gain, target)
    assert found.shape == (2, 1)
    torch.testing.assert_close(found, torch.full((2, 1), gain), rtol=1e-5, atol=0)


def test_agrees_with_numpy_least_squares() -> None:
    generator = torch.Generator().manual_seed(3)
    render, target = torch.rand(2, 12, 10, 3, generator=generator, dtype=torch.float64)
    mask = torch.rand(12, 10, generator=generator) < 0.6
    solution, *_ = np.linalg.lstsq(render[mask].reshape(-1, 1).numpy(), target[mask].reshape(-1).numpy())
    assert exposure_gain(render, target, mask).item() == pytest.approx(float(solution[0]), rel=1e-9)


def test_one_gain_per_image_and_per_channel() -> None:
    target = torch.rand(2, 8, 9, 3, generator=torch.Generator().manual_seed(0))
    gains = torch.tensor([[0.5, 0.8, 1.0], [1.5, 1.1, 0.7]])
    found = exposure_gain(target / gains[:, None, None], target, per_channel=True)
    torch.testing.assert_close(found, gains, rtol=1e-5, atol=0)
    aligned = align_exposure(target / gains[:, None, None], target, per_channel=True)
    torch.testing.assert_close(aligned, target, rtol=0, atol=1e-6)


def test_holes_and_masked_pixels_take_no_part() -> None:
    target = torch.rand(8, 9, 3, generator=torch.Generator().manual_seed(0))
    render = 0.5 * target
    render[:3] = 0
    render[6:] = float("nan")
    mask = torch.ones(8, 9, dtype=torch.bool)
    mask[6:] = False
    assert exposure_gain(render, target, mask).item() == pytest.approx(2, rel=1e-5)
    # Nor does what is not known of the truth.
    assert exposure_gain(target, render, mask).item() == pytest.approx(
        float((0.5 * target[3:6].square()).sum() / target[:6].square().sum()), rel=1e-5
    )


def test_what_the_gain_makes_too_bright_ends_at_one() -> None:
    render = torch.tensor([0.1, 0.2, 0.3, 0.8])[None, :, None].expand(5, 4, 3)
    target = (2 * render).clamp(max=1)
    gain = exposure_gain(render, target).item()
    assert 1 < gain < 2
    expected = torch.tensor([0.1 * gain, 0.2 * gain, 0.3 * gain, 1.0])[None, :, None].expand(5, 4, 3)
    assert 0.8 * gain > 1
    torch.testing.assert_close(align_exposure(render, target), expected)


def test_never_worse_in_squared_error_before_clipping() -> None:
    generator = torch.Generator().manual_seed(2)
    target = 0.2 + 0.5 * torch.rand(16, 16, 3, generator=generator)
    render = (0.7 * target + 0.05 * torch.randn(16, 16, 3, generator=generator)).clamp(0, 1)
    plain, aligned = psnr(render, target), psnr(align_exposure(render, target), target)
    assert plain is not None
    assert aligned is not None
    assert aligned > plain + 3


def test_nothing_to_fit_leaves_the_image_and_the_gain_is_bounded() -> None:
    target = torch.full((4, 4, 3), 0.9)
    assert exposure_gain(torch.zeros(4, 4, 3), target).item() == 1
    assert exposure_gain(target, target, torch.zeros(4, 4, dtype=torch.bool)).item() == 1
    assert exposure_gain(target / 1000, target).item() == MAX_EXPOSURE_GAIN
    assert exposure_gain(target, torch.zeros(4, 4, 3)).item() == pytest.approx(1 / MAX_EXPOSURE_GAIN)
