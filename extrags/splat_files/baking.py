"""Colours that a viewer without a lamp on the camera can show: albedo and light in one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ConfigError
from extrags.gaussians import SH_C0, Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster.light import apply_response, shortest_axes
from extrags.scene import Scene
from extrags.shown_pixels import chosen_masks, shown_pixels

__all__ = ["bake_light", "bake_recorded_light"]

_VIEWS_PER_BATCH = 8


def bake_light(scene: Scene, *, distance: float | None = None, exposure: float = 1.0) -> Gaussians:
    r"""The Gaussians with the colours they have under frontal light at one distance.

    Each Gaussian is coloured as if it lay on the optical axis, at `distance`, facing the lamp, whatever the
    viewer's camera does afterwards. The gain g of the light is then the same for all, and the colour of
    degree 0, a, becomes :math:`I(g a)` with the camera's response I. Higher degrees are multiplied by
    :math:`g I'(g a)`, the slope of the response there: exact while the response is linear, of first order
    where it is not. What a viewer cannot show any more is the fall-off with distance and angle;
    there are no highlights.

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
    at = light.reference_distance if distance is None else distance
    gain = light.detached().falloff(gaussians.means.new_tensor(float(at))).expand(len(gaussians))
    return _lit(gaussians, light, exposure * gain)


def bake_recorded_light(
    scene: Scene,
    cameras: Cameras,
    *,
    exposure: float = 1.0,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> Gaussians:
    """The Gaussians with the light that fell on them, on average, when these cameras saw them.

    The gain of each Gaussian, and what highlights add, are means over the views, weighted by the largest
    blending weight it has in each. Seen from where the recording was made it looks like the recording; where
    a viewer's camera comes nearer than that, or turns, the brightness does not follow. Gaussians that no view
    shows take the gain that the nearest camera would give them if it looked straight at them.

    Args:
        scene: with or without light.
        cameras: the training views.
        exposure: gain of the camera; 1 is the mean of the training frames.
        masks: pixels of each view that show tissue (`EndoscopicSequence.training_masks`); None: all.

    Raises:
        ConfigError: for an exposure that is not positive and finite.
        ShapeError: when there are not as many masks as cameras, or their sizes differ.
    """
    if scene.light is None:
        return bake_light(scene, exposure=exposure)
    if not (math.isfinite(exposure) and exposure > 0):
        raise ConfigError(f"the exposure of baked light is {exposure:g}; expected a positive number")
    gaussians, light = scene.gaussians.detached(), scene.light.detached()
    normals = shortest_axes(gaussians.quats, gaussians.scales)
    viewmats = torch.from_numpy(cameras.viewmats).float().to(gaussians.device)
    none = gaussians.means.new_zeros(len(gaussians))
    weight, lit, shine, facing, nearest = none, none, none, none, torch.full_like(none, math.inf)
    for begun in range(0, len(cameras), _VIEWS_PER_BATCH):
        index = range(begun, min(begun + _VIEWS_PER_BATCH, len(cameras)))
        batch = cameras[index.start : index.stop]
        shown = None if masks is None else shown_pixels(chosen_masks(masks, cameras, index), batch, batch)
        tissue = None if shown is None else torch.from_numpy(shown)
        with torch.no_grad():
            seen = scene.render(batch, visibility=True, visibility_mask=tissue, sh_degree=0).visibility_max
        for place, view in enumerate(index):
            rotation, shift = viewmats[view, :3, :3], viewmats[view, :3, 3]
            points = gaussians.means @ rotation.T + shift
            share = none if seen is None else seen[place]
            turned = normals @ rotation.T
            lit = lit + share * light.gain(points, turned)
            shine = shine + share * light.specular_gain(points, turned)
            weight = weight + share
            distance = points.norm(dim=1)
            facing = torch.where(distance < nearest, light.falloff(distance), facing)
            nearest = torch.minimum(nearest, distance)
    gain = torch.where(weight > 0, lit / weight.clamp_min(1e-12), facing)
    return _lit(gaussians, light, exposure * gain, exposure * shine / weight.clamp_min(1e-12))


def _lit(
    gaussians: Gaussians,
    light: NearFieldLight,
    gain: Float[Tensor, "n"],
    shine: Float[Tensor, "n"] | None = None,
) -> Gaussians:
    light, gain = light.detached(), gain[:, None, None]
    shoulder = light.log_shoulder.exp()
    # The rasteriser clips negative albedo as well.
    signal = gain * (0.5 + SH_C0 * gaussians.sh0).clamp_min(0)
    if shine is not None:
        signal = signal + shine[:, None, None]
    slope = gain * (1 + shoulder) / (1 + shoulder * signal) ** 2
    color = light.apply_response(signal)
    clear = apply_response(signal, shoulder)
    # Of the root of the sum of squares; a clean lens adds nothing, not even where it is black.
    veiled = torch.where(color > clear, clear / color.clamp_min(1e-12), 1)
    return _with_colors(gaussians, color, veiled * slope * gaussians.shN)


def _with_colors(
    gaussians: Gaussians, color: Float[Tensor, "n 1 3"], shN: Float[Tensor, "n k 3"]
) -> Gaussians:
    values = gaussians.parameters()
    return Gaussians(**{**values, "sh0": (color - 0.5) / SH_C0, "shN": shN})
