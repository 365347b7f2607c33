"""Colours that a viewer without a lamp on the camera can show: albedo and light in one."""

from __future__ import annotations

import math

import torch

from extrags.errors import ConfigError
from extrags.gaussians import SH_C0, Gaussians
from extrags.scene import Scene

__all__ = ["bake_light"]


def bake_light(scene: Scene, *, distance: float | None = None, exposure: float = 1.0) -> Gaussians:
    r"""The Gaussians with the colours they have under frontal light at one distance.

    Each Gaussian is coloured as if it lay on the optical axis, at `distance`, facing the lamp, whatever the
    viewer's camera does afterwards. The gain g of the light is then the same for all, and the colour of
    degree 0, a, becomes :math:`I(g a)` with the camera's response I. Higher degrees are multiplied by
    :math:`g I'(g a)`, the slope of the response there: exact while the response is linear, of first order
    where it is not. What a viewer cannot show any more is the fall-off with distance and angle.

    Args:
        scene: with or without light; without one nothing but `exposure` is applied.
        distance: from lamp to surface in world units; None is the light's reference distance, at which its
            gain is one.
        exposure: gain of the camera; 1 is the mean of the training frames.

    Raises:
        ConfigError: for a distance or exposure that is not positive and finite.
    """
    for name, value in (("exposure", exposure), ("distance", distance)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ConfigError(f"the {name} of baked light is {value:g}; expected a positive number")
    gaussians, light = scene.gaussians.detached(), scene.light
    if light is None:
        signal = exposure * (0.5 + SH_C0 * gaussians.sh0)
        return _with_colors(gaussians, signal, exposure * gaussians.shN)
    light = light.detached()
    at = light.reference_distance if distance is None else distance
    gain = exposure * float(light.falloff(torch.tensor(float(at))))
    shoulder = float(light.log_shoulder.exp())
    # The rasteriser clips negative albedo as well.
    signal = gain * (0.5 + SH_C0 * gaussians.sh0).clamp_min(0)
    slope = gain * (1 + shoulder) / (1 + shoulder * signal) ** 2
    return _with_colors(gaussians, light.apply_response(signal), slope * gaussians.shN)


def _with_colors(gaussians: Gaussians, color: torch.Tensor, shN: torch.Tensor) -> Gaussians:
    values = gaussians.parameters()
    return Gaussians(**{**values, "sh0": (color - 0.5) / SH_C0, "shN": shN})
