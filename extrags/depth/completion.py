r"""A small network that completes stereo: depth everywhere, with the error to expect of it.

It sees the image, the depth of stereo with what tells how far to trust it, and the depth that brightness
predicts, all relative to the frame's own median depth; it has no notion of scale. (Sparse points have a
channel, which `estimate_depth` leaves empty: it measured no gain.) Its
log-depth is a mixture, pixel by pixel, of stereo, shading and a value of its own,

.. math:: \log d = \log d_\text{frame} + \sum_k w_k \, \ell_k + r ,

so that where stereo is right there is nothing to be learned but the weight one.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrags.depth.frames import PosedFrames
from extrags.depth.halving import HalvingConv2d
from extrags.depth.stereo import NEARLY_SATURATED, SURE_AGREEMENT, StereoDepth

__all__ = [
    "INPUT_CHANNELS",
    "SIZE_MULTIPLE",
    "CompletionInputs",
    "CompletionNetwork",
    "completion_inputs",
    "completion_loss",
]

INPUT_CHANNELS = 19
SIZE_MULTIPLE = 16
"""Image sides are padded to multiples of this: four halvings."""

WIDTHS = (24, 48, 96, 128, 128)
NORM_GROUPS = 8
FARTHEST_LOG = 3.0
"""Bound of log-depths relative to the frame's median."""

RGB, STEREO, SHADING, SEEN = slice(0, 3), 3, 4, 7
MASK, RAYS, POINTS, SOURCES = 11, slice(12, 14), slice(15, 17), 17
"""Where these channels lie; the others are listed in `completion_inputs`."""


@dataclass(frozen=True)
class CompletionInputs:
    """What the network sees.

    Args:
        channels: [F, 19, H, W].
        log_scale: logarithm of each frame's median depth, to which log-depths are relative, [F].
    """

    channels: Float[Tensor, "f 19 h w"]
    log_scale: Float[Tensor, "f"]


def completion_inputs(
    frames: PosedFrames, stereo: StereoDepth, points: Float[Tensor, "f h w"] | None = None
) -> CompletionInputs:
    """Channels of the network.

    Args:
        frames: the frames.
        stereo: their stereo.
        points: z-depth of sparse points at their pixels, 0 elsewhere; None without points.
    """
    mask = frames.mask
    sure = mask & (stereo.agrees * stereo.seen * stereo.n_sources[:, None, None] >= SURE_AGREEMENT)
    log_scale = torch.stack([_median(log, s, m) for log, s, m in zip(stereo.fused, sure, mask, strict=True)])
    relative = (stereo.fused - log_scale[:, None, None]).clamp(-FARTHEST_LOG, FARTHEST_LOG)
    # Where brightness could not be fitted it predicts nothing: the median depth, with the largest scatter.
    prior = (stereo.prior - log_scale[:, None, None]).clamp(-FARTHEST_LOG, FARTHEST_LOG)
    prior = prior * (stereo.prior_scatter < 1.0)[:, None, None]
    constant = stereo.prior_scatter.clamp_max(1.0)[:, None, None].expand_as(relative)
    sources = (stereo.n_sources / 6)[:, None, None].expand_as(relative)
    present = torch.zeros_like(relative) if points is None else (points > 0).float()
    at_points = torch.zeros_like(relative)
    if points is not None:
        logs = torch.log(points.clamp_min(1e-9)) - log_scale[:, None, None]
        at_points = torch.where(points > 0, logs.clamp(-FARTHEST_LOG, FARTHEST_LOG), 0.0)
    rays = frames.rays[:, :2]
    saturated = (frames.rgb.amax(dim=1) >= NEARLY_SATURATED).float()
    single = [
        relative,
        prior,
        stereo.cost,
        stereo.margin,
        stereo.seen,
        stereo.agrees,
        stereo.violates,
        stereo.difference,
        mask.float(),
    ]
    rest = [constant, at_points, present, sources, saturated]
    channels = torch.cat([frames.rgb - 0.5, torch.stack(single, 1), rays, torch.stack(rest, 1)], dim=1)
    return CompletionInputs(channels * mask[:, None], log_scale)


