r"""Depth of single frames from a pretrained network, aligned with what stereo is sure of.

Such a network gives the inverse depth of a frame up to a scale and a shift that change from frame to frame,

.. math:: 1 / d \approx s_f x + t_f ,

both of which are found from depths that several frames agree on, as is the way to compare such networks with
a truth (Ranftl et al., PAMI 2022). How far single pixels scatter around the fit, over a recording, says how
much the cue is worth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

__all__ = ["MonocularFit", "MonocularPredictor", "aligned", "fit_monocular", "predictions"]

MIN_PIXELS = 50
"""Fewer sure pixels of a frame say nothing about its scale and shift."""

ITERATIONS = 12
HUBER_SCALES = 1.345

LEAST_SCATTER = 0.02
"""Of log-depth: stereo, which it is measured against, is no better itself."""

BEYOND = 2.0
"""A frame's depths go so much beyond the farthest that stereo is sure of; its inverse depth could be zero."""

FARTHEST_QUANTILE = 0.02
"""Of the sure inverse depths: what counts as the farthest."""


@runtime_checkable
class MonocularPredictor(Protocol):
    """What gives the inverse depth of a single frame, up to scale and shift."""

    def inverse_depth(self, rgb: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
        """Inverse z-depth up to a positive scale and a shift, of a frame with colours in [0, 1]."""
        ...


@dataclass(frozen=True)
class MonocularFit:
    """How the inverse depth of one recording's frames follows the network's output.

    Args:
        scale: s_f of each frame, positive, [F].
        shift: t_f of each frame, [F].
        least: smallest inverse depth that is believed, [F].
        scatter: robust standard deviation of log-depth around the fit, [F]; infinite where there is none.
        own: frames with a fit of their own; others take their recording's median, with its scatter, [F].
        n_pixels: that were fitted.
    """

    scale: Float[Tensor, "f"]
    shift: Float[Tensor, "f"]
    least: Float[Tensor, "f"]
    scatter: Float[Tensor, "f"]
    own: Bool[Tensor, "f"]
    n_pixels: int

    def log_depth(self, predicted: Float[Tensor, "f h w"]) -> Float[Tensor, "f h w"]:
        """Log-depth of the frames from what the network gave for them."""
        inverse = self.scale[:, None, None] * predicted + self.shift[:, None, None]
        return -torch.log(torch.maximum(inverse, self.least[:, None, None]))


@torch.no_grad()
def predictions(
    predictor: MonocularPredictor, images: Iterable[Float[Tensor, "3 h w"]], size: tuple[int, int]
) -> Float[Tensor, "f height width"]:
    """What a network gives for each frame, at the size that frames are matched at.

    Args:
        predictor: the network.
        images: colours in [0, 1], of any size: such networks want larger frames than stereo.
        size: height and width of the result.
    """
    small = [
        functional.interpolate(
            predictor.inverse_depth(image)[None, None].float(),
            size=size,
            mode="bilinear",
            align_corners=False,
            antialias=True,
        )[0]
        for image in images
    ]
    return torch.cat(small)


def fit_monocular(
    predicted: Float[Tensor, "f h w"],
    log_depth: Float[Tensor, "f h w"],
    sure: Bool[Tensor, "f h w"],
    recording: Int[Tensor, "f"],
) -> list[MonocularFit]:
    """Scale and shift of each frame by iteratively reweighted least squares (Huber, on ratios of depths).

    Args:
        predicted: inverse depth up to scale and shift.
        log_depth: logarithm of z-depth.
        sure: pixels whose depth is trusted.
        recording: recording of each frame, numbered from zero.

    Returns:
        One fit per recording, in their order, each with its frames.
    """
    return [
        _fit(predicted[recording == g], log_depth[recording == g], sure[recording == g])
        for g in range(int(recording.max()) + 1)
    ]


def aligned(
    fits: list[MonocularFit], predicted: Float[Tensor, "f h w"], recording: Int[Tensor, "f"]
) -> tuple[Float[Tensor, "f h w"], Float[Tensor, "f"]]:
    """Log-depth of all frames by their recordings' fits, and the scatter of each frame's."""
    log_depth = torch.empty_like(predicted)
    scatter = torch.empty_like(predicted[:, 0, 0])
    for g, fit in enumerate(fits):
        log_depth[recording == g] = fit.log_depth(predicted[recording == g])
        scatter[recording == g] = fit.scatter
    return log_depth, scatter


def _fit(predicted: Tensor, log_depth: Tensor, sure: Tensor) -> MonocularFit:
    frames = len(predicted)
    scale, shift, least = torch.ones(3, frames, dtype=torch.float64, device=predicted.device)
    own = torch.zeros(frames, dtype=torch.bool, device=predicted.device)
    pixels: list[tuple[Tensor, Tensor]] = []
    for frame in range(frames):
        chosen = sure[frame]
        if int(chosen.sum()) < MIN_PIXELS:
            continue
        x, y = predicted[frame][chosen].double(), torch.exp(-log_depth[frame][chosen].double())
        found = _line(x, y)
        if found is None:
            continue
        scale[frame], shift[frame], least[frame] = *found, y.quantile(FARTHEST_QUANTILE) / BEYOND
        own[frame] = True
        pixels.append((x, y))
    if not pixels:
        none = torch.full((frames,), float("inf"), device=predicted.device)
        return MonocularFit(scale.float(), shift.float(), least.float(), none, own, 0)
    typical = [values[own].median() for values in (scale, shift, least)]
    fitted = zip(pixels, scale[own], shift[own], least[own], strict=True)
    scatter = _scatter([_log_ratio(x, y, s, t, low) for (x, y), s, t, low in fitted])
    # What the others' median is worth for a frame is what it is worth for those that could be fitted.
    borrowed = max(scatter, _scatter([_log_ratio(x, y, *typical) for x, y in pixels]))
    for values, value in zip((scale, shift, least), typical, strict=True):
        values[~own] = value
    scatters = torch.where(own, scatter, borrowed).to(predicted.dtype)
    total = sum(len(x) for x, _ in pixels)
    return MonocularFit(scale.float(), shift.float(), least.float(), scatters, own, total)


def _line(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor] | None:
    """Scale and shift that take `x` to `y`; None where no rising line does."""
    quartiles = torch.tensor([0.25, 0.5, 0.75], dtype=x.dtype, device=x.device)
    (x_low, x_middle, x_high), (y_low, y_middle, y_high) = x.quantile(quartiles), y.quantile(quartiles)
    if not x_high > x_low:
        return None
    # Quartiles are a beginning that wrong depths hardly move.
    scale = (y_high - y_low) / (x_high - x_low)
    shift = y_middle - scale * x_middle
    floor = 0.05 * y_middle
    for _ in range(ITERATIONS):
        line = torch.maximum(scale * x + shift, floor)
        away = torch.log(y / line).abs()
        deviation = (1.4826 * away.median()).clamp_min(1e-4)
        # Errors are proportional to depth, and so to inverse depth: that of the line, which is less noisy.
        weight = (HUBER_SCALES * deviation / away.clamp_min(1e-9)).clamp_max(1) / line.square()
        total = weight.sum()
        mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
        variance = (weight * (x - mean_x).square()).sum()
        if not variance > 0:
            return None
        scale = (weight * (x - mean_x) * (y - mean_y)).sum() / variance
        shift = mean_y - scale * mean_x
    return (scale, shift) if scale > 0 else None


def _log_ratio(x: Tensor, y: Tensor, scale: Tensor, shift: Tensor, least: Tensor) -> Tensor:
    return torch.log(y / torch.maximum(scale * x + shift, least)).abs()


def _scatter(away: list[Tensor]) -> float:
    return max(1.4826 * float(torch.cat(away).median()), LEAST_SCATTER)
