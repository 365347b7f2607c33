"""Multi-view stereo by sweeping surfaces: matching costs, semi-global optimisation, sub-step depth.

The torch implementation, on any device; it is the specification of the native kernels. Depths are
hypothesised as `base * exp(offset)`: with a constant base this is a plane sweep; with a surface as base, the
windows follow that surface, which does for slanted walls what slanted-plane stereo does, and the steps can
be finer.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.depth.frames import PosedFrames, source_from_reference

__all__ = ["best_steps", "centred_brightness", "kept_sources", "matching_cost", "semi_global", "sub_step"]

VARIANCE_FLOOR = 2e-4
"""Added to variances of log-brightness: noise of a few grey levels correlates with nothing."""

NEUTRAL_COST = 1.0
"""Of a hypothesis that a source does not see: that of no correlation at all."""

ABSENT_COST = 9.0
"""Above any cost there is."""

MIN_WINDOW_SHARE = 0.5
"""A window counts when at least so much of it is valid in both frames."""


def matching_cost(
    frames: PosedFrames,
    references: Int[Tensor, "b"],
    sources: Int[Tensor, "b s"],
    base_depth: Float[Tensor, "b h w"],
    offsets: Float[Tensor, "b d"],
    *,
    radius_px: int = 3,
    best_share: float = 0.5,
) -> Float[Tensor, "b d h w"]:
    """One minus the normalised cross-correlation of windows, the mean of the best-matching sources.

    Args:
        frames: all frames.
        references: frames whose depth is sought.
        sources: frames each is matched with; -1 for none.
        base_depth: z-depth of the base surface.
        offsets: logarithms of depth / base of the hypotheses, ascending.
        radius_px: windows have sides of 2 radius + 1 pixels.
        best_share: share of the sources, those that match best, that are averaged: what the others do not
            see must not count against a depth.

    Returns:
        Costs in [0, 2]; 1 where nothing could be compared.
    """
    height, width = frames.size
    grey = frames.grey
    mask = frames.mask.float()
    own = mask[references]
    centred = centred_brightness(grey, frames.mask, references, radius_px)
    rays = frames.rays[references]
    costs = torch.empty(len(references), offsets.shape[1], height, width, device=grey.device)
    present = sources >= 0
    kept = kept_sources(sources, best_share)
    motions = [
        source_from_reference(frames, references, sources[:, s].clamp_min(0)) for s in range(sources.shape[1])
    ]
    turned = [torch.einsum("bij,bjhw->bihw", motion[:, :, :3], rays) for motion in motions]
    for step in range(offsets.shape[1]):
        depth = base_depth * torch.exp(offsets[:, step, None, None])
        per_source = []
        for s, motion in enumerate(motions):
            source = sources[:, s].clamp_min(0)
            points = turned[s] * depth[:, None] + motion[:, :, 3, None, None]
            z = points[:, 2]
            K = frames.K[source]
            u = K[:, 0, 0, None, None] * points[:, 0] / z.clamp_min(1e-6) + K[:, 0, 2, None, None]
            v = K[:, 1, 1, None, None] * points[:, 1] / z.clamp_min(1e-6) + K[:, 1, 2, None, None]
            grid = torch.stack([u / width * 2 - 1, v / height * 2 - 1], dim=-1)
            inside = (u > 0.5) & (u < width - 0.5) & (v > 0.5) & (v < height - 0.5) & (z > 1e-6)
            sampled = functional.grid_sample(
                torch.stack([grey[source], mask[source]], dim=1), grid, align_corners=False
            )
            both = own * (inside & (sampled[:, 1] > 0.99)) * present[:, s, None, None]
            other = sampled[:, 0]
            cost = _one_minus_zncc(centred, other, both, radius_px)
            # An absent source is sorted last, where it is never kept.
            per_source.append(torch.where(present[:, s, None, None], cost, ABSENT_COST))
        stacked = torch.stack(per_source, dim=1).sort(dim=1).values
        ranks = torch.arange(sources.shape[1], device=grey.device)
        weight = (ranks[None] < kept[:, None]).float() / kept[:, None]
        costs[:, step] = torch.einsum("bshw,bs->bhw", stacked, weight)
    costs[~present.any(dim=1)] = NEUTRAL_COST
    return costs


def centred_brightness(
    grey: Float[Tensor, "f h w"], mask: Bool[Tensor, "f h w"], references: Int[Tensor, "b"], radius_px: int
) -> Float[Tensor, "b h w"]:
    """Brightness less its local mean, zero outside the mask: products of it lose no digits."""
    reference, own = grey[references], mask[references].float()
    mean = _box(reference * own, radius_px) / _box(own, radius_px).clamp_min(1e-6)
    return (reference - mean) * own


def kept_sources(sources: Int[Tensor, "b s"], best_share: float) -> Int[Tensor, "b"]:
    """How many of a reference's sources are averaged."""
    return torch.clamp(torch.ceil(best_share * (sources >= 0).sum(1)), min=1).long()


