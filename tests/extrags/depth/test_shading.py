"""Depth from brightness."""

from __future__ import annotations

from dataclasses import replace

import torch

from extrags.depth.shading import fit_shading, smoothed_brightness
from tests.extrags.depth.planes import inside_sphere


def test_the_inverse_square_of_a_tone_curve_is_found() -> None:
    frames, depth = inside_sphere()
    gain = torch.tensor([0.5, 0.6, 0.7, 0.8, 0.9])[:, None, None]
    # Display value = (gain / depth^2)^(1 / 2.2): log-depth falls 1.1 times as fast as its logarithm.
    shown = (gain / depth.square()).clamp(max=0.9) ** (1 / 2.2)
    frames = replace(frames, rgb=shown[:, None].repeat(1, 3, 1, 1))
    brightness = torch.log(frames.rgb.mean(1))
    sure = torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    noisy = depth.log() + 0.5 * (torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) < 0.1)
    (fit,) = fit_shading(brightness, noisy, sure)
    assert abs(fit.slope - 1.1) < 0.02
    assert (fit.log_depth(brightness) - depth.log()).abs().max() < 0.03


def test_fixed_light_gives_no_slope() -> None:
    frames, depth = inside_sphere()
    generator = torch.Generator().manual_seed(2)
    brightness = torch.randn(depth.shape, generator=generator)
    (fit,) = fit_shading(brightness, depth.log(), torch.ones_like(frames.mask))
    assert fit.slope < 0.02
    assert fit.scatter > 0.8 * fit.spread


def test_nothing_sure_is_no_fit() -> None:
    frames, depth = inside_sphere()
    (fit,) = fit_shading(smoothed_brightness(frames), depth.log(), torch.zeros_like(frames.mask))
    assert fit.slope == 0
    assert fit.scatter == float("inf")


def test_recordings_have_slopes_of_their_own() -> None:
    _, depth = inside_sphere()
    group = torch.tensor([0, 0, 1, 1, 1])
    exponent = torch.tensor([0.5, 0.5, 1.0, 1.0, 1.0])[:, None, None]
    fits = fit_shading(-depth.log() / exponent, depth.log(), torch.ones(depth.shape, dtype=torch.bool), group)
    assert abs(fits[0].slope - 0.5) < 1e-3
    assert abs(fits[1].slope - 1.0) < 1e-3
    assert len(fits[1].intercepts) == 3
