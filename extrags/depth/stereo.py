"""Dense depth of posed frames from each other: two sweeps, a prior of other cues, agreement of views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.depth import matching, native
from extrags.depth.consistency import agreement
from extrags.depth.frames import PosedFrames
from extrags.depth.monocular import MonocularFit, aligned, fit_monocular
from extrags.depth.prior import DepthPrior
from extrags.depth.shading import ShadingFit, fit_shading, smoothed_brightness
from extrags.errors import ShapeError
from extrags.frame_stacks import empty_stack

__all__ = [
    "SECOND_SWEEP",
    "THIRD_SWEEP",
    "StereoDepth",
    "StereoSettings",
    "multi_view_stereo",
    "sweep_around",
]

NEARLY_SATURATED = 0.97
"""Brightness in [0, 1] from which a pixel says nothing about its distance. It is below the 250 of 255 (0.98)
of `extrags.thresholds.SATURATED`: frames are made smaller before they are matched, which mixes saturated
pixels with their neighbours."""

COST_LEVELS = 127.5
"""Levels per unit of the costs that are kept as bytes."""

SURE_AGREEMENT = 1.5
"""Sources that must agree with a depth for the fit of other cues, together with the frame's own."""

CHUNK_VALUES = 1 << 26
"""Costs of as many frames as have so many are made at a time on a GPU, which single frames leave idle; with
what is made on the way that is about 2 GB."""


class SweepAround(TypedDict):
    """How `sweep_around` searches around completed surfaces."""

    half_width: float
    hypotheses: int
    small_step: float
    jump: float


SECOND_SWEEP = SweepAround(half_width=0.2, hypotheses=17, small_step=0.1, jump=0.5)
"""After the first completion, whose result is completed once more; the practice of the network has it too."""

THIRD_SWEEP = SweepAround(half_width=0.1, hypotheses=13, small_step=0.2, jump=1.0)
"""After the second completion; its result is mixed with it."""


@dataclass(frozen=True)
class StereoSettings:
    """How stereo searches.

    Args:
        hypotheses: depths of the first sweep, evenly spaced in log-depth.
        radius_px: windows have sides of 2 radius + 1 pixels.
        best_share: share of the sources, those that match best, whose costs are averaged.
        small_step: semi-global penalty of a change by one hypothesis.
        jump: semi-global penalty of larger changes.
        shading: whether what brightness predicts is part of the prior.
        prior_weight: weight of the prior that other cues give; it is bounded, so that clear matches win.
        prior_scatters: scatters of the cues at which the prior reaches its weight.
        refinement_hypotheses: depths of the second sweep, around the surface that the first one found.
        refinement_extent: half the width of the second sweep, in steps of the first.
        refinement_small_step: as `small_step`, in the second sweep.
        refinement_jump: as `jump`, in the second sweep.
        tolerance: log-ratio up to which depths of two frames agree.
    """

    hypotheses: int = 96
    radius_px: int = 3
    best_share: float = 0.5
    small_step: float = 0.15
    jump: float = 1.5
    shading: bool = True
    prior_weight: float = 0.2
    prior_scatters: float = 4.0
    refinement_hypotheses: int = 13
    refinement_extent: float = 3.0
    refinement_small_step: float = 0.1
    refinement_jump: float = 0.5
    tolerance: float = 0.05