def _one_minus_zncc(a: Tensor, b: Tensor, both: Tensor, radius_px: int) -> Tensor:
    count = _box(both, radius_px)
    n = count.clamp_min(1e-6)
    # Windows of log-brightness: subtracting a local mean first keeps the products small.
    mean_a, mean_b = _box(a * both, radius_px) / n, _box(b * both, radius_px) / n
    variance_a = _box(a * a * both, radius_px) / n - mean_a * mean_a
    variance_b = _box(b * b * both, radius_px) / n - mean_b * mean_b
    covariance = _box(a * b * both, radius_px) / n - mean_a * mean_b
    floored = (variance_a.clamp_min(0) + VARIANCE_FLOOR) * (variance_b.clamp_min(0) + VARIANCE_FLOOR)
    cost = 1 - covariance / floored.sqrt()
    enough = count >= MIN_WINDOW_SHARE * (2 * radius_px + 1) ** 2
    return torch.where(enough & (both > 0), cost, NEUTRAL_COST)


def _box(image: Tensor, radius_px: int) -> Tensor:
    """Sums over windows; pixels outside the image count as zero."""
    side = 2 * radius_px + 1
    padded = functional.pad(image[:, None], (radius_px,) * 4)
    horizontal = functional.avg_pool2d(padded, (1, side), stride=1) * side
    return (functional.avg_pool2d(horizontal, (side, 1), stride=1) * side)[:, 0]


_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


def semi_global(
    cost: Float[Tensor, "b d h w"],
    grey: Float[Tensor, "b h w"],
    *,
    small_step: float,
    jump: float,
    edge: float = 0.15,
) -> Float[Tensor, "b d h w"]:
    """Costs summed along eight directions, with penalties on changes of the hypothesis between neighbours.

    Args:
        cost: of each hypothesis.
        grey: log-brightness; where it changes between neighbours, a jump of depth costs less.
        small_step: penalty of a change by one hypothesis.
        jump: penalty of any larger change, where brightness is smooth.
        edge: change of log-brightness at which the penalty of a jump is halved.

    Returns:
        The sum over directions, divided by their number.

    Source: H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008.
    """
    total = torch.zeros_like(cost)
    for row_step, column_step in _DIRECTIONS:
        vertical = row_step != 0
        # The recursion runs along the rows where the direction has any vertical part.
        volume = cost if vertical else cost.transpose(2, 3)
        image = grey if vertical else grey.transpose(1, 2)
        along = row_step if vertical else column_step
        shift = column_step if vertical else 0
        lines = volume.shape[2]
        order = range(lines) if along > 0 else range(lines - 1, -1, -1)
        previous: Tensor | None = None
        summed = total if vertical else total.transpose(2, 3)
        for line in order:
            here = volume[:, :, line]
            if previous is None:
                path = here
            else:
                before, bright = previous, image[:, line - along]
                started = None
                if shift:
                    before, bright = torch.roll(before, shift, 2), torch.roll(bright, shift, 1)
                    started = 0 if shift > 0 else here.shape[2] - 1
                lowest = before.min(dim=1, keepdim=True).values
                change = (image[:, line] - bright).abs()
                penalty = (jump / (1 + change / edge)).clamp_min(small_step)[:, None]
                padded = functional.pad(before, (0, 0, 1, 1), value=float("inf"))
                neighbour = torch.minimum(padded[:, :-2], padded[:, 2:]) + small_step
                best = torch.minimum(torch.minimum(before, neighbour), lowest + penalty)
                path = here + best - lowest
                if started is not None:
                    path = path.clone()
                    path[:, :, started] = here[:, :, started]
            summed[:, :, line] += path
            previous = path
    return total / len(_DIRECTIONS)


def best_steps(
    cost: Float[Tensor, "b d h w"],
    grey: Float[Tensor, "b h w"],
    *,
    small_step: float,
    jump: float,
    edge: float = 0.15,
) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
    """`sub_step` of what `semi_global` makes of the costs; arguments and results are theirs."""
    return sub_step(semi_global(cost, grey, small_step=small_step, jump=jump, edge=edge))


def sub_step(
    cost: Float[Tensor, "b d h w"],
) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
    """The best hypothesis with a parabola through its neighbours' costs.

    Returns:
        Its position among the hypotheses (fractional), its cost, and the margin to the best hypothesis
        that is more than two steps away.
    """
    steps = cost.shape[1]
    lowest, index = cost.min(dim=1)
    inner = index.clamp(1, steps - 2)
    left, middle, right = (cost.gather(1, (inner + k)[:, None])[:, 0] for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    shift = torch.where(bend > 1e-9, 0.5 * (left - right) / bend.clamp_min(1e-9), 0.0).clamp(-0.5, 0.5)
    position = torch.where(index == inner, index + shift, index.float())
    numbers = torch.arange(steps, device=cost.device)[None, :, None, None]
    elsewhere = torch.where((numbers - index[:, None]).abs() > 2, cost, float("inf")).min(dim=1).values
    margin = torch.where(torch.isfinite(elsewhere), elsewhere - lowest, 0.0)
    return position, lowest, margin
