"""Sweeps over depths: of planes in front of each frame, then in finer steps around a surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from extrags.depth import matching, native
from extrags.depth.cues import Cues
from extrags.depth.frames import PosedFrames
from extrags.frame_stacks import empty_stack

__all__ = [
    "Planes",
    "StereoSettings",
    "best_around",
    "first_sweep",
    "frame_parts",
    "second_sweep",
    "source_counts",
]

COST_LEVELS = 127.5
"""Levels per unit of the costs that are kept as bytes."""

CHUNK_VALUES = 1 << 26
"""Costs of as many frames as have so many are made at a time on a GPU, which single frames leave idle; with
what is made on the way that is about 2 GB."""


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
class Planes:
    """Depths of the first sweep, parallel to each frame's image.

    Args:
        log_base: logarithm of the depth in the middle, [F].
        offsets: logarithms of the depths relative to it, evenly spaced, [F, D].
    """

    log_base: Float[Tensor, "f"]
    offsets: Float[Tensor, "f d"]

    @classmethod
    def between(cls, near: Float[Tensor, "f"], far: Float[Tensor, "f"], hypotheses: int) -> Planes:
        """From the smallest to the largest depth of each frame."""
        steps = torch.linspace(-1, 1, hypotheses, device=near.device)
        return cls(0.5 * (near.log() + far.log()), 0.5 * (far.log() - near.log())[:, None] * steps[None])

    def log_depth(self, part: Tensor, position: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
        """Log-depth at positions among the planes."""
        return _log_depth(position, self.log_base[part][:, None, None], self.offsets[part])


def first_sweep(
    frames: PosedFrames,
    sources: Tensor,
    planes: Planes,
    parts: tuple[Tensor, ...],
    settings: StereoSettings,
    told: Callable[[int], None] | None,
) -> tuple[UInt8[Tensor, "f d h w"], Float[Tensor, "f h w"]]:
    """Match every frame at all planes.

    Args:
        frames: frames with poses.
        sources: what each is matched with.
        planes: the depths.
        parts: numbers of the frames that are matched together.
        settings: how to match.
        told: called with the number of frames done.

    Returns:
        Costs in `COST_LEVELS`, and the log-depth that matches best.
    """
    # Costs of all frames are kept for the prior, which needs depth of all: as bytes, in a mapped file.
    shape = (len(frames), settings.hypotheses, *frames.size)
    costs, found = torch.from_numpy(empty_stack(shape, np.uint8)), []
    for part in parts:
        base = planes.log_base[part].exp()[:, None, None].expand(-1, *frames.size)
        cost = _cost(frames, part, sources, base, planes.offsets[part], settings)
        # A byte is fine enough for what is only ranked again.
        costs[part.cpu()] = (cost * COST_LEVELS).round().clamp(0, 255).to(torch.uint8).cpu()
        position, _, _ = _kernels(frames).best_steps(
            cost, frames.grey[part], small_step=settings.small_step, jump=settings.jump
        )
        found.append(planes.log_depth(part, position))
        if told is not None:
            told(len(part))
    return costs, torch.cat(found)


def second_sweep(
    frames: PosedFrames,
    sources: Tensor,
    planes: Planes,
    costs: UInt8[Tensor, "f d h w"],
    cues: Cues,
    parts: tuple[Tensor, ...],
    settings: StereoSettings,
    told: Callable[[int], None] | None,
) -> tuple[Float[Tensor, "f h w"], Float[Tensor, "f h w"], Float[Tensor, "f h w"]]:
    """Rank the planes again with the prior, then match in finer steps around the surface that they give.

    Args:
        frames: frames with poses.
        sources: what each is matched with.
        planes: the depths of the first sweep.
        costs: its costs.
        cues: what else tells of depth.
        parts: numbers of the frames that are matched together.
        settings: how to match.
        told: called with the number of frames done.

    Returns:
        Log-depth, its matching cost, and how much better its plane is than the best other one.
    """
    device, count = frames.rgb.device, source_counts(sources)
    steps = torch.linspace(-1, 1, settings.refinement_hypotheses, device=device)[None]
    found, matched, margins = [], [], []
    for part in parts:
        offsets = planes.offsets[part]
        cost = costs[part.cpu()].to(device).float() / COST_LEVELS
        cost += cues.prior.cost(
            part, planes.log_base[part], offsets, weight=cues.weight, scatters=settings.prior_scatters
        )
        position, _, margin = _kernels(frames).best_steps(
            cost, frames.grey[part], small_step=settings.small_step, jump=settings.jump
        )
        margins.append(margin)
        position = _undecided(position, settings.hypotheses, (count[part] == 0) & cues.silent(part))
        surface = _median(planes.log_depth(part, position), frames.mask[part])
        finer = steps * (settings.refinement_extent * (offsets[:, 1] - offsets[:, 0]))[:, None]
        log_depth, own_cost = best_around(
            frames,
            part,
            sources,
            surface,
            finer,
            settings,
            small_step=settings.refinement_small_step,
            jump=settings.refinement_jump,
        )
        found.append(log_depth)
        matched.append(own_cost)
        if told is not None:
            told(len(part))
    return torch.cat(found), torch.cat(matched), torch.cat(margins)


def best_around(
    frames: PosedFrames,
    part: Tensor,
    sources: Tensor,
    surface: Float[Tensor, "b h w"],
    offsets: Float[Tensor, "b d"],
    settings: StereoSettings,
    *,
    small_step: float,
    jump: float,
) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
    """The log-depth that matches best around a surface's, and its cost."""
    hypotheses = offsets.shape[1]
    cost = _cost(frames, part, sources, surface.exp(), offsets, settings)
    position, _, _ = _kernels(frames).best_steps(cost, frames.grey[part], small_step=small_step, jump=jump)
    position = _undecided(position, hypotheses, source_counts(sources[part]) == 0)
    nearest = position.round().long().clamp(0, hypotheses - 1)
    return _log_depth(position, surface, offsets), cost.gather(1, nearest[:, None])[:, 0]


def source_counts(sources: Int[Tensor, "f s"]) -> Int[Tensor, "f"]:
    """How many sources frames have; -1 is none."""
    return (sources >= 0).sum(1)


def frame_parts(frames: PosedFrames, hypotheses: int, chunk: int | None) -> tuple[Tensor, ...]:
    """Numbers of the frames that are matched together."""
    device = frames.rgb.device
    if chunk is None:
        height, width = frames.size
        chunk = 1 if device.type == "cpu" else max(1, CHUNK_VALUES // (hypotheses * height * width))
    parts: tuple[Tensor, ...] = torch.arange(len(frames), device=device).split(chunk)
    return parts


def _kernels(frames: PosedFrames) -> ModuleType:
    return native if frames.rgb.device.type == "cpu" else matching


def _cost(
    frames: PosedFrames,
    part: Tensor,
    sources: Tensor,
    base: Tensor,
    offsets: Tensor,
    settings: StereoSettings,
) -> Tensor:
    cost: Tensor = _kernels(frames).matching_cost(
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