@dataclass(frozen=True)
class StereoDepth:
    """Result of stereo for all frames, with what tells how far to trust it.

    Args:
        log_depth: logarithm of z-depth, [F, H, W]; defined inside the mask.
        cost: matching cost of that depth, in [0, 2], [F, H, W].
        margin: how much better it is than the best other hypothesis, [F, H, W].
        seen: share of the sources that see the point, [F, H, W].
        agrees: share of those whose depth is the same, [F, H, W].
        violates: share of those that see through the point, [F, H, W].
        difference: mean log-ratio to the sources' depths, bounded, [F, H, W].
        fused: mean log-depth over the frame and the sources that agree, [F, H, W].
        prior: log-depth that brightness predicts, together with that of a monocular network, [F, H, W].
        prior_scatter: how far depths scatter around it, infinite where it is of no use, [F].
        fits: the fit of shading, one per recording.
        monocular: that of the monocular network, one per recording; empty without one.
        recording: recording of each frame, [F].
        n_sources: number of sources of each frame, [F].
    """

    log_depth: Float[Tensor, "f h w"]
    cost: Float[Tensor, "f h w"]
    margin: Float[Tensor, "f h w"]
    seen: Float[Tensor, "f h w"]
    agrees: Float[Tensor, "f h w"]
    violates: Float[Tensor, "f h w"]
    difference: Float[Tensor, "f h w"]
    fused: Float[Tensor, "f h w"]
    prior: Float[Tensor, "f h w"]
    prior_scatter: Float[Tensor, "f"]
    fits: list[ShadingFit]
    monocular: list[MonocularFit]
    recording: Int[Tensor, "f"]
    n_sources: Int[Tensor, "f"]

    def of_frames(self, chosen: Int[Tensor, "k"]) -> StereoDepth:
        """The same of some frames; the fits stay those of all."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _OF_FRAMES})


_OF_FRAMES = (
    "log_depth",
    "cost",
    "margin",
    "seen",
    "agrees",
    "violates",
    "difference",
    "fused",
    "prior",
    "prior_scatter",
    "recording",
    "n_sources",
)


def multi_view_stereo(
    frames: PosedFrames,
    sources: Int[Tensor, "f s"],
    near: Float[Tensor, "f"],
    far: Float[Tensor, "f"],
    settings: StereoSettings | None = None,
    *,
    recording: Int[Tensor, "f"] | None = None,
    monocular: Float[Tensor, "f h w"] | None = None,
    chunk: int | None = None,
    told: Callable[[int], None] | None = None,
) -> StereoDepth:
    """Depth of every frame from its sources.

    Args:
        frames: frames with poses.
        sources: what each is matched with, from `select_sources`.
        near: smallest depth searched, per frame.
        far: largest depth searched, per frame.
        settings: how to search; None takes the defaults.
        recording: recording of each frame, numbered from zero: exposure and response are one recording's.
        monocular: inverse depth of each frame up to scale and shift, from a network; None without one.
        chunk: frames at a time; None takes one on the processor, as many as fit on a GPU.
        told: called with the number of frames done, twice for each.

    Raises:
        ShapeError: for images of less than two pixels a side.
    """
    settings = StereoSettings() if settings is None else settings
    if min(frames.size) < 2:
        height, width = frames.size
        raise ShapeError(f"images of {width}x{height} pixels are too small for stereo; expected 2x2 or more")
    device, n = frames.rgb.device, len(frames)
    recording = torch.zeros(n, dtype=torch.long, device=device) if recording is None else recording
    grey, brightness = frames.grey, smoothed_brightness(frames)
    steps = torch.linspace(-1, 1, settings.hypotheses, device=device)
    log_base = 0.5 * (near.log() + far.log())
    offsets = 0.5 * (far.log() - near.log())[:, None] * steps[None]
    parts = _parts(frames, settings.hypotheses, chunk)
    kernels = native if device.type == "cpu" else matching
    # Costs of all frames are kept for the prior, which needs depth of all: as bytes, in a mapped file.
    shape = (n, settings.hypotheses, *frames.size)
    costs, first = torch.from_numpy(empty_stack(shape, np.uint8)), []
    for part in parts:
        base = log_base[part].exp()[:, None, None].expand(-1, *frames.size)
        cost = _cost(frames, part, sources, base, offsets[part], settings)
        # A byte is fine enough for what is only ranked again.
        costs[part.cpu()] = (cost * COST_LEVELS).round().clamp(0, 255).to(torch.uint8).cpu()
        position, _, _ = kernels.best_steps(
            cost, grey[part], small_step=settings.small_step, jump=settings.jump
        )
        first.append(_log_depth(position, log_base[part][:, None, None], offsets[part]))
        if told is not None:
            told(len(part))
    depth = torch.cat(first).exp()
    agreed = [agreement(frames, depth, part, sources[part], tolerance=settings.tolerance) for part in parts]
    count = (sources >= 0).sum(1)
    sure = torch.cat([a.agrees * a.seen for a in agreed]) * count[:, None, None] >= SURE_AGREEMENT
    sure &= frames.mask & (frames.rgb.amax(dim=1) < NEARLY_SATURATED)
    fits = fit_shading(brightness, depth.log(), sure, recording)
    prior, monocular_fits = shading_prior(fits, brightness, recording), []
    if not settings.shading:
        # Not only without weight: what completes stereo would look at it.
        prior = DepthPrior(prior.log_depth, torch.full_like(prior.scatter, torch.inf))
    if monocular is not None:
        monocular_fits = fit_monocular(monocular, depth.log(), sure, recording)
        other = DepthPrior(*aligned(monocular_fits, monocular, recording))
        prior = prior & other if settings.shading else other
    prior_weight = settings.prior_weight if settings.shading or monocular is not None else 0.0
    found, matched, margins = [], [], []
    for part in parts:
        cost = costs[part.cpu()].to(device).float() / COST_LEVELS
        cost += prior.cost(
            part, log_base[part], offsets[part], weight=prior_weight, scatters=settings.prior_scatters
        )
        position, _, margin = kernels.best_steps(
            cost, grey[part], small_step=settings.small_step, jump=settings.jump
        )
        margins.append(margin)
        unpredicted = ~torch.isfinite(prior.scatter[part]) if prior_weight > 0 else True
        blind = (count[part] == 0) & unpredicted
        position = _undecided(position, settings.hypotheses, blind)
        log_depth = _log_depth(position, log_base[part][:, None, None], offsets[part])
        surface = _median(log_depth, frames.mask[part])
        step = offsets[part][:, 1] - offsets[part][:, 0]
        finer = torch.linspace(-1, 1, settings.refinement_hypotheses, device=device)[None]
        finer = finer * (settings.refinement_extent * step)[:, None]
        cost = _cost(frames, part, sources, surface.exp(), finer, settings)
        position, _, _ = kernels.best_steps(
            cost, grey[part], small_step=settings.refinement_small_step, jump=settings.refinement_jump
        )
        position = _undecided(position, finer.shape[1], count[part] == 0)
        found.append(_log_depth(position, surface, finer))
        nearest = position.round().long().clamp(0, finer.shape[1] - 1)
        matched.append(cost.gather(1, nearest[:, None])[:, 0])
        if told is not None:
            told(len(part))
    log_depth = torch.cat(found)
    depth = torch.where(frames.mask, log_depth.exp(), 0.0)
    agreed = [agreement(frames, depth, part, sources[part], tolerance=settings.tolerance) for part in parts]

    def joined(name: str) -> Tensor:
        return torch.cat([getattr(a, name) for a in agreed])

    return StereoDepth(
        log_depth=log_depth,
        cost=torch.cat(matched),
        margin=torch.cat(margins),
        seen=joined("seen"),
        agrees=joined("agrees"),
        violates=joined("violates"),
        difference=joined("difference"),
        fused=joined("fused"),
        prior=prior.log_depth,
        prior_scatter=prior.scatter,
        fits=fits,
        monocular=monocular_fits,
        recording=recording,
        n_sources=count,
    )


def sweep_around(
    frames: PosedFrames,
    sources: Int[Tensor, "f s"],
    stereo: StereoDepth,
    log_depth: Float[Tensor, "f h w"],
    *,
    half_width: float,
    hypotheses: int,
    small_step: float,
    jump: float,
    settings: StereoSettings | None = None,
    chunk: int | None = None,
    told: Callable[[int], None] | None = None,
) -> StereoDepth:
    """Stereo again in a narrow range around surfaces that are nearly right.

    Where the first search went astray for want of texture or of a neighbour, windows that follow the
    completed surface match better than any plane did.

    Args:
        frames: frames with poses.
        sources: what each is matched with.
        stereo: result of `multi_view_stereo`, whose margin and prior are kept.
        log_depth: logarithm of the surfaces' z-depth.
        half_width: of the range, in log-depth.
        hypotheses: depths tried in it.
        small_step: semi-global penalty of a change by one hypothesis.
        jump: semi-global penalty of larger changes.
        settings: windows, sources and tolerance; None takes the defaults.
        chunk: as `multi_view_stereo`.
        told: called with the number of frames done.
    """
    settings = StereoSettings() if settings is None else settings
    kernels = native if log_depth.device.type == "cpu" else matching
    grey = frames.grey
    offsets = torch.linspace(-half_width, half_width, hypotheses, device=log_depth.device)[None]
    found, matched = [], []
    count = (sources >= 0).sum(1)
    parts = _parts(frames, hypotheses, chunk)
    for part in parts:
        around = offsets.expand(len(part), -1)
        cost = _cost(frames, part, sources, log_depth[part].exp(), around, settings)
        position, _, _ = kernels.best_steps(cost, grey[part], small_step=small_step, jump=jump)
        position = _undecided(position, hypotheses, count[part] == 0)
        found.append(_log_depth(position, log_depth[part], around))
        nearest = position.round().long().clamp(0, hypotheses - 1)
        matched.append(cost.gather(1, nearest[:, None])[:, 0])
        if told is not None:
            told(len(part))
    new = torch.cat(found)
    depth = torch.where(frames.mask, new.exp(), 0.0)
    agreed = [agreement(frames, depth, part, sources[part], tolerance=settings.tolerance) for part in parts]
    return replace(
        stereo,
        log_depth=new,
        cost=torch.cat(matched),
        n_sources=count,
        seen=torch.cat([a.seen for a in agreed]),
        agrees=torch.cat([a.agrees for a in agreed]),
        violates=torch.cat([a.violates for a in agreed]),
        difference=torch.cat([a.difference for a in agreed]),
        fused=torch.cat([a.fused for a in agreed]),
    )


def shading_prior(
    fits: list[ShadingFit], brightness: Float[Tensor, "f h w"], recording: Int[Tensor, "f"]
) -> DepthPrior:
    """What brightness predicts of all frames, by their recordings' fits."""
    log_depth = torch.empty_like(brightness)
    for g, fit in enumerate(fits):
        log_depth[recording == g] = fit.log_depth(brightness[recording == g])
    scatter = torch.tensor([fit.scatter for fit in fits], device=brightness.device)[recording]
    return DepthPrior(log_depth, scatter)