def _median(values: Tensor, sure: Tensor, mask: Tensor) -> Tensor:
    chosen = sure if int(sure.sum()) >= 50 else mask
    return values[chosen].median() if bool(chosen.any()) else values.median()


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm_in = nn.GroupNorm(NORM_GROUPS, inputs)
        self.conv_in = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.norm_out = nn.GroupNorm(NORM_GROUPS, outputs)
        self.conv_out = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        hidden = self.conv_in(functional.silu(self.norm_in(features)))
        hidden = self.conv_out(functional.silu(self.norm_out(hidden)))
        return self.skip(features) + hidden  # type: ignore[no-any-return]


class CompletionNetwork(nn.Module):
    """A U-Net with five levels.

    Args:
        widths: channels of the levels, the finest first; multiples of 8.
    """

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        self.widths = widths
        self.entrance = nn.Conv2d(INPUT_CHANNELS, widths[0], 3, padding=1)
        self.down = nn.ModuleList(_Block(width, width) for width in widths)
        self.coarser = nn.ModuleList(
            HalvingConv2d(fine, coarse) for fine, coarse in itertools.pairwise(widths)
        )
        self.finer = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in itertools.pairwise(widths))
        self.up = nn.ModuleList(_Block(2 * width, width) for width in widths[:-1])
        self.norm = nn.GroupNorm(NORM_GROUPS, widths[0])
        self.exit = nn.Conv2d(widths[0], 6, 3, padding=1)
        nn.init.zeros_(self.exit.weight)
        with torch.no_grad():
            # It starts by believing stereo, with an expected error of five percent.
            self.exit.bias[:] = torch.tensor([2.0, 0.0, -2.0, 0.0, 0.0, -3.0])  # type: ignore[index]

    def forward(
        self, channels: Float[Tensor, "f 19 h w"]
    ) -> tuple[Float[Tensor, "f h w"], Float[Tensor, "f h w"]]:
        """Relative log-depth, and the logarithm of its expected absolute error.

        Args:
            channels: from `completion_inputs`; sides are padded here.
        """
        height, width = channels.shape[2:]
        padding = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)
        hidden = self.entrance(functional.pad(channels, padding))
        kept = []
        for level, block in enumerate(self.down):
            hidden = block(hidden)
            if level < len(self.coarser):
                kept.append(hidden)
                hidden = self.coarser[level](hidden)
        for level in range(len(self.up) - 1, -1, -1):
            hidden = functional.interpolate(self.finer[level](hidden), scale_factor=2, mode="nearest")
            hidden = self.up[level](torch.cat([hidden, kept[level]], dim=1))
        out = self.exit(functional.silu(self.norm(hidden)))[:, :, :height, :width].float()
        weights = torch.softmax(out[:, :3], dim=1)
        own = out[:, 3].clamp(-FARTHEST_LOG, FARTHEST_LOG)
        values = torch.stack([channels[:, STEREO].float(), channels[:, SHADING].float(), own], dim=1)
        log_depth = (weights * values).sum(1) + 0.2 * out[:, 4]
        return log_depth, out[:, 5].clamp(-7, 1.5)


def completion_loss(
    log_depth: Float[Tensor, "f h w"],
    log_error: Float[Tensor, "f h w"],
    truth: Float[Tensor, "f h w"],
    mask: Float[Tensor, "f h w"],
) -> dict[str, Tensor]:
    """Terms of the training loss.

    Args:
        log_depth: predicted, relative.
        log_error: logarithm of the expected absolute error of it.
        truth: true log-depth, relative to the same scale.
        mask: one where the truth is known. Shares between weigh slopes and expected error.

    Returns:
        `depth`: mean absolute error; `slope`: of its differences between neighbours at three scales, which
        keeps surfaces smooth and edges sharp; `error`: negative log-likelihood of a Laplace distribution
        whose mean absolute deviation is the expected error. The last does not move the depth.
    """
    residual = torch.where(mask > 0, log_depth - truth, 0.0)
    count = mask.sum().clamp_min(1)
    terms = {"depth": residual.abs().sum() / count}
    slope = torch.zeros((), device=residual.device)
    for step in (1, 2, 4):
        for dim in (1, 2):
            size = residual.shape[dim]
            first, second = residual.narrow(dim, 0, size - step), residual.narrow(dim, step, size - step)
            both = mask.narrow(dim, 0, size - step) * mask.narrow(dim, step, size - step)
            slope = slope + ((second - first).abs() * both).sum() / both.sum().clamp_min(1)
    terms["slope"] = slope / 3
    absolute = residual.detach().abs()
    terms["error"] = ((absolute * torch.exp(-log_error) + log_error) * mask).sum() / count
    return terms
