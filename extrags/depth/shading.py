r"""Depth from brightness: the lamp rides on the camera, so what is darker is, in the mean, farther.

With a lamp beside the lens a pixel's brightness is :math:`I = g \rho \cos\alpha / d^2`, bent by the
camera's response. Reflectance and angle vary; on average over a scene

.. math:: \log d = a_f - b \, \log I

with a constant per frame (exposure) and one slope per recording, found from depths that stereo is sure
of. How far single pixels scatter around it says how much the cue is worth: on an object under fixed
lights the slope is about zero and the scatter that of the depths themselves.

Source: the inverse-square law as a depth cue, as in LightDepth (Rodriguez-Puigvert et al., ICCV 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.depth.frames import PosedFrames

__all__ = ["ShadingFit", "fit_shading", "smoothed_brightness"]

STEEPEST = 1.5
"""Largest slope that is believed: the inverse square without any tone curve gives one half."""

ITERATIONS = 12
HUBER_SCALES = 1.345
SMOOTHING_PX = 1.5
"""Standard deviation of the blur that takes vessels and noise out of the brightness."""


@dataclass(frozen=True)
class ShadingFit:
    """How depth follows brightness in one recording.

    Args:
        slope: b, of log-depth against log-brightness; zero where there is no such relation.
        intercepts: a_f of each frame, [F].
        scatter: robust standard deviation of log-depth around the fit.
        spread: robust standard deviation of the log-depths themselves, each frame centred.
        n_pixels: that were fitted.
    """

    slope: float
    intercepts: Float[Tensor, "f"]
    scatter: float
    spread: float
    n_pixels: int

    def log_depth(self, brightness: Float[Tensor, "f h w"]) -> Float[Tensor, "f h w"]:
        """Log-depth that the brightness predicts, from `smoothed_brightness`."""
        return self.intercepts[:, None, None] - self.slope * brightness


def smoothed_brightness(frames: PosedFrames) -> Float[Tensor, "f h w"]:
    """Logarithm of brightness, blurred inside the mask."""
    kernel = torch.exp(-0.5 * (torch.arange(-4, 5, device=frames.rgb.device) / SMOOTHING_PX) ** 2)
    kernel = kernel / kernel.sum()

    def blurred(image: Tensor) -> Tensor:
        image = functional.pad(image[:, None], (4, 4, 4, 4))
        image = functional.conv2d(image, kernel[None, None, None])
        return functional.conv2d(image, kernel[None, None, :, None])[:, 0]

    found = torch.empty_like(frames.rgb[:, 0])
    for frame in range(len(frames)):
        value = torch.log(frames.rgb[frame : frame + 1].mean(dim=1) + 0.02)
        weight = frames.mask[frame : frame + 1].float()
        found[frame] = (blurred(value * weight) / blurred(weight).clamp_min(1e-6))[0]
    return found


def fit_shading(
    brightness: Float[Tensor, "f h w"],
    log_depth: Float[Tensor, "f h w"],
    sure: Bool[Tensor, "f h w"],
    group: Int[Tensor, "f"] | None = None,
) -> list[ShadingFit]:
    """Robust fit of slope and intercepts by iteratively reweighted least squares (Huber).

    Args:
        brightness: from `smoothed_brightness`.
        log_depth: logarithm of z-depth.
        sure: pixels whose depth is trusted and whose brightness is not saturated.
        group: frames of one recording share a slope; None: all do. Numbered from zero.

    Returns:
        One fit per group, in their order, each with the intercepts of its frames. A frame without sure
        pixels takes the mean intercept of its group.
    """
    group = (
        torch.zeros(len(brightness), dtype=torch.long, device=brightness.device) if group is None else group
    )
    return [
        _fit(brightness[group == g], log_depth[group == g], sure[group == g])
        for g in range(int(group.max()) + 1)
    ]


def _fit(brightness: Tensor, log_depth: Tensor, sure: Tensor) -> ShadingFit:
    frames, device = len(brightness), brightness.device
    # Of each frame its sure pixels alone: a long recording has many others.
    x, y = (
        [image[own].double() for image, own in zip(stack, sure, strict=True)]
        for stack in (brightness, log_depth)
    )
    counts = torch.tensor([len(values) for values in x], device=device)
    total = int(counts.sum())
    if total < 50:
        zero = torch.zeros(frames, device=device)
        return ShadingFit(0.0, zero, float("inf"), float("inf"), total)
    robust = [torch.ones_like(values) for values in x]
    slope, scale = 0.0, 1.0
    intercept = torch.zeros(frames, dtype=torch.float64, device=device)
    for _ in range(ITERATIONS):
        means = [_weighted_means(*own) for own in zip(robust, x, y, strict=True)]
        moments = torch.stack(
            [
                torch.stack([(w * (u - mean[0]) * (v - mean[1])).sum(), (w * (u - mean[0]).square()).sum()])
                for w, u, v, mean in zip(robust, x, y, means, strict=True)
            ]
        ).sum(0)
        slope = min(max(-float(moments[0]) / max(float(moments[1]), 1e-9), 0.0), STEEPEST)
        mean_x, mean_y = torch.stack(means).unbind(1)
        intercept = mean_y + slope * mean_x
        residual = [(v - own + slope * u).abs() for own, u, v in zip(intercept, x, y, strict=True)]
        scale = max(1.4826 * float(torch.cat(residual).median()), 1e-4)
        robust = [(HUBER_SCALES * scale / away.clamp_min(1e-9)).clamp_max(1) for away in residual]
    present = counts > 0
    intercept = torch.where(present, intercept, intercept[present].mean())
    deviation = torch.cat([(values - values.mean()).abs() for values in y if len(values)])
    return ShadingFit(slope, intercept.float(), scale, 1.4826 * float(deviation.median()), total)


def _weighted_means(weight: Tensor, x: Tensor, y: Tensor) -> Float[Tensor, "2"]:
    total = weight.sum().clamp_min(1e-9)
    return torch.stack([(weight * x).sum(), (weight * y).sum()]) / total
