"""What is expected of a frame's depth before its windows are matched: from its light, from a network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["DepthPrior"]

BOUND = 1.5
"""Of the cost, in its weights: clear matches win against any prior."""


@dataclass(frozen=True)
class DepthPrior:
    """Log-depth that is expected, and how far depths scatter around it.

    Args:
        log_depth: logarithm of z-depth, [F, H, W].
        scatter: robust standard deviation of log-depth around it, infinite where nothing is known, [F].
    """

    log_depth: Float[Tensor, "f h w"]
    scatter: Float[Tensor, "f"]

    def __and__(self, other: DepthPrior) -> DepthPrior:
        """Both together, weighted by their inverse variances."""
        own, others = (1 / prior.scatter.square() for prior in (self, other))
        total = own + others
        share = torch.where(total > 0, others / total, 0.0)[:, None, None]
        log_depth = self.log_depth + share * (other.log_depth - self.log_depth)
        return DepthPrior(log_depth, 1 / total.sqrt())

    def cost(
        self,
        part: Tensor,
        log_base: Float[Tensor, "b"],
        offsets: Float[Tensor, "b d"],
        *,
        weight: float,
        scatters: float,
    ) -> Float[Tensor, "b d h w"]:
        """Cost of leaving the expected depth, bounded; nothing where nothing is expected.

        Args:
            part: the frames.
            log_base: logarithm of the depth that hypotheses are relative to.
            offsets: logarithms of depth / base of the hypotheses.
            weight: of the prior.
            scatters: at so many scatters the cost is the weight.
        """
        hypotheses = log_base[:, None] + offsets
        away = (hypotheses[:, :, None, None] - self.log_depth[part][:, None]).abs()
        away = away / (scatters * self.scatter[part][:, None, None, None])
        return weight * away.clamp_max(BOUND)
