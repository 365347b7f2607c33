"""Real frames as views to restore: what is known must come back as it was.

A rendering of a scene that is well known looks like a photograph. The restorer's pairs hardly have such
views: theirs are far off the path. Frames of the recording, blurred in parts and with holes cut into them,
are such views.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.view_synthesis.conditioning import Layers

__all__ = ["degraded_photograph", "photograph_layers"]

BLURRED = 0.7
"""Probability that a part is blurred, as a rendering is where few frames show the surface."""
BLUR_FACTORS = (2, 3, 4)
"""How many pixels a side become one."""
BLURRED_UNCERTAINTY = (0.2, 0.8)
SHARP_UNCERTAINTY = (0.0, 0.2)
MOST_SHIFT_PX = 2
"""Real views do not lie exactly where the rendering does."""
REFERENCE_GAIN_DEVIATION = 0.05
LEAST_REFERENCE_WEIGHT = 0.5


def photograph_layers(
    rgb: Float[Tensor, "v 3 h w"], tissue: Float[Tensor, "v 1 h w"], *, depth_mm: float
) -> Layers:
    """A view that is rendered as it was photographed, at one depth, and that real views confirm.

    Args:
        rgb: in [0, 1].
        tissue: 1 where the photograph shows tissue, 0 where nothing is known.
        depth_mm: of all of it.
    """
    nothing = torch.zeros_like(tissue)
    colors = rgb * tissue
    return Layers.of(
        rendered=colors,
        alpha=tissue,
        depth_mm=tissue * depth_mm,
        spread=nothing,
        uncertainty=1 - tissue,
        nearest=colors,
        nearest_weight=tissue,
        blend=colors,
        blend_weight=tissue,
        log_ratio=nothing,
        ray_length=torch.ones_like(tissue),
        invented=torch.zeros_like(colors),
        invented_weight=nothing,
    )


def degraded_photograph(
    rgb: Float[Tensor, "1 3 s s"],
    tissue: Float[Tensor, "1 1 s s"],
    part: Float[Tensor, "1 1 s s"],
    *,
    depth_mm: float,
    generator: np.random.Generator,
) -> Layers:
    """A photograph as a scene would render it that knows a part of it well.

    Args:
        rgb: in [0, 1].
        tissue: 1 where it shows tissue.
        part: 1 where it stays sharp, 0 where it may be blurred.
        depth_mm: of all of it.
        generator: of what is blurred, and of how real views differ from it.
    """
    layers = photograph_layers(rgb, tissue, depth_mm=depth_mm)
    uncertainty = torch.full_like(tissue, float(generator.uniform(*SHARP_UNCERTAINTY)))
    if generator.random() < BLURRED:
        factor = int(generator.choice(BLUR_FACTORS))
        blurred = _blurred(layers.get("rendered"), tissue, factor)
        layers.get("rendered").mul_(part).add_(blurred * (1 - part))
        unsure = float(generator.uniform(*BLURRED_UNCERTAINTY))
        uncertainty = uncertainty * part + unsure * (1 - part)
    layers.get("uncertainty").copy_(1 - (1 - uncertainty) * tissue)
    for name in ("nearest", "blend"):
        rows, columns = generator.integers(-MOST_SHIFT_PX, MOST_SHIFT_PX + 1, 2).tolist()
        gain = float(np.exp(generator.normal(0, REFERENCE_GAIN_DEVIATION)))
        weight = float(generator.uniform(LEAST_REFERENCE_WEIGHT, 1))
        shifted = torch.roll(layers.get(name), (rows, columns), (-2, -1)) * gain
        seen = torch.roll(tissue, (rows, columns), (-2, -1)) * tissue
        layers.get(name).copy_(shifted.clamp(0, 1) * seen)
        layers.get(f"{name}_weight").copy_(seen * weight)
    return layers


def _blurred(
    rgb: Float[Tensor, "1 3 s s"], tissue: Float[Tensor, "1 1 s s"], factor: int
) -> Float[Tensor, "1 3 s s"]:
    """Fewer pixels, and as many again; where nothing was, there is nothing."""
    size = tuple(rgb.shape[-2:])
    few = (max(1, size[0] // factor), max(1, size[1] // factor))
    share = functional.interpolate(tissue, few, mode="area")
    colors = functional.interpolate(rgb, few, mode="area") / share.clamp_min(1e-3)
    return functional.interpolate(colors.clamp(0, 1), size, mode="bilinear") * tissue
