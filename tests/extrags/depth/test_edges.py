"""Edges of estimated depth."""

from __future__ import annotations

import torch

from extrags.depth.edges import sharpened
from extrags.depth.frames import PosedFrames

NEAR, FAR = 1.0, 2.0
"""Log-depth of a fold and of the wall behind it."""


def ramp() -> tuple[PosedFrames, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A bright fold in front of a dark wall, its depth drawn as a ramp over four columns, and the truth."""
    height, width, edge = 24, 32, 16
    columns = torch.arange(width).expand(1, height, width)
    truth = torch.where(columns < edge, NEAR, FAR)
    drawn = NEAR + ((columns - edge + 2.5) / 4).clamp(0, 1) * (FAR - NEAR)
    rgb = torch.where(columns < edge, 0.6, 0.15)[:, None].expand(1, 3, height, width)
    error = torch.where((columns - edge + 0.5).abs() < 2.5, 0.2, 0.02)
    frames = PosedFrames(
        rgb, torch.ones(1, height, width, dtype=torch.bool), torch.eye(3)[None], torch.eye(4)[None]
    )
    return frames, drawn, error, truth


def test_a_ramp_becomes_a_step_where_colour_steps() -> None:
    frames, drawn, error, truth = ramp()
    between = (drawn > NEAR + 0.05) & (drawn < FAR - 0.05)
    assert between.float().mean() > 0.05
    found = sharpened(drawn, error, frames)
    torch.testing.assert_close(found, truth, atol=1e-6, rtol=0)


def test_slopes_stay_as_they_are() -> None:
    frames, *_ = ramp()
    rows = torch.arange(24, dtype=torch.float32)[None, :, None].expand(1, 24, 32)
    slope = 0.005 * rows
    assert torch.equal(sharpened(slope, torch.full_like(slope, 0.02), frames), slope)


def test_what_is_outside_the_mask_has_no_vote() -> None:
    frames, drawn, error, _ = ramp()
    mask = frames.mask.clone()
    mask[:, :, 14:18] = False
    poisoned = torch.where(mask, drawn, 50.0)
    masked = PosedFrames(frames.rgb, mask, frames.K, frames.world_from_camera)
    found = sharpened(poisoned, error, masked)
    assert float(found[mask].max()) <= FAR
