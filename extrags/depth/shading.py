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
    value = torch.log(frames.rgb.mean(dim=1) + 0.02)
    weight = frames.mask.float()
    kernel = torch.exp(-0.5 * (torch.arange(-4, 5, device=value.device) / SMOOTHING_PX) ** 2)
    kernel = kernel / kernel.sum()

    def blurred(image: Tensor) -> Tensor:
        image = functional.pad(image[:, None], (4, 4, 4, 4))
        image = functional.conv2d(image, kernel[None, None, None])
        return functional.conv2d(image, kernel[None, None, :, None])[:, 0]

    return blurred(value * weight) / blurred(weight).clamp_min(1e-6)


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
    frames = len(brightness)
    weight = sure.flatten(1).double()
    x, y = brightness.flatten(1).double(), log_depth.flatten(1).double()
    counts = weight.sum(1)
    total = int(counts.sum())
    if total < 50:
        zero = torch.zeros(frames, device=x.device)
        return ShadingFit(0.0, zero, float("inf"), float("inf"), total)
    robust = weight
    slope, scale = 0.0, 1.0
    intercept = torch.zeros(frames, dtype=torch.float64, device=x.device)
    for _ in range(ITERATIONS):
        n = robust.sum(1).clamp_min(1e-9)
        mean_x, mean_y = (robust * x).sum(1) / n, (robust * y).sum(1) / n
        dx, dy = x - mean_x[:, None], y - mean_y[:, None]
        covariance, variance = float((robust * dx * dy).sum()), float((robust * dx * dx).sum())
        slope = min(max(-covariance / max(variance, 1e-9), 0.0), STEEPEST)
        intercept = mean_y + slope * mean_x
        residual = (y - intercept[:, None] + slope * x).abs()
        scale = max(1.4826 * float(residual[sure.flatten(1)].median()), 1e-4)
        robust = weight * (HUBER_SCALES * scale / residual.clamp_min(1e-9)).clamp_max(1)
    present = counts > 0
    intercept = torch.where(present, intercept, intercept[present].mean())
    deviation = (y - (weight * y).sum(1, keepdim=True) / counts.clamp_min(1)[:, None]).abs()
    spread = 1.4826 * float(deviation[sure.flatten(1)].median())
    return ShadingFit(slope, intercept.float(), scale, spread, total)
