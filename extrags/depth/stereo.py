"""Dense depth of posed frames from each other: two sweeps, a prior of other cues, agreement of views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypedDict

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.depth.consistency import Agreement, agreement
from extrags.depth.cues import fitted_cues
from extrags.depth.frames import PosedFrames
from extrags.depth.monocular import MonocularFit
from extrags.depth.shading import ShadingFit
from extrags.depth.sweeps import (
    Planes,
    StereoSettings,
    best_around,
    first_sweep,
    frame_parts,
    second_sweep,
    source_counts,
)
from extrags.errors import ShapeError

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

SURE_AGREEMENT = 1.5
"""Sources that must agree with a depth for the fit of other cues, together with the frame's own."""


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
    if recording is None:
        recording = torch.zeros(len(frames), dtype=torch.long, device=frames.rgb.device)
    planes = Planes.between(near, far, settings.hypotheses)
    parts = frame_parts(frames, settings.hypotheses, chunk)
    costs, first = first_sweep(frames, sources, planes, parts, settings, told)
    depth = first.exp()
    cues = fitted_cues(
        frames,
        depth,
        _sure(frames, sources, depth, parts, settings),
        recording,
        shading=settings.shading,
        monocular=monocular,
        weight=settings.prior_weight,
    )
    log_depth, cost, margin = second_sweep(frames, sources, planes, costs, cues, parts, settings, told)
    return StereoDepth(
        log_depth=log_depth,
        cost=cost,
        margin=margin,
        **_agreement_of_all(frames, sources, log_depth, parts, settings),
        prior=cues.prior.log_depth,
        prior_scatter=cues.prior.scatter,
        fits=cues.shading,
        monocular=cues.monocular,
        recording=recording,
        n_sources=source_counts(sources),
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
    offsets = torch.linspace(-half_width, half_width, hypotheses, device=log_depth.device)[None]
    found, matched = [], []
    parts = frame_parts(frames, hypotheses, chunk)
    for part in parts:
        around = offsets.expand(len(part), -1)
        own_log_depth, own_cost = best_around(
            frames, part, sources, log_depth[part], around, settings, small_step=small_step, jump=jump
        )
        found.append(own_log_depth)
        matched.append(own_cost)
        if told is not None:
            told(len(part))
    new = torch.cat(found)
    return replace(
        stereo,
        log_depth=new,
        cost=torch.cat(matched),
        n_sources=source_counts(sources),
        **_agreement_of_all(frames, sources, new, parts, settings),
    )


def _sure(
    frames: PosedFrames,
    sources: Tensor,
    depth: Float[Tensor, "f h w"],
    parts: tuple[Tensor, ...],
    settings: StereoSettings,
) -> Bool[Tensor, "f h w"]:
    """Pixels whose depth enough sources share for other cues to be fitted to it."""
    agreed = [agreement(frames, depth, part, sources[part], tolerance=settings.tolerance) for part in parts]
    agreeing = torch.cat([a.agrees * a.seen for a in agreed]) * source_counts(sources)[:, None, None]
    sure = agreeing >= SURE_AGREEMENT
    return sure & frames.mask & (frames.rgb.amax(dim=1) < NEARLY_SATURATED)


def _agreement_of_all(
    frames: PosedFrames,
    sources: Tensor,
    log_depth: Float[Tensor, "f h w"],
    parts: tuple[Tensor, ...],
    settings: StereoSettings,
) -> dict[str, Any]:
    """`agreement` of all frames, as fields of `StereoDepth`."""
    depth = torch.where(frames.mask, log_depth.exp(), 0.0)
    agreed = [agreement(frames, depth, part, sources[part], tolerance=settings.tolerance) for part in parts]
    return {
        field.name: torch.cat([getattr(part, field.name) for part in agreed]) for field in fields(Agreement)
    }
