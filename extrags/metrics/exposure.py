"""Exposure alignment: one gain per image before a metric is taken.

Differences in exposure between recordings are no reconstruction errors, while alignment can hide errors. So
metrics are reported both without and with alignment; aligned ones are in a separate group.

The rule: inside the mask, the gain g minimises `sum (g * render - target)^2` over pixels and channels,
so `g = sum(render * target) / sum(render^2)`, clamped to [1/8, 8]; the aligned render is
`clip(g * render, 0, 1)`. Empty (black) pixels of a render take no part in g. A change of exposure
scales linear light; behind a power-law camera response it is a gain of the encoded values too, which is
why the gain is fitted on the values as stored.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import ShapeError

__all__ = ["MAX_EXPOSURE_GAIN", "align_exposure", "exposure_gain"]

MAX_EXPOSURE_GAIN = 8.0
"""Upper limit of the gain, and the inverse of its lower limit: three stops."""


def exposure_gain(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    mask: Bool[Tensor, "*b h w"] | None = None,
    *,
    per_channel: bool = False,
) -> Float[Tensor, "*b c"]:
    """The least-squares gain of each image, as defined in the module docstring.

    Args:
        render: images in [0, 1].
        target: images in [0, 1].
        mask: pixels the fit uses; None uses all.
        per_channel: a gain for each of red, green, blue instead of one.

    Returns:
        Gains, [..., 1], or [..., 3] per channel. 1 where the render is black or the mask empty.

    Raises:
        ShapeError: when the arrays do not fit each other.
    """
    if render.shape != target.shape or render.shape[-1:] != (3,):
        raise ShapeError(
            f"expected two images [..., H, W, 3], found {tuple(render.shape)} and {tuple(target.shape)}"
        )
    if mask is not None and mask.shape != render.shape[:-1]:
        raise ShapeError(f"mask {tuple(mask.shape)} does not fit images {tuple(render.shape)}")
    used = torch.ones_like(render[..., 0], dtype=torch.bool) if mask is None else mask
    source = torch.where(used[..., None], render, 0.0).double()
    common = torch.where(used[..., None], target, 0.0).double() * source
    axes = (-3, -2) if per_channel else (-3, -2, -1)
    numerator, denominator = common.sum(axes), source.square().sum(axes)
    if not per_channel:
        numerator, denominator = numerator[..., None], denominator[..., None]
    gain = torch.where(denominator > 0, numerator / denominator.clamp_min(1e-12), 1.0)
    return gain.clamp(1 / MAX_EXPOSURE_GAIN, MAX_EXPOSURE_GAIN).to(render.dtype)


def align_exposure(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    mask: Bool[Tensor, "*b h w"] | None = None,
    *,
    per_channel: bool = False,
) -> Float[Tensor, "*b h w 3"]:
    """The render with its gain applied, clipped to [0, 1]; see `exposure_gain`."""
    gain = exposure_gain(render, target, mask, per_channel=per_channel)
    return (render * gain[..., None, None, :]).clamp(0, 1)
