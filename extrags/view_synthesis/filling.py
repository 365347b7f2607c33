"""Push-pull: values where nothing is known, from what is known around, at the scale of the gap."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.errors import ShapeError

__all__ = ["completed_depth", "push_pull"]


def push_pull(values: Float[Tensor, "n c h w"], weight: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n c h w"]:
    """Complete images whose pixels are known to different degrees.

    Weighted means in a pyramid of halved images (pull), then each level's gaps from the next coarser one
    (push). Where `weight` is 1 the value stays exactly; where it is 0 the value is not looked at.

    Args:
        values: images; entries of weight zero may be anything finite.
        weight: in [0, 1].

    Returns:
        Images without gaps; zero only where an image has no known pixel at all.

    Raises:
        ShapeError: when the sizes differ.

    Source: Gortler et al., The Lumigraph, SIGGRAPH 1996, section 3.4.
    """
    if values.shape[-2:] != weight.shape[-2:] or weight.shape[1] != 1:
        raise ShapeError(f"values {tuple(values.shape)} and weight {tuple(weight.shape)} do not fit")
    weight = weight.clamp(0, 1)
    height, width = values.shape[-2:]
    if max(height, width) == 1:
        return values * (weight > 0)
    padding = (0, width % 2, 0, height % 2)
    mass = functional.avg_pool2d(functional.pad(weight, padding), 2)
    total = functional.avg_pool2d(functional.pad(values * weight, padding), 2)
    # However faint a weight is, what it weighs keeps its value.
    coarse = total / mass.clamp_min(torch.finfo(mass.dtype).tiny)
    # Four times the mean: one fully known pixel of four already fixes the coarser one.
    filled = push_pull(coarse, (4 * mass).clamp(0, 1))
    enlarged = functional.interpolate(filled, scale_factor=2, mode="bilinear", align_corners=False)
    return weight * values + (1 - weight) * enlarged[..., :height, :width]


def completed_depth(
    depth_mm: Float[Tensor, "n 1 h w"], weight: Float[Tensor, "n 1 h w"], fallback_mm: float
) -> Float[Tensor, "n 1 h w"]:
    """Depth without gaps: push-pull on its logarithm.

    Args:
        depth_mm: z-depth, 0 where unknown.
        weight: how well each pixel is known, in [0, 1]; the rendering's alpha.
        fallback_mm: depth of an image of which nothing is known.
    """
    known = (depth_mm > 0).to(weight.dtype) * weight.clamp(0, 1)
    # Relative to the fallback, so that the zero of an empty image means the fallback.
    relative = torch.where(depth_mm > 0, depth_mm / fallback_mm, torch.ones(())).log()
    return push_pull(relative, known).exp() * fallback_mm