def _parts(frames: PosedFrames, hypotheses: int, chunk: int | None) -> tuple[Tensor, ...]:
    """Numbers of the frames that are matched together."""
    device = frames.rgb.device
    if chunk is None:
        height, width = frames.size
        chunk = 1 if device.type == "cpu" else max(1, CHUNK_VALUES // (hypotheses * height * width))
    parts: tuple[Tensor, ...] = torch.arange(len(frames), device=device).split(chunk)
    return parts


def _cost(
    frames: PosedFrames,
    part: Tensor,
    sources: Tensor,
    base: Tensor,
    offsets: Tensor,
    settings: StereoSettings,
) -> Tensor:
    kernels = native if base.device.type == "cpu" else matching
    cost: Tensor = kernels.matching_cost(
        frames,
        part,
        sources[part],
        base,
        offsets,
        radius_px=settings.radius_px,
        best_share=settings.best_share,
    )
    return cost


def _log_depth(position: Tensor, log_base: Tensor, offsets: Tensor) -> Tensor:
    step = (offsets[:, 1] - offsets[:, 0])[:, None, None]
    return log_base + offsets[:, 0, None, None] + position * step


def _undecided(position: Tensor, hypotheses: int, blind: Tensor) -> Tensor:
    """The middle of the range for frames that nothing speaks for: of equal costs the first would win."""
    return torch.where(blind[:, None, None], 0.5 * (hypotheses - 1), position)


def _median(log_depth: Tensor, mask: Tensor) -> Tensor:
    """Median over 5 x 5 pixels inside the mask: steps and single outliers go, edges stay."""
    value = torch.where(mask, log_depth, float("nan"))
    padded = functional.pad(value[:, None], (2, 2, 2, 2), value=float("nan"))[:, 0]
    windows = padded.unfold(1, 5, 1).unfold(2, 5, 1).flatten(3)
    median = windows.nanmedian(dim=3).values
    return torch.where(torch.isfinite(median), median, log_depth)
